"""The plan of a test: the identification of the raw data that it is expected to give."""

from __future__ import annotations

from typing import Any

import xarray as xr

from errormotion.datasets import provenance
from errormotion.measurement.identification import dataset, solve
from errormotion.measurement.observed import Model, as_expected
from errormotion.plugins import MethodInfo

__all__ = ["plan"]


def plan(model: Model, settings: Any, info: MethodInfo) -> xr.Dataset:
    """Return an error dataset of zeros with the covariance and the sources that a test would have.

    Raises
    ------
    MethodError
        A test with these settings does not determine the result.
    """
    raw = model.expected(settings)
    observed = as_expected(model.observe(raw, settings))
    origin = provenance.make(settings, None, None, steps=["plan"])
    return dataset(model, solve(observed), raw, info, origin, planned=True)
