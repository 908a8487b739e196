"""Report chapters: prediction of a thermal model, and comparison of a model with a measured campaign."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from errormotion.compensation.thermal_model.report import chapter, check
from errormotion.report import provenance, write_page
from errormotion.report.document import Part, Source


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a prediction over time; none for other results."""
    return [chapter.part(source, source.key)] if chapter.is_prediction(source.errors) else []


def write_model_report(
    model: xr.Dataset, measured: xr.Dataset, out: Path, *, predicted: xr.Dataset, figures: Mapping[str, Any]
) -> Path:
    """Write a page that compares a thermal model with a measured campaign.

    Parameters
    ----------
    model : Dataset
        Schema ``errormotion.model.thermal/1``.
    measured : Dataset
        Error dataset of a campaign that the model was not fitted to.
    out : Path
        The file; an older one is replaced in one step.
    predicted : Dataset
        Prediction of the model for this campaign.
    figures : mapping
        Results of the comparison: ``rms``, ``remaining``, ``removed`` and ``held``, six numbers each.

    Returns
    -------
    Path
        ``out``.
    """
    source = Source(predicted, None, {}, provenance.read(model))
    part = check.part(source, source.key, model, measured, figures)
    path: Path = write_page([Source(measured, None, {}, provenance.read(measured)), source], [part], out)
    return path
