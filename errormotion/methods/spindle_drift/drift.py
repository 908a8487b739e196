"""From a drift record to the spindle's error dataset."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.datasets import build_errors, provenance
from errormotion.errors import MethodError
from errormotion.methods.spindle_drift import iso230_3
from errormotion.methods.spindle_drift.averaging import Averager, Averages, join, slices
from errormotion.methods.spindle_drift.bar import SIDE, end_point, fit_axis
from errormotion.methods.spindle_drift.uncertainty import (
    CHANNELS,
    Frame,
    Source,
    State,
    beam_sources,
    propagate,
    radius_source,
    reading_sources,
    twist,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.spindle_drift.settings import Settings

    Array = NDArray[np.float64]

log = logging.getLogger(__name__)

# Where the noise seen exceeds the stated one by more than chance allows (about one record in a thousand).
_CHANCE = 3.3
_ENOUGH = 30


@dataclass(frozen=True)
class Record:
    """A drift record brought down to means, on one clock."""

    averages: Averages
    temperature: Array | None
    spindle_speed: Array | None


def average_record(raw: xr.Dataset, settings: Settings) -> Record:
    """Bring a record down to means in one pass and constant memory; ``raw`` has its channels in order."""
    slow = [name for name in ("temperature", "spindle_speed") if name in raw and "time" in raw[name].dims]
    averager = Averager(len(CHANNELS), settings.average, settings.min_valid)
    slow_averagers = {name: Averager(raw[name].sizes.get("sensor", 1), settings.average, minimum=0.0) for name in slow}
    parts: list[Averages] = []
    slow_parts: dict[str, list[Averages]] = {name: [] for name in slow}
    for time, part in slices(raw):
        if not (np.isfinite(time).all() and (np.diff(time) > 0).all()):
            raise MethodError("The time of the record does not increase everywhere: expected increasing seconds.")
        parts.append(averager.update(time, part["distance"].transpose("channel", "time").values))
        for name in slow:
            values = part[name].transpose(..., "time").values.astype(np.float64)
            slow_parts[name].append(slow_averagers[name].update(time, values.reshape(-1, time.size)))
    parts.append(averager.finish())
    means = {name: join([*done, slow_averagers[name].finish()]).mean for name, done in slow_parts.items()}
    speed = means.get("spindle_speed")
    if speed is None and "spindle_speed" in raw:
        speed = np.broadcast_to(np.float64(raw["spindle_speed"].values), (1, join(parts).time.size))
    return Record(join(parts), means.get("temperature"), None if speed is None else speed[0])


def identify_drift(raw: xr.Dataset, settings: Settings, method: str, version: str) -> xr.Dataset:
    """Return the spindle's error dataset over ``time``; see the method's page for its equations.

    Raises
    ------
    MethodError
        No valid reference state, beams that do not determine the axis, or a record without time.
    """
    notes: list[str] = []
    raw = raw.sel(channel=list(CHANNELS))
    levels = np.asarray(raw["level"].values, np.float64)
    radius = float(raw["bar_radius"])
    origin, direction, beam_covariance, beam_group = _beams(raw, settings, notes)
    record = average_record(raw, settings)
    averages = record.averages
    mean = averages.mean.copy()
    _count_unknown(averages, notes)
    expansion = _frame_expansion(raw, record, settings, notes)
    # Two passes: the frame's expansion moves the readings along the normals that the first one finds.
    state = _fit(mean, origin, direction, radius, levels)
    reference = _reference_windows(averages, mean, settings)
    frame_change = np.zeros_like(mean)
    if expansion is not None:
        frame_change = _readings_of_shift(expansion, state, origin, direction, levels)
        frame_change -= frame_change[:, reference].mean(axis=1, keepdims=True)
        mean = mean + frame_change
        state = _fit(mean, origin, direction, radius, levels)
    then = _fit(mean[:, reference].mean(axis=1, keepdims=True), origin, direction, radius, levels)
    if not np.isfinite(then.E).all():
        raise MethodError(
            "No cylinder of the stated radius touches the five readings of the reference state. Check bar_radius "
            f"({radius * 1e3:g} mm), the beams' origins and directions, and that the X beams cross the Y beams."
        )
    point = np.round(then.E[0], 4) + 0.0 if settings.functional_point is None else np.array(settings.functional_point)
    frame = Frame(origin, direction, levels, point)
    sigma = _noise(raw, averages, mean, settings, notes)
    sigma_then = np.sqrt(np.sum(sigma[:, reference] ** 2, axis=1)) / reference.size
    sources: list[Source] = [*reading_sources(sigma_then), *beam_sources(beam_covariance, beam_group)]
    if settings.bar_radius_uncertainty:
        sources.append(radius_source(settings.bar_radius_uncertainty))
    scaled = []
    if expansion is not None and settings.frame_expansion_uncertainty:
        scaled.append(("frame expansion", frame_change * settings.frame_expansion_uncertainty))
    errors = twist(state, then, point)
    independent, influence = propagate(state, then, frame, sigma, sources, scaled)
    _within_reference(independent, influence, reference)
    names = [s.name for s in sources] + [name for name, _ in scaled]
    groups = [s.group for s in sources] + [name for name, _ in scaled]
    unseen = np.cross(then.a[0], point - then.E[0]) * settings.unseen_rotation
    if np.linalg.norm(unseen) > 0:
        row = np.zeros((1, len(errors), 6))
        row[..., :3] = unseen
        row[:, reference] = 0.0
        influence = np.concatenate([influence, row])
        names.append("rotation about the spindle axis")
        groups.append("rotation about the spindle axis")
    independent[:, 5, :] = independent[:, :, 5] = np.nan
    influence[..., 5] = np.nan
    covariance = independent + np.einsum("sti,stj->tij", influence, influence)
    zero = float(averages.time[reference].mean())
    time = averages.time - zero
    extras = _extras(raw, averages, mean, state, origin, direction, radius, levels, time)
    results = iso230_3.evaluate(
        iso230_3.quantities(errors, independent, influence, levels - point[2]),
        time,
        temperature=record.temperature,
        sensors=_sensors(raw) if record.temperature is not None else (),
        spindle_speed=record.spindle_speed,
        running_end=settings.running_end,
        sensor=settings.iso_temperature,
    )
    extras |= results.as_extras(time)
    start = str(raw.attrs.get("start", ""))
    coords: dict[str, Any] = {
        "time": ("time", time, {"units": "s", **({"start": start} if start else {})}),
    }
    if record.temperature is not None:
        coords["temperature"] = (("time", "sensor"), record.temperature.T, {"units": "degC"})
        coords["sensor"] = ("sensor", _sensors(raw))
    if record.spindle_speed is not None:
        coords["spindle_speed"] = ("time", record.spindle_speed, {"units": "1/min"})
    for note in notes:
        log.warning(note)
    ds = build_errors(
        errors,
        covariance,
        dims=("time",),
        coords=coords,
        component="spindle",
        machine=str(raw.attrs.get("machine", "unknown")),
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=point,
        reference=(
            f"mean of the record from {averages.time[reference[0]]:.3f} s to {averages.time[reference[-1]]:.3f} s "
            f"(middles of {reference.size} mean{'s' if reference.size > 1 else ''} of {settings.average:g} s)"
        ),
        method=method,
        method_version=version,
        provenance=provenance.make(
            settings, raw, None, steps=["average", "fit bar", "propagate covariance", "ISO 230-3"]
        ),
        influence=influence,
        sources=names,
        source_groups=groups,
        extras=extras,
    )
    return ds.assign_attrs(
        notes=list(notes) or [""],
        reference_time=zero,
        iso_test=results.test,
        iso_temperature_sensor=results.sensor,
        beams=settings.beams,
    )


def _fit(mean: Array, origin: Array, direction: Array, radius: float, levels: Array) -> State:
    q = fit_axis(mean, origin, direction, radius, levels)
    a, E = end_point(q, mean[4], origin[4], direction[4], levels)
    return State(mean, q, a, E)


def _beams(raw: xr.Dataset, settings: Settings, notes: list[str]) -> tuple[Array, Array, Array, str]:
    """Return origins, directions (5, 3), covariance (5, 6, 6) and the budget's name for it."""
    nominal = settings.beams == "nominal"
    if nominal and "nominal_origin" not in raw:
        raise MethodError(
            "beams = 'nominal' needs nominal_origin and nominal_direction(channel, direction) in the raw dataset; they "
            "are not there. Use beams = 'raw'."
        )
    origin = np.asarray(raw["nominal_origin" if nominal else "beam_origin"].values, np.float64)
    direction = np.asarray(raw["nominal_direction" if nominal else "beam_direction"].values, np.float64)
    if not (np.isfinite(origin).all() and np.isfinite(direction).all()):
        lost = [c for c, o, u in zip(CHANNELS, origin, direction, strict=True) if not np.isfinite([*o, *u]).all()]
        raise MethodError(
            f"The beam of {', '.join(lost)} is not known (NaN): expected origin and direction of all five."
        )
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    flat = direction[:SIDE, :2] / np.linalg.norm(direction[:SIDE, :2], axis=1, keepdims=True)
    for i, j in ((0, 2), (0, 3), (1, 2), (1, 3)):
        sine = abs(flat[i, 0] * flat[j, 1] - flat[i, 1] * flat[j, 0])
        if sine < 0.1:
            raise MethodError(
                f"The beams {CHANNELS[i]} and {CHANNELS[j]} are parallel to {np.degrees(np.arcsin(sine)):.1f} deg: the "
                "bar could move across both unseen. Expected X beams across Y beams; check beam_direction."
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
        return origin, direction, covariance, "beam calibration"
    notes.append("The raw dataset states no beam_covariance: the beams count as exact in the uncertainty.")
    return origin, direction, np.zeros((5, 6, 6)), "beam calibration"


def _count_unknown(averages: Averages, notes: list[str]) -> None:
    for channel, row, counts in zip(CHANNELS, averages.mean, averages.count, strict=True):
        unknown = np.isnan(row)
        if unknown.all():
            raise MethodError(
                f"Channel {channel} has no valid reading in the whole record: check the sensor and its cable."
            )
        if unknown.any():
            first, last = averages.time[unknown][[0, -1]]
            notes.append(
                f"{channel}: {unknown.sum()} of {row.size} means are unknown, between {first:.1f} s and {last:.1f} s "
                f"({averages.expected.sum() - counts.sum()} samples lost in all); the errors there are NaN."
            )


def _reference_windows(averages: Averages, mean: Array, settings: Settings) -> NDArray[np.int64]:
    begin = averages.time[0] + settings.reference_time
    length = settings.reference_average or 0.0
    inside = (averages.time >= begin - 1e-6) & (averages.time < begin + max(length - 0.5 * settings.average, 1e-6))
    if not inside.any():
        later = np.flatnonzero(averages.time >= begin - 1e-6)
        if later.size == 0:
            raise MethodError(
                f"The record ends at {averages.time[-1]:.1f} s; the reference state was to begin at "
                f"{settings.reference_time:g} s (reference_time)."
            )
        inside[later[0]] = True
    known = inside & np.isfinite(mean).all(axis=0)
    if not known.any():
        lost = [c for c, row in zip(CHANNELS, mean[:, inside], strict=True) if np.isnan(row).all()]
        raise MethodError(
            f"The reference state at {begin:.1f} s has no valid reading of {', '.join(lost) or 'all channels at once'}"
            ". Choose another one with reference_time and reference_average."
        )
    return np.flatnonzero(known)


def _frame_expansion(raw: xr.Dataset, record: Record, settings: Settings, notes: list[str]) -> Array | None:
    """Return how far each beam's origin has moved with the frame's temperature, (5, 3, instant), m."""
    if not settings.compensate_frame or "frame_expansion" not in raw:
        return None
    if record.temperature is None or settings.frame_temperature not in _sensors(raw):
        notes.append(
            f"The frame's expansion is known but not its temperature (no sensor '{settings.frame_temperature}'): the "
            "errors are not corrected for it."
        )
        return None
    temperature = record.temperature[_sensors(raw).index(settings.frame_temperature)]
    per_kelvin = np.asarray(raw["frame_expansion"].transpose("channel", "direction").values, np.float64)
    change = temperature - temperature[np.isfinite(temperature)][0] if np.isfinite(temperature).any() else temperature
    if np.isnan(change).any():
        notes.append(
            f"The frame's temperature is unknown in {int(np.isnan(change).sum())} means; the errors there are NaN."
        )
    return np.asarray(per_kelvin[:, :, None] * change)


def _readings_of_shift(shift: Array, state: State, origin: Array, direction: Array, levels: Array) -> Array:
    """Return what a shift of the origins (5, 3, instant) does to the readings of an unmoved bar, as a correction."""
    A = np.column_stack([state.q[:, :2], np.full(len(state.q), levels[0])])
    S = origin[:, None] + direction[:, None] * state.distance[:, :, None]
    w = S - A
    n = w - np.einsum("cti,ti->ct", w, state.a)[..., None] * state.a
    n[4] = state.a
    along = np.einsum("cti,ci->ct", n, direction)
    return np.asarray(np.einsum("cti,cit->ct", n, shift) / along)


def _noise(raw: xr.Dataset, averages: Averages, mean: Array, settings: Settings, notes: list[str]) -> Array:
    """Return the standard uncertainty (5, instant) of the means, m: as stated, or as seen where that is more."""
    stated = float(raw["distance_noise"])
    sigma = stated / np.sqrt(np.maximum(averages.count, 1))
    if settings.noise == "stated":
        return np.asarray(sigma)
    for i, channel in enumerate(CHANNELS):
        # Second differences take out the drift itself; the median takes out steps.
        second = np.diff(mean[i] / sigma[i], 2) / np.sqrt(6.0)
        second = second[np.isfinite(second)]
        if second.size < _ENOUGH:
            continue
        seen = float(np.median(np.abs(second)) / 0.674490)
        # Spread of a median-based deviation of overlapping second differences, from simulation: 1.7 / sqrt(2 n).
        if seen > 1.0 + _CHANCE * 1.7 / np.sqrt(2 * second.size):
            notes.append(
                f"{channel}: the means scatter {seen:.2f} times as much as the stated noise of {stated * 1e6:.3g} um a "
                "sample explains; the uncertainty is raised to what is seen."
            )
            sigma[i] *= seen
    return np.asarray(sigma)


def _within_reference(independent: Array, influence: Array, reference: NDArray[np.int64]) -> None:
    """Errors inside the reference state share their noise with it: what is left of it is 1 - 1/m of each mean."""
    independent[reference] *= 1.0 - 1.0 / reference.size
    influence[:5, reference] = 0.0


def _sensors(raw: xr.Dataset) -> list[str]:
    return (
        [str(name) for name in raw["sensor"].values]
        if "sensor" in raw.coords
        else [f"T{k + 1}" for k in range(raw.sizes.get("sensor", 0))]
    )


def _extras(
    raw: xr.Dataset,
    averages: Averages,
    mean: Array,
    state: State,
    origin: Array,
    direction: Array,
    radius: float,
    levels: Array,
    time: Array,
) -> dict[str, xr.DataArray]:
    channel = ("channel", list(CHANNELS))
    axis = ("direction", list("xyz"))

    def over_channel(values: Array, unit: str) -> xr.DataArray:
        return xr.DataArray(
            values, coords={"channel": channel, "time": time}, dims=("channel", "time"), attrs={"units": unit}
        )

    # What the fitted bar would have shown; zero but for rounding, where the fit is exact.
    S = origin[:, None] + direction[:, None] * mean[:, :, None]
    w = S - np.column_stack([state.q[:, :2], np.full(len(state.q), levels[0])])
    off = w - np.einsum("cti,ti->ct", w, state.a)[..., None] * state.a
    residual = np.linalg.norm(off, axis=2) - radius
    residual[4] = np.einsum("ti,ti->t", S[4] - state.E, state.a)
    first = int(np.flatnonzero(np.isfinite(state.E).all(axis=1))[0])
    vectors = {"beam_origin": (origin, "m"), "beam_direction": (direction, "1")}
    extras = {
        name: xr.DataArray(
            values, coords={"channel": channel, "direction": axis}, dims=("channel", "direction"), attrs={"units": unit}
        )
        for name, (values, unit) in vectors.items()
    }
    extras |= {
        "fit_residual": over_channel(residual, "m"),
        "distance_mean": over_channel(averages.mean, "m"),
        "valid_fraction": over_channel(averages.count / np.maximum(averages.expected, 1), "1"),
        "bar_axis_point": xr.DataArray(
            state.E[first], coords={"direction": axis}, dims="direction", attrs={"units": "m"}
        ),
        "bar_axis_direction": xr.DataArray(
            state.a[first], coords={"direction": axis}, dims="direction", attrs={"units": "1"}
        ),
        "bar_radius": xr.DataArray(radius, attrs={"units": "m"}),
        "level_height": xr.DataArray(levels, coords={"level": ["L1", "L2"]}, dims="level", attrs={"units": "m"}),
    }
    for name in ("dropped_samples", "invalid_samples"):
        if name in raw:
            extras[name] = raw[name].reset_coords(drop=True).load()
    return extras
