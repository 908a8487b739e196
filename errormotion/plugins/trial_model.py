"""Sources of uncertainty of a method for the evaluation by the Monte Carlo method."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

Draw = Callable[[xr.Dataset, Any, np.random.Generator], tuple[xr.Dataset, Any]]
"""``draw(raw, settings, generator)`` returns new raw data and settings with one source drawn at random."""
Act = Callable[[xr.Dataset, np.random.Generator], xr.Dataset]
"""``act(errors, generator)`` returns an error dataset with a source that is not part of the raw data."""


@dataclass(frozen=True)
class RandomSource:
    """One source of uncertainty, independent of all others.

    Attributes
    ----------
    draw : function, optional
        ``draw(raw, settings, generator)`` returns raw data and settings in which the source is drawn from its
        distribution about the measured or stated value. It does not change its arguments.
    groups : tuple of str
        Values of ``source_group`` in the ``influence`` of the result that this source represents.
    own : bool
        Whether it causes the part of the covariance without influence, independent from value to value.
    act : function, optional
        ``act(errors, generator)`` returns an error dataset: for an assumption about the machine without effect on the
        readings, such as a rotation that the method does not measure.
    """

    draw: Draw | None = None
    groups: tuple[str, ...] = ()
    own: bool = False
    act: Act | None = None


@dataclass(frozen=True)
class TrialModel:
    """Raw data and all sources of their uncertainty.

    Attributes
    ----------
    raw : Dataset
        The measured data in memory, reduced for many identifications: means instead of single samples, outliers
        replaced by NaN.
    settings : PluginSettings
        Settings for the same result from ``raw`` as from the measured data: automatic choices of the method are
        stated, tests for outliers are off, and results without effect on the values are omitted.
    sources : mapping of str to RandomSource
        By name, in their order of application.
    identify : function, optional
        ``identify(raw, settings)`` returns the error dataset of a trial, in place of that of the method: for a method
        whose ``raw`` here is not its raw data, but the arrays of its measurement model.
    """

    raw: xr.Dataset
    settings: Any
    sources: Mapping[str, RandomSource]
    identify: Callable[[xr.Dataset, Any], xr.Dataset] | None = None


def replaced(dataset: xr.Dataset, values: Mapping[str, ArrayLike]) -> xr.Dataset:
    """Return a dataset with other values of some variables, in the order of their dimensions.

    The values are plain arrays, without labels and masks, of variables that are no dimension coordinates. Nothing is
    aligned, which would take a third of the time of many trials.
    """
    changed = dataset.copy()
    for name, array in values.items():
        changed.variables[name].data = np.asarray(array)
    return changed
