"""One trial of a method: every source drawn anew, then the method's own identification."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import xarray as xr
from numpy.random import SeedSequence

from errormotion.arrays import Array
from errormotion.errors import ErrormotionError, MethodError
from errormotion.plugins import Redrawing

SAME = 1e-2
"""Largest difference of the reduced data's result from the measured data's, in standard uncertainties."""
ROUNDING = 1e-12
"""The same where there is no uncertainty, m or rad."""


def redrawing_of(method: Any, raw: xr.Dataset, settings: Any, errors: xr.Dataset) -> Redrawing:
    """Return how a method draws its sources anew.

    Raises
    ------
    MethodError
        The method does not bring it, or its reduced data do not give the result of the measured ones.
    """
    if not hasattr(method, "redrawing"):
        raise MethodError(
            f"The method {method.info.id} {method.info.version} cannot be evaluated by the Monte Carlo method: it does "
            "not state how its sources are drawn anew (redrawing). Its linear uncertainty is unaffected."
        )
    found: Redrawing = method.redrawing(raw, settings, errors)
    check_centre(method.identify(found.raw, found.settings), errors)
    return found


def check_centre(centre: xr.Dataset, errors: xr.Dataset) -> None:
    """Raise MethodError unless the reduced data give the values of the measured data."""
    one, other = values_of(centre), values_of(errors)
    if one.shape != other.shape:
        raise MethodError(
            f"The data to be drawn anew give {one.shape[0]} places, the measured data {other.shape[0]}; "
            "expected the same. This is a defect of the method's redrawing."
        )
    u = linear_uncertainty(errors)
    known = np.isfinite(other)
    off = np.abs(one - other) > np.maximum(SAME * np.nan_to_num(u), ROUNDING)
    if wrong := int((known & (off | ~np.isfinite(one))).sum()):
        raise MethodError(
            f"The data to be drawn anew give other values than the measured data at {wrong} of {int(known.sum())} "
            "places and freedoms. This is a defect of the method's redrawing."
        )


def values_of(errors: xr.Dataset) -> Array:
    """Return the values (place, freedom) of an error dataset, places in their order."""
    dims = [str(dim) for dim in errors.em.dims]
    stacked = np.stack([errors[name].transpose(*dims).values for name in errors.em.names], axis=-1)
    return np.asarray(stacked, dtype=float).reshape(-1, len(errors.em.names))


def linear_uncertainty(errors: xr.Dataset) -> Array:
    """Return the standard uncertainties (place, freedom) by linear propagation."""
    dims = [str(dim) for dim in errors.em.dims]
    covariance = errors.em.covariance()
    inner = [dim for dim in covariance.dims if dim not in dims]
    C = np.asarray(covariance.transpose(*dims, *inner).values, dtype=float)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(np.diagonal(C, axis1=-2, axis2=-1)).reshape(-1, C.shape[-1]))


def trial(method: Any, redrawing: Redrawing, sequence: SeedSequence, only: Iterable[str] | None = None) -> xr.Dataset:
    """Return the error dataset of one trial.

    Every source has a generator of its own, by its number: leaving one out (``only`` names those that act) leaves
    the draws of the others as they are.
    """
    acting = set(redrawing.sources if only is None else only)
    raw, settings = redrawing.raw, redrawing.settings
    generators = {
        name: np.random.default_rng(SeedSequence(sequence.entropy, spawn_key=(*sequence.spawn_key, number)))
        for number, name in enumerate(redrawing.sources)
        if name in acting
    }
    for name, generator in generators.items():
        if (draw := redrawing.sources[name].draw) is not None:
            raw, settings = draw(raw, settings, generator)
    errors: xr.Dataset = method.identify(raw, settings)
    for name, generator in generators.items():
        if (act := redrawing.sources[name].act) is not None:
            errors = act(errors, generator)
    return errors


def sample(
    method: Any,
    redrawing: Redrawing,
    sequence: SeedSequence,
    trials: range,
    shape: tuple[int, int],
    only: Iterable[str] | None = None,
) -> tuple[Array, dict[str, int]]:
    """Return the values (trial, place, freedom) of some trials, NaN where one was refused, and the reasons by count.

    Parameters
    ----------
    method : Method
    redrawing : Redrawing
    sequence : SeedSequence
        Of the block; each trial has one of its own by its number.
    trials : range
        Numbers of the trials.
    shape : (int, int)
        Places and freedoms.
    only : iterable of str, optional
        Sources that act; default all.
    """
    found, reasons = np.full((len(trials), *shape), np.nan), dict[str, int]()
    for row, number in enumerate(trials):
        own = SeedSequence(sequence.entropy, spawn_key=(*sequence.spawn_key, number))
        try:
            values = values_of(trial(method, redrawing, own, only))
        except ErrormotionError as error:
            reason = str(error).splitlines()[0]
        else:
            if values.shape == shape:
                found[row] = values
                continue
            reason = f"a trial gave {values.shape[0]} places instead of {shape[0]}"
        reasons[reason] = reasons.get(reason, 0) + 1
    return found, reasons
