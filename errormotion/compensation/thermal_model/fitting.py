"""Making a thermal model: which sensors, which lags or time constants, how much regularisation.

Everything is chosen by the error at campaigns that were left out whole: samples of one warm-up resemble their
neighbours so much that leaving out samples would praise any model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from scipy.stats import t as student

from errormotion.compensation.thermal_model import regression
from errormotion.compensation.thermal_model.features import Feature, dynamics, lagged
from errormotion.compensation.thermal_model.model import Parts, ThermalModel
from errormotion.compensation.thermal_model.record import instruments_of, read_record
from errormotion.compensation.thermal_model.settings import Settings
from errormotion.datasets import provenance
from errormotion.errors import DatasetError

LAGS: tuple[tuple[float, ...], ...] = ((), (600.0,), (1800.0,), (600.0, 1800.0))
TIME_CONSTANTS: tuple[tuple[float, ...], ...] = (
    (600.0,),
    (1800.0,),
    (5400.0,),
    (600.0, 3600.0),
    (300.0, 1800.0, 7200.0),
)
"""Tried where the settings name none, s."""

SAME = ("component", "frame", "reference", "machine")
"""Attributes in which the campaigns of one model have to agree."""

LEAST_SAMPLES = 8
"""Known errors without which nothing is fitted."""


@dataclass(frozen=True)
class Candidate:
    """One way to make the model, and how well it predicts campaigns that it has not seen.

    Attributes
    ----------
    variant : str
    sensors : tuple of str
    constants : tuple of float
        Lags or time constants, s.
    features : tuple of Feature
    score : float
        Sum over the freedoms of the mean square error as a share of the mean square of the errors themselves.
    """

    variant: str
    sensors: tuple[str, ...]
    constants: tuple[float, ...]
    features: tuple[Feature, ...]
    score: float


def fit(campaigns: Sequence[xr.Dataset], settings: Settings | None = None) -> ThermalModel:
    """Make a thermal model of measured warm-ups.

    Parameters
    ----------
    campaigns : sequence of Dataset
        Error datasets over time with ``temperature(time, sensor)``; two or more for a model that can be trusted. Of one
        alone, blocks in time take the place of campaigns, and the model says so.
    settings : Settings, optional

    Returns
    -------
    ThermalModel

    Raises
    ------
    DatasetError
        Campaigns of different machines, components or functional points, without common sensors, or too few values.
    """
    settings = settings or Settings()
    if not campaigns:
        raise DatasetError("A thermal model needs the errors of at least one campaign; found none.")
    _check_alike(campaigns)
    records = [read_record(ds, f"campaign {number + 1}") for number, ds in enumerate(campaigns)]
    seen = [k for k in range(6) if sum(int(np.isfinite(r.errors[:, k]).sum()) for r in records) >= LEAST_SAMPLES]
    if not seen:
        raise DatasetError(f"Expected at least {LEAST_SAMPLES} known values of an error in all campaigns; found fewer.")
    columns = regression.Columns(records)
    best, tried = _chosen(columns, seen, settings)
    return _made(campaigns, columns, seen, best, tried, settings)


def _check_alike(campaigns: Sequence[xr.Dataset]) -> None:
    first = campaigns[0]
    hashes = [provenance.hash_dataset(ds) for ds in campaigns]
    for number, ds in enumerate(campaigns[1:], start=2):
        if (same := hashes.index(hashes[number - 1]) + 1) < number:
            raise DatasetError(f"Campaign {number} is campaign {same} again: it cannot tell what a model is worth.")
        for name in SAME:
            if ds.attrs.get(name) != first.attrs.get(name):
                raise DatasetError(
                    f"Campaign {number}: expected {name} '{first.attrs.get(name)}' as in the first; "
                    f"found '{ds.attrs.get(name)}'"
                )
        here, there = (np.asarray(each.attrs["functional_point"], dtype=float) for each in (ds, first))
        if not np.allclose(here, there, atol=1e-6):
            raise DatasetError(
                f"Campaign {number}: expected the functional point {there.tolist()} m as in the first; found "
                f"{here.tolist()} m. Move the errors with ds.em.at(point)."
            )


def _chosen(columns: regression.Columns, seen: Sequence[int], settings: Settings) -> tuple[Candidate, list[Candidate]]:
    """Return the best candidate, and the best of every variant and set of constants."""
    records = columns.records
    temperatures = [r.inputs.temperature for r in records]
    common = [n for n in temperatures[0] if all(np.isfinite(known.get(n, np.nan)).any() for known in temperatures)]
    if settings.sensors is not None:
        missing = [name for name in settings.sensors if name not in common]
        if missing:
            raise DatasetError(
                f"sensors: expected names that all campaigns have ({', '.join(common)}); found {', '.join(missing)}"
            )
    parameters = tuple(
        name
        for name, wanted in (("spindle_speed", settings.use_speed), ("feed", settings.use_feed))
        if wanted and all(name in r.inputs.parameter for r in records)
    )
    variants = ("lagged", "dynamics") if settings.variant == "auto" else (settings.variant,)
    tried = []
    for variant in variants:
        given = settings.lags if variant == "lagged" else settings.time_constants
        for constants in (LAGS if variant == "lagged" else TIME_CONSTANTS) if given is None else (given,):
            best = _with_sensors(columns, seen, variant, constants, common, parameters, settings)
            if best is not None:
                tried.append(best)
    if not tried:
        raise DatasetError("A thermal model needs a temperature that all campaigns have, or the spindle's speed.")
    return min(tried, key=lambda candidate: candidate.score), tried


def _with_sensors(
    columns: regression.Columns,
    seen: Sequence[int],
    variant: str,
    constants: tuple[float, ...],
    common: Sequence[str],
    parameters: tuple[str, ...],
    settings: Settings,
) -> Candidate | None:
    """Return the candidate with the sensors that were asked for, or one sensor after the other while it pays."""

    def candidate(sensors: tuple[str, ...]) -> Candidate | None:
        features = lagged(sensors, constants) if variant == "lagged" else dynamics(sensors, constants, parameters)
        return Candidate(variant, sensors, constants, features, _score(columns, seen, features)) if features else None

    if settings.sensors is not None:
        return candidate(settings.sensors)
    best = candidate(())
    while len(best.sensors if best else ()) < settings.most_sensors:
        chosen = best.sensors if best else ()
        further = [found for name in common if name not in chosen and (found := candidate((*chosen, name)))]
        if not further:
            break
        next_best = min(further, key=lambda each: each.score)
        # The score is a square: a gain of 3 % in the error is one of 6 % in it.
        if best is not None and next_best.score > best.score * (1 - settings.least_gain) ** 2:
            break
        best = next_best
    return best


def _score(columns: regression.Columns, seen: Sequence[int], features: Sequence[Feature]) -> float:
    X, _ = columns.of(features)
    group = regression.groups(columns.records)
    total = 0.0
    for freedom in seen:
        y, weight = regression.target(columns.records, freedom)
        size = regression.mean_square(y, weight)
        if size > 0:
            total += regression.best_strength(X, y, weight, group)[1] / size
    return total


def _made(
    campaigns: Sequence[xr.Dataset],
    columns: regression.Columns,
    seen: Sequence[int],
    best: Candidate,
    tried: Sequence[Candidate],
    settings: Settings,
) -> ThermalModel:
    X, scale = columns.of(best.features)
    group = regression.groups(columns.records)
    p = len(best.features)
    coefficient = np.full((6, p), np.nan)
    covariance = np.full((6, p, p), np.nan)
    misfit = np.full(6, np.nan)
    strengths = np.full(6, np.nan)
    share = np.full(6, np.nan)
    for k in seen:
        y, weight = regression.target(columns.records, k)
        strength, _, residual = regression.best_strength(X, y, weight, group)
        known = (weight > 0) & np.isfinite(X).all(axis=1)
        A = (X[known] * weight[known, None]).T @ X[known]
        strengths[k] = strength
        coefficient[k] = regression.solve(X[known], y[known], weight[known], np.array([strength]))[0] / scale
        # Campaigns differ: the one that was predicted worst says what to expect of the next.
        square = max(
            found
            for number in np.unique(group)
            if np.isfinite(found := regression.mean_square(residual[group == number], weight[group == number]))
        )
        freedom = max(regression.effective_count(residual, group), 1.0)
        # A standard uncertainty with few degrees of freedom, widened so that twice of it still makes 95 %.
        misfit[k] = np.sqrt(square) * student.ppf(0.975, freedom) / student.ppf(0.975, np.inf)
        inverse = np.linalg.inv(A + strength * weight[known].sum() * np.eye(p))
        alike = known.sum() / freedom  # rows that are worth one
        covariance[k] = square * alike * inverse / np.outer(scale, scale)
        share[k] = 1 - np.sqrt(regression.mean_square(residual, weight) / regression.mean_square(y, weight))
    physical = X[np.isfinite(X).all(axis=1)] * scale
    parts = Parts(
        best.features, coefficient, covariance, misfit, strengths, share, physical.min(axis=0), physical.max(axis=0)
    )
    table = [
        {"variant": c.variant, "sensors": list(c.sensors), "constants": list(c.constants), "score": c.score}
        for c in sorted(tried, key=lambda c: c.score)
    ]
    attrs: Mapping[str, object] = {name: campaigns[0].attrs[name] for name in SAME} | {
        "functional_point": np.asarray(campaigns[0].attrs["functional_point"], dtype=float),
        "variant": best.variant,
        "campaigns": len(campaigns),
        "validated": "campaigns left out whole" if len(campaigns) > 1 else "blocks in time of one campaign",
    }
    hashes = [provenance.hash_dataset(ds) for ds in campaigns]
    where = provenance.make(settings, None, instruments_of(campaigns), steps=[{"campaigns": hashes}, {"tried": table}])
    return ThermalModel.of(parts, attrs, where)
