"""Error dataset of the spindle from a drift record."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.datasets.certificates import certified
from errormotion.datasets.files.hashing import DatasetHasher
from errormotion.datasets.timing import start_of
from errormotion.errors import MethodError
from errormotion.methods.spindle_drift.identification import iso230_3
from errormotion.methods.spindle_drift.identification.bar import SIDE, end_point, fit_axis
from errormotion.methods.spindle_drift.identification.frame_expansion import (
    frame_warming,
    hats,
    readings_per_kelvin,
    smoothing_sources,
)
from errormotion.methods.spindle_drift.identification.record import (
    average_record,
    count_unknown,
    length_of_means,
    noise,
    reference_windows,
    run_out_at_rest,
    sensors,
    settling,
)
from errormotion.methods.spindle_drift.identification.uncertainty import (
    REFERENCE,
    Frame,
    State,
    beam_sources,
    propagate,
    radius_source,
    reading_sources,
    twist,
)
from errormotion.methods.spindle_drift.schema import CHANNELS
from errormotion.methods.spindle_drift.settings import TrialSettings

CERTIFIED = {"bar radius": ("bar", "radius"), "frame expansion": ("frame", "coefficient of expansion")}
"""Sources that are one draw in all measurements with one certificate."""

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.spindle_drift.identification.averaging import Averages
    from errormotion.methods.spindle_drift.identification.record import Record
    from errormotion.methods.spindle_drift.settings import Settings


log = logging.getLogger(__name__)

UNSEEN = "rotation about the spindle axis"
"""Group of the influence of what the method does not see."""
_UNSEEN_KNOTS = 8


def identify_drift(raw: xr.Dataset, settings: Settings, method: str, version: str) -> xr.Dataset:
    """Return the error dataset of the spindle over ``time``; the equations are in the documentation of the method.

    Raises
    ------
    MethodError
        No valid reference state, beams that do not determine the axis, or a record without time.
    """
    notes: list[str] = []
    with DatasetHasher(raw) as hasher:
        record = average_record(raw, settings, hasher)
        raw_hash = hasher.value()
    measured, raw = raw, raw.drop_vars("distance").sel(channel=list(CHANNELS))
    averages = record.averages
    count_unknown(averages, notes)
    if averages.time.size < 2:
        span = float(averages.time.size * settings.average)
        raise MethodError(
            f"The record gives {averages.time.size} mean of {settings.average:g} s; expected at least two. "
            f"Reduce 'average', or record longer than {2 * span:g} s."
        )
    bar = _bar(raw, settings, notes)
    coming_up = settling(record, settings.spin_up)
    reference = reference_windows(averages, settings, coming_up, notes)
    mean, effects, single = _compensated(raw, record, bar, reference, settings, notes)
    state, then = _fit(mean, bar), _fit(mean[:, reference].mean(axis=1, keepdims=True), bar)
    if not np.isfinite(then.E).all():
        raise MethodError(
            "No cylinder of the stated radius fits the readings of the reference state. Check bar_radius "
            f"({bar.radius * 1e3:g} mm), the beams' origins and directions, and that the X beams cross the Y beams."
        )
    _check_senses(then, bar)
    point = np.round(then.E[0], 4) + 0.0 if settings.functional_point is None else np.array(settings.functional_point)
    errors = twist(state, then, point)
    sigma = noise(raw, record, settings, notes)
    sources = [
        *reading_sources(np.sqrt(np.sum(sigma[:, reference] ** 2, axis=1)) / reference.size),
        *beam_sources(bar.origin, bar.direction, bar.covariance, bar.source, calibrated=settings.beams != "nominal"),
        *([radius_source(settings.bar_radius_uncertainty)] if settings.bar_radius_uncertainty else []),
    ]
    if not settings.bar_radius_uncertainty:
        notes.append("Assumed: no uncertainty of the radius of the bar (bar_radius_uncertainty = 0).")
    frame = Frame(bar.origin, bar.direction, bar.levels, point)
    independent, influence = propagate(state, then, frame, sigma, sources, [change for *_, change in effects], single)
    # Errors inside the reference state share its noise: the share 1 - 1/m of each mean remains.
    independent[reference] *= 1.0 - 1.0 / reference.size
    influence[:, reference] = 0.0
    independent[:, 5, :] = independent[:, :, 5] = influence[..., 5] = np.nan
    if coming_up.any():
        errors[coming_up] = np.nan
        notes.append(
            f"{int(coming_up.sum())} means within {settings.spin_up:g} s of a change of the spindle's speed are NaN."
        )
    zero = float(averages.time[reference].mean())
    time = averages.time - zero
    results = None
    if not isinstance(settings, TrialSettings):
        results = iso230_3.evaluate(
            iso230_3.quantities(errors, independent, influence, bar.levels - point[2], then.E[0] - point),
            time,
            temperature=record.temperature,
            sensors=sensors(raw) if record.temperature is not None else (),
            spindle_speed=record.spindle_speed,
            running_end=None if settings.running_end is None else settings.running_end - zero,
            sensor=settings.iso_temperature,
            average=settings.iso_average,
            reference=reference,
            mean=length_of_means(averages, settings),
            changes=[event.at - zero for event in settings.schedule if event.compensation],
        )
    names = [(s.name, s.group) for s in sources] + [(name, group) for name, group, _ in effects]
    unseen = np.cross(then.a[0], point - then.E[0]) * settings.unseen_rotation
    if np.linalg.norm(unseen) > 0:
        rows = _unseen(unseen, averages.time, reference)
        influence = np.concatenate([influence, rows])
        names += [(f"{UNSEEN}, part {k + 1}", UNSEEN) for k in range(len(rows))]
    for note in notes:
        log.warning(note)
    ds = build_errors(
        errors,
        independent + np.einsum("sti,stj->tij", influence, influence),
        dims=("time",),
        coords=_coordinates(raw, record, time) | iso230_3.LABELS,
        component="spindle",
        machine=str(raw.attrs.get("machine", "unknown")),
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=point,
        reference=(
            f"mean of the record from {averages.time[reference[0]] - settings.average / 2:.3f} s to "
            f"{averages.time[reference[-1]] + settings.average / 2:.3f} s"
        ),
        method=method,
        method_version=version,
        measured=raw.attrs,
        provenance=provenance.make(
            settings,
            measured,
            None,
            steps=["average", "fit bar", "propagate covariance", "ISO 230-3"],
            raw_hash=raw_hash,
        ),
        influence=influence,
        sources=[name for name, _ in names],
        source_groups=[group for _, group in names],
        extras={} if results is None else _extras(raw, averages, mean, state, bar) | results.as_extras(len(influence)),
        start=start_of(raw, zero),
        source_ids={s.name: s.identity for s in sources if s.identity}
        | certified(raw.attrs, {name: CERTIFIED[name] for name, _ in names if name in CERTIFIED}),
        reference_sources=[s.name for s in sources if s.group == REFERENCE],
        reference_interval=(float(time[reference[0]]), float(time[reference[-1]])),
    )
    if results is None:
        return ds
    return ds.assign_attrs(
        notes=list(notes) or [""],
        reference_time=zero,
        iso_test=results.test,
        iso_temperature_sensor=results.sensor,
        beams=settings.beams,
    )


def _check_senses(then: State, bar: Bar) -> None:
    """Refuse beams that point from the bar to the sensor."""
    S = bar.origin + bar.direction * then.distance
    level = np.array([*then.q[0, :2], bar.levels[0]])
    w = S - level
    outward = w - (w @ then.a[0])[:, None] * then.a[0]
    outward[4] = then.E[0] - np.array([*then.q[0].reshape(2, 2).mean(axis=0), bar.levels.mean()])
    leaving = [c for c, n, u in zip(CHANNELS, outward, bar.direction, strict=True) if n @ u > 0]
    if leaving:
        raise MethodError(
            f"The beam of {', '.join(leaving)} points away from the bar. Expected beam_direction from the sensor to "
            "the bar, "
            "and readings that increase with the distance of the bar; check the sign of the direction."
        )


def _compensated(
    raw: xr.Dataset, record: Record, bar: Bar, reference: NDArray[np.int64], settings: Settings, notes: list[str]
) -> tuple[Array, list[tuple[str, str, Array]], Array]:
    """Return the mean readings corrected for the expansion of the frame, disturbances, and one of each instant alone.

    A disturbance that instants share is (name, group, change). The correction acts along the surface normals of a first
    fit.
    """
    mean = record.averages.mean
    effects = run_out_at_rest(record, reference, float(raw["distance_noise"]))
    warming = frame_warming(raw, record, settings, notes)
    if warming is None:
        return mean, effects, np.zeros(mean.shape)
    per_kelvin = readings_per_kelvin(warming, _fit(mean, bar), bar.origin, bar.direction, bar.levels)
    change = per_kelvin * (warming.temperature - warming.temperature[reference].mean())
    effects.append(("frame expansion", "frame expansion", change * settings.frame_expansion_uncertainty))
    unknown, own = smoothing_sources(warming.smoothing, warming.noise, record.averages.time, reference)
    for k, u in enumerate(unknown, start=1):
        effects.append((f"frame temperature, part {k}", "frame temperature", per_kelvin * u))
    return mean + change, effects, per_kelvin * own


def _unseen(effect: Array, time: Array, reference: NDArray[np.int64]) -> Array:
    """Return the influence (source, instant, 6) of the unknown rotation about the axis, zero in the reference state.

    The rotation changes as the head warms. It is modelled by knots over the record, each one draw, so that distant
    instants are nearly independent. EC remains unknown.
    """
    weights = hats(time, _UNSEEN_KNOTS)
    weights = (weights - weights[:, reference].mean(axis=1, keepdims=True)) / np.sqrt(2.0)
    rows = np.full((len(weights), time.size, 6), np.nan)
    rows[..., :3] = weights[..., None] * effect
    rows[..., 3:5] = 0.0
    rows[:, reference, :5] = 0.0
    return rows


@dataclass(frozen=True)
class Bar:
    """Known geometry: beams (5, 3) with their covariance (5, 6, 6), bar radius and levels, SI."""

    origin: Array
    direction: Array
    covariance: Array
    source: str
    radius: float
    levels: Array


def _bar(raw: xr.Dataset, settings: Settings, notes: list[str]) -> Bar:
    levels = np.asarray(raw["level"].values, np.float64)
    if not abs(levels[1] - levels[0]) > 1e-3:
        raise MethodError(
            f"The levels L1 and L2 are {levels[0] * 1e3:g} mm and {levels[1] * 1e3:g} mm: expected two heights at "
            "least 1 mm apart."
        )
    return Bar(*beams_of(raw, settings, notes), float(raw["bar_radius"]), levels)


def _fit(mean: Array, bar: Bar) -> State:
    q = fit_axis(mean, bar.origin, bar.direction, bar.radius, bar.levels)
    return State(mean, q, *end_point(q, mean[4], bar.origin[4], bar.direction[4], bar.levels))


def beams_of(raw: xr.Dataset, settings: Settings, notes: list[str]) -> tuple[Array, Array, Array, str]:
    """Return origins, directions (5, 3), covariance (5, 6, 6) and the budget's name for it."""
    nominal = settings.beams == "nominal"
    if nominal and "nominal_origin" not in raw:
        raise MethodError(
            "beams = 'nominal' needs nominal_origin and nominal_direction(channel, direction), which the raw dataset "
            "does not have. Use beams = 'raw'."
        )
    of_channel = raw[[f"{'nominal' if nominal else 'beam'}_{part}" for part in ("origin", "direction")]]
    origin, direction = (
        np.asarray(each.transpose("channel", "direction").values, np.float64) for each in of_channel.values()
    )
    if not (np.isfinite(origin).all() and np.isfinite(direction).all()):
        lost = [c for c, o, u in zip(CHANNELS, origin, direction, strict=True) if not np.isfinite([*o, *u]).all()]
        raise MethodError(f"The beam of {', '.join(lost)} is unknown (NaN); expected origin and direction of all five.")
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    flat = direction[:SIDE, :2] / np.linalg.norm(direction[:SIDE, :2], axis=1, keepdims=True)
    for i, j in ((0, 2), (0, 3), (1, 2), (1, 3)):
        sine = abs(flat[i, 0] * flat[j, 1] - flat[i, 1] * flat[j, 0])
        if sine < 0.1:
            raise MethodError(
                f"The beams {CHANNELS[i]} and {CHANNELS[j]} are parallel within {np.degrees(np.arcsin(sine)):.1f} "
                "deg, so "
                "that they do not determine the position of the bar. Expected X beams across Y beams; check "
                "beam_direction."
            )
    if nominal:
        covariance = np.zeros((5, 6, 6))
        for i in range(5):
            covariance[i, :3, :3] = np.eye(3) * settings.nominal_origin_uncertainty**2
            across = np.eye(3) - np.outer(direction[i], direction[i])
            covariance[i, 3:, 3:] = across * settings.nominal_direction_uncertainty**2
        return origin, direction, covariance, "nominal beams"
    if "beam_covariance" in raw:
        covariance = np.asarray(raw["beam_covariance"].transpose("channel", "p", "p_").values, np.float64)
        if raw.attrs.get("beam_uncertainty") == "assumed":
            notes.append("The uncertainty of the beams is assumed: the map of the imported log states none.")
        return origin, direction, covariance, "beam calibration"
    notes.append("The raw dataset states no beam_covariance: the beams are assumed to be exact.")
    return origin, direction, np.zeros((5, 6, 6)), "beam calibration"


