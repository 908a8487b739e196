"""Figures of merit of a thermal model, and of its predictions."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr

from errormotion.datasets.results.merit import last_values
from errormotion.datasets.schemas import DOF, SCHEMA
from errormotion.plugins import FigureOfMerit


def figures(dataset: xr.Dataset) -> list[FigureOfMerit]:
    """Return the last predicted errors and the extrapolated fraction, or the validation of a model.

    Of a model: the standard uncertainty of a prediction (misfit), and the fraction of each error that it removed, both
    at campaigns that were left out.
    """
    if dataset.attrs.get("schema") == SCHEMA:
        outside = float(np.mean(dataset["outside"].values)) if dataset.sizes.get("time") else math.nan
        return [*last_values(dataset), FigureOfMerit("fraction of times outside the training range", outside, 0.0, "1")]
    found = []
    for k, name in enumerate(DOF):
        misfit, removed = float(dataset["misfit"].values[k]), float(dataset["removed"].values[k])
        if math.isfinite(misfit):
            found.append(FigureOfMerit(f"misfit of {name}", misfit, math.nan, "m" if k < 3 else "rad"))
            found.append(FigureOfMerit(f"removed fraction of {name}", removed, math.nan, "1"))
    return found
