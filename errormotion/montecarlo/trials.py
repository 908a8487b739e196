"""One trial of a method: new random draws of all sources, then the identification."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import xarray as xr
from numpy.random import SeedSequence

from errormotion.arrays import Array
from errormotion.errors import ErrormotionError, MethodError
from errormotion.plugins import TrialModel, states

MAX_DIFFERENCE = 1e-2
"""Largest difference between the results of reduced and measured data, in standard uncertainties."""
ROUNDING = 1e-12
"""Largest difference between these results for values without uncertainty, m or rad."""


def trial_model_of(method: Any, raw: xr.Dataset, settings: Any, errors: xr.Dataset) -> TrialModel:
    """Return the trial model of a method: data, settings, and how the sources are drawn.

    Raises
    ------
    MethodError
        The method has no trial model, or the result of its reduced data is not that of the measured data.
    """
    model: TrialModel | None = method.trial_model(raw, settings, errors) if states(method, "trial_model") else None
    if model is None:
        raise MethodError(
            f"The method {method.info.id} {method.info.version} cannot be evaluated by the Monte Carlo method: it has "
            "no 'trial_model'. Its linear uncertainty is not affected.",
            code="monte_carlo.method.no_trial_model",
        )
    check_centre((model.identify or method.identify)(model.raw, model.settings), errors)
    return model


def check_centre(centre: xr.Dataset, errors: xr.Dataset) -> None:
    """Raise MethodError unless the result of the reduced data is that of the measured data."""
    one, other = values_of(centre), values_of(errors)
    if one.shape != other.shape:
        raise MethodError(
            f"The result has {one.shape[0]} places from the reduced data and {other.shape[0]} from the measured data; "
            "expected the same number. This is a defect of the trial model of the method.",
            code="monte_carlo.trial_model.places",
        )
    u = linear_uncertainty(errors)
    known = np.isfinite(other)
    off = np.abs(one - other) > np.maximum(MAX_DIFFERENCE * np.nan_to_num(u), ROUNDING)
    if wrong := int((known & (off | ~np.isfinite(one))).sum()):
        raise MethodError(
            f"The results from the reduced data and from the measured data differ at {wrong} of {int(known.sum())} "
            "places and freedoms. This is a defect of the trial model of the method.",
            code="monte_carlo.trial_model.values",
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


def trial(method: Any, model: TrialModel, sequence: SeedSequence, only: Iterable[str] | None = None) -> xr.Dataset:
    """Return the error dataset of one trial.

    Every source has its own generator, so that the draws of a source do not depend on which other sources are active
    (``only`` states the active ones).
    """
    active = set(model.sources if only is None else only)
    raw, settings = model.raw, model.settings
    generators = {
        name: np.random.default_rng(SeedSequence(sequence.entropy, spawn_key=(*sequence.spawn_key, number)))
        for number, name in enumerate(model.sources)
        if name in active
    }
    for name, generator in generators.items():
        if (draw := model.sources[name].draw) is not None:
            raw, settings = draw(raw, settings, generator)
    errors: xr.Dataset = (model.identify or method.identify)(raw, settings)
    for name, generator in generators.items():
        if (act := model.sources[name].act) is not None:
            errors = act(errors, generator)
    return errors


def sample(
    method: Any,
    trial_model: TrialModel,
    sequence: SeedSequence,
    trials: range,
    shape: tuple[int, int],
    only: Iterable[str] | None = None,
) -> tuple[Array, dict[str, int]]:
    """Return the values (trial, place, freedom) of trials, NaN for failed ones, and the number of failures by reason.

    Parameters
    ----------
    method : Method
    trial_model : TrialModel
    sequence : SeedSequence
        Seed of the block; the seed of a trial follows from its number.
    trials : range
        Numbers of the trials.
    shape : (int, int)
        Places and freedoms.
    only : iterable of str, optional
        Active sources; default: all.
    """
    found, reasons = np.full((len(trials), *shape), np.nan), dict[str, int]()
    for row, number in enumerate(trials):
        own = SeedSequence(sequence.entropy, spawn_key=(*sequence.spawn_key, number))
        try:
            values = values_of(trial(method, trial_model, own, only))
        except ErrormotionError as error:
            reason = str(error).splitlines()[0]
        else:
            if values.shape == shape:
                found[row] = values
                continue
            reason = f"a trial has {values.shape[0]} places instead of {shape[0]}"
        reasons[reason] = reasons.get(reason, 0) + 1
    return found, reasons
