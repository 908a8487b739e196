"""Report chapters: prediction of a thermal model, and comparison of a model with a measured campaign."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import xarray as xr

from errormotion.compensation.thermal_model.report import chapter, check
from errormotion.report import Form, provenance, write_page
from errormotion.report.document import Part, Source
from errormotion.report.page.language import texts_of


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a prediction over time; none for other results."""
    return [chapter.part(source, source.key)] if chapter.is_prediction(source.errors) else []


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of these chapters: English text = text in the language."""
    return texts_of(__name__, language)


def write_model_report(
    model: xr.Dataset,
    measured: xr.Dataset,
    out: Path,
    *,
    predicted: xr.Dataset,
    figures: Mapping[str, Any],
    form: Form | None = None,
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
    form : Form, optional
        Language, paper, and what is written beside the page.

    Returns
    -------
    Path
        ``out``.
    """
    source = Source(predicted, None, {}, provenance.read(model))
    return write_page(
        [Source(measured, None, {}, provenance.read(measured)), source],
        lambda: [check.part(source, source.key, model, measured, figures)],
        out,
        form=form or Form(),
    )
