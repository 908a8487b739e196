"""Fit of a thermal model: selection of sensors, lags or time constants, and regularisation.

All are selected by cross-validation that leaves out whole campaigns: neighbouring samples of a warm-up are so similar
that leaving out single samples would favour any model. A single campaign is divided into blocks in time. These have the
same speeds and therefore validate neither the coefficients at other speeds nor a model without sensors. The score then
includes the variance of the coefficients, and the model has at least one sensor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.compensation.thermal_model import training
from errormotion.compensation.thermal_model.features import Feature, dynamics, lagged
from errormotion.compensation.thermal_model.model import Parts, ThermalModel
from errormotion.compensation.thermal_model.record import instruments_of, read_record
from errormotion.compensation.thermal_model.settings import ThermalModelSettings
from errormotion.datasets import provenance
from errormotion.errors import DatasetError
from errormotion.estimation import ridge
from errormotion.estimation.variance import expansion

LAGS: tuple[tuple[float, ...], ...] = ((), (600.0,), (1800.0,), (600.0, 1800.0))
TIME_CONSTANTS: tuple[tuple[float, ...], ...] = (
    (600.0,),
    (1800.0,),
    (5400.0,),
    (600.0, 3600.0),
    (300.0, 1800.0, 7200.0),
)
"""Candidates if the settings have none, s."""

SAME = ("component", "frame", "reference", "machine", "lever_axes")
"""Attributes that must be equal in the campaigns of one model."""

MIN_SAMPLES = 8
"""Smallest number of known values of an error."""

MAX_SENSORS = 500
MAX_VALUES = 1_000_000
"""Maximum number of temperatures (times by sensors) of all campaigns: it limits duration and memory of a fit."""


@dataclass(frozen=True)
class Candidate:
    """A candidate of the model, with its cross-validated error.

    Attributes
    ----------
    variant : str
    sensors : tuple of str
    constants : tuple of float
        Lags or time constants, s.
    features : tuple of Feature
    score : float
        Sum over the errors of the mean square residual over the mean square of the error; for a single campaign
        including the variance by the coefficients (see `_in_use`).
    """

    variant: str
    sensors: tuple[str, ...]
    constants: tuple[float, ...]
    features: tuple[Feature, ...]
    score: float


def fit(campaigns: Sequence[xr.Dataset], settings: ThermalModelSettings | None = None) -> ThermalModel:
    """Fit a thermal model to measured warm-ups.

    Parameters
    ----------
    campaigns : sequence of Dataset
        Error datasets over time with ``temperature(time, sensor)``; two or more for a valid uncertainty. For a single
        one, blocks in time replace the campaigns, and the model states this.
    settings : ThermalModelSettings, optional

    Returns
    -------
    ThermalModel

    Raises
    ------
    DatasetError
        Campaigns of different machines, components or functional points, no common sensors, no error with enough
        values, or more than `MAX_VALUES` or `MAX_SENSORS`.

    Notes
    -----
    The model of an error is NaN if fewer than `MIN_SAMPLES` values are known, or only one of several campaigns has any.
    """
    settings = settings or ThermalModelSettings()
    if not campaigns:
        raise DatasetError("Expected the errors of at least one campaign; found none.", code="model.no_campaigns")
    _check_size(campaigns)
    _check_alike(campaigns)
    records = [read_record(ds, f"campaign {number + 1}") for number, ds in enumerate(campaigns)]
    seen = [k for k in range(6) if _is_known([int(np.isfinite(r.errors[:, k]).sum()) for r in records])]
    if not seen:
        raise DatasetError(
            f"Expected at least {MIN_SAMPLES} known values of an error in all campaigns together, of two campaigns if "
            "there are several; found no such error.",
            code="model.values.too_few",
        )
    columns = training.Columns(records)
    best, tried = _chosen(columns, seen, settings)
    return _made(campaigns, columns, seen, best, tried, settings)


def _is_known(values: Sequence[int]) -> bool:
    """Return whether an error can be modelled, from its number of known values in each campaign.

    Of several campaigns, each is predicted from the others: an error that only one contains has no uncertainty.
    """
    return sum(values) >= MIN_SAMPLES and (len(values) == 1 or sum(map(bool, values)) > 1)


def _check_size(campaigns: Sequence[xr.Dataset]) -> None:
    sensors = max(ds.sizes.get("sensor", 0) for ds in campaigns)
    if sensors > MAX_SENSORS:
        raise DatasetError(
            f"Expected at most {MAX_SENSORS} temperature sensors; found {sensors}.", code="model.sensors.too_many"
        )
    values = sum(ds.sizes.get("time", 0) * max(1, ds.sizes.get("sensor", 0)) for ds in campaigns)
    if values > MAX_VALUES:
        raise DatasetError(
            f"Expected at most {MAX_VALUES} temperatures (times by sensors) in all campaigns together; "
            f"found {values}. Select every tenth time, or fewer sensors.",
            code="model.values.too_many",
        )


def _check_alike(campaigns: Sequence[xr.Dataset]) -> None:
    first = campaigns[0]
    hashes = [provenance.hash_dataset(ds) for ds in campaigns]
    for number, ds in enumerate(campaigns[1:], start=2):
        if (same := hashes.index(hashes[number - 1]) + 1) < number:
            raise DatasetError(
                f"Campaign {number} equals campaign {same}; a validation needs different campaigns.",
                code="model.campaign.same",
            )
        for name in SAME:
            if ds.attrs.get(name) != first.attrs.get(name):
                raise DatasetError(
                    f"Campaign {number}: expected {name} '{first.attrs.get(name)}' as in campaign 1; "
                    f"found '{ds.attrs.get(name)}'",
                    code="model.attribute.differs",
                )
        here, there = (np.asarray(each.attrs["functional_point"], dtype=float) for each in (ds, first))
        if not np.allclose(here, there, atol=1e-6):
            raise DatasetError(
                f"Campaign {number}: expected the functional point {there.tolist()} m as in campaign 1; found "
                f"{here.tolist()} m. Move the errors with ds.em.at(point).",
                code="model.point.differs",
            )


def _chosen(
    columns: training.Columns, seen: Sequence[int], settings: ThermalModelSettings
) -> tuple[Candidate, list[Candidate]]:
    """Return the best candidate, and the best candidates of all variants and constants."""
    records = columns.records
    temperatures = [r.inputs.temperature for r in records]
    common = [n for n in temperatures[0] if all(np.isfinite(known.get(n, np.nan)).any() for known in temperatures)]
    warmed = [n for n in common if any(_has_signal(known[n]) for known in temperatures)]
    if settings.sensors is not None:
        missing = [name for name in settings.sensors if name not in common]
        if missing:
            raise DatasetError(
                f"sensors: expected sensors of all campaigns ({', '.join(common)}); found {', '.join(missing)}",
                code="model.sensors.unknown",
            )
    parameters = tuple(
        name
        for name, wanted in (("spindle_speed", settings.use_speed), ("feed", settings.use_feed))
        if wanted and all(name in r.inputs.parameter for r in records)
    )
    variants = ("lagged", "dynamics") if settings.variant == "auto" else (settings.variant,)
    candidates = []
    for variant in variants:
        given = settings.lags if variant == "lagged" else settings.time_constants
        for constants in (LAGS if variant == "lagged" else TIME_CONSTANTS) if given is None else (given,):
            best = _with_sensors(columns, seen, variant, constants, warmed, parameters, settings)
            if best is not None:
                candidates.append(best)
    if not candidates:
        raise DatasetError(
            "Expected a temperature sensor common to all campaigns that shows more than noise, or the spindle speed; "
            "found neither.",
            code="model.sensors.none",
        )
    return min(candidates, key=lambda candidate: candidate.score), candidates


def _has_signal(temperature: Array) -> bool:
    """Return whether a temperature changes by more than its noise: von Neumann's ratio below 1.

    It is the sum of squared differences of neighbours over that of deviations from the mean: 2 for noise, and below
    1.04 for 1 % of series of 20 values (von Neumann, 1941; table of Hart, 1942).
    """
    known = temperature[np.isfinite(temperature)]
    return bool((np.diff(known) ** 2).sum() < ((known - known.mean()) ** 2).sum())


def _with_sensors(
    columns: training.Columns,
    seen: Sequence[int],
    variant: str,
    constants: tuple[float, ...],
    common: Sequence[str],
    parameters: tuple[str, ...],
    settings: ThermalModelSettings,
) -> Candidate | None:
    """Return the candidate with the given sensors, or with sensors added one by one while the error decreases."""

    def candidate(sensors: tuple[str, ...]) -> Candidate | None:
        features = lagged(sensors, constants) if variant == "lagged" else dynamics(sensors, constants, parameters)
        return Candidate(variant, sensors, constants, features, _score(columns, seen, features)) if features else None

    if settings.sensors is not None:
        return candidate(settings.sensors)
    # One warm-up has one profile of the speed: without a sensor its effect cannot be separated from that of the heat.
    sensed = len(columns.records) == 1 and bool(common) and settings.most_sensors > 0
    best = None if sensed else candidate(())
    while len(best.sensors if best else ()) < settings.most_sensors:
        chosen = best.sensors if best else ()
        further = [found for name in common if name not in chosen and (found := candidate((*chosen, name)))]
        if not further:
            break
        next_best = min(further, key=lambda each: each.score)
        # The score is a mean square.
        if best is not None and next_best.score > best.score * (1 - settings.least_gain) ** 2:
            break
        best = next_best
    return best


def _score(columns: training.Columns, seen: Sequence[int], features: Sequence[Feature]) -> float:
    X, _ = columns.of(features)
    group = training.groups(columns.records)
    use = _in_use(X, features) if len(columns.records) == 1 else None
    total = 0.0
    for freedom in seen:
        y, weight = training.target(columns.records, freedom)
        size = ridge.mean_square(y, weight)
        if size > 0:
            strength, square, residual = ridge.best_strength(X, y, weight, group)
            if use is not None:
                variance = ridge.covariance(X, weight, strength, square, residual, group)
                square += float(np.sum(variance * use))
            total += square / size
    return total


def _in_use(X: Array, features: Sequence[Feature]) -> Array:
    """Return the mean product of two features if each source has 0 to 1 times its values in training, (p, p).

    In one warm-up all sources rise and fall together; at other speeds and air temperatures they do not. With uniform
    and independent factors s, E[s_i s_j] is 1/3 for one source and 1/4 for two.
    """
    known = X[np.isfinite(X).all(axis=1)]
    sources = [(feature.source, feature.power) for feature in features]
    same = np.array([[one == other for other in sources] for one in sources])
    return np.asarray(np.where(same, 1 / 3, 1 / 4) * (known.T @ known) / max(len(known), 1))


def _made(
    campaigns: Sequence[xr.Dataset],
    columns: training.Columns,
    seen: Sequence[int],
    best: Candidate,
    tried: Sequence[Candidate],
    settings: ThermalModelSettings,
) -> ThermalModel:
    X, scale = columns.of(best.features)
    group = training.groups(columns.records)
    p = len(best.features)
    coefficient = np.full((6, p), np.nan)
    covariance = np.full((6, p, p), np.nan)
    misfit = np.full(6, np.nan)
    strengths = np.full(6, np.nan)
    removed = np.full(6, np.nan)
    for k in seen:
        y, weight = training.target(columns.records, k)
        strength, _, residual = ridge.best_strength(X, y, weight, group)
        known = (weight > 0) & np.isfinite(X).all(axis=1)
        strengths[k] = strength
        coefficient[k] = ridge.solve(X[known], y[known], weight[known], np.array([strength]))[0] / scale
        # The campaign with the largest residuals determines the uncertainty of a new one.
        square = max(
            found
            for number in np.unique(group)
            if np.isfinite(found := ridge.mean_square(residual[group == number], weight[group == number]))
        )
        freedom = max(ridge.effective_count(residual, group), 1.0)
        misfit[k] = np.sqrt(square) * expansion(freedom)
        of_scaled = ridge.covariance(X, weight, strength, square, residual, group)
        covariance[k] = of_scaled / np.outer(scale, scale)
        removed[k] = 1 - np.sqrt(ridge.mean_square(residual, weight) / ridge.mean_square(y, weight))
    physical = X[np.isfinite(X).all(axis=1)] * scale
    parts = Parts(
        best.features, coefficient, covariance, misfit, strengths, removed, physical.min(axis=0), physical.max(axis=0)
    )
    table = [
        {"variant": c.variant, "sensors": list(c.sensors), "constants": list(c.constants), "score": c.score}
        for c in sorted(tried, key=lambda c: c.score)
    ]
    attrs: Mapping[str, object] = {name: campaigns[0].attrs[name] for name in SAME if name in campaigns[0].attrs} | {
        "functional_point": np.asarray(campaigns[0].attrs["functional_point"], dtype=float),
        "variant": best.variant,
        "campaigns": len(campaigns),
        "validated": "campaigns left out whole" if len(campaigns) > 1 else "blocks in time of one campaign",
    }
    hashes = [provenance.hash_dataset(ds) for ds in campaigns]
    where = provenance.make(settings, None, instruments_of(campaigns), steps=[{"campaigns": hashes}, {"tried": table}])
    return ThermalModel.of(parts, attrs, where)