def _coordinates(raw: xr.Dataset, record: Record, time: Array) -> dict[str, Any]:
    start = str(raw.attrs.get("start", ""))
    coords: dict[str, Any] = {
        "time": ("time", time, {"units": "s", **({"start": start} if start else {})}),
        "channel": list(CHANNELS),
        "direction": list("xyz"),
    }
    if record.temperature is not None:
        coords["temperature"] = (("time", "sensor"), record.temperature.T, {"units": "degC"})
        coords["sensor"] = ("sensor", sensors(raw))
    if record.spindle_speed is not None:
        coords["spindle_speed"] = ("time", record.spindle_speed, {"units": "1/min"})
    return coords


def _extras(raw: xr.Dataset, averages: Averages, mean: Array, state: State, bar: Bar) -> dict[str, xr.DataArray]:
    def over_channel(values: Array, unit: str) -> xr.DataArray:
        return xr.DataArray(values, dims=("channel", "time"), attrs={"units": unit})

    # Distances of the measured points from the fitted bar; zero within rounding where the fit is exact.
    S = bar.origin[:, None] + bar.direction[:, None] * mean[:, :, None]
    w = S - np.column_stack([state.q[:, :2], np.full(len(state.q), bar.levels[0])])
    off = w - np.einsum("cti,ti->ct", w, state.a)[..., None] * state.a
    residual = np.linalg.norm(off, axis=2) - bar.radius
    residual[4] = np.einsum("ti,ti->t", S[4] - state.E, state.a)
    first = int(np.flatnonzero(np.isfinite(state.E).all(axis=1))[0])
    vectors = {"beam_origin": (bar.origin, "m"), "beam_direction": (bar.direction, "1")}
    extras = {
        name: xr.DataArray(values, dims=("channel", "direction"), attrs={"units": unit})
        for name, (values, unit) in vectors.items()
    }
    extras |= {
        "fit_residual": over_channel(residual, "m"),
        "distance_mean": over_channel(averages.mean, "m"),
        "valid_fraction": over_channel(averages.count / np.maximum(averages.expected, 1), "1"),
        "bar_axis_point": xr.DataArray(state.E[first], dims="direction", attrs={"units": "m"}),
        "bar_axis_direction": xr.DataArray(state.a[first], dims="direction", attrs={"units": "1"}),
        "bar_radius": xr.DataArray(bar.radius, attrs={"units": "m"}),
        "level_height": xr.DataArray(bar.levels, dims="level", attrs={"units": "m"}),
    }
    for name in ("dropped_samples", "invalid_samples"):
        if name in raw:
            extras[name] = raw[name].reset_coords(drop=True).load()
    return extras
