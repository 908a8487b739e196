"""Redrawing of the sources of a drift record or of a beam detection for the Monte Carlo method."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.datasets.files.hashing import DatasetHasher
from errormotion.methods.spindle_drift.identification.detection import segmented
from errormotion.methods.spindle_drift.identification.drift import UNSEEN, beams_of
from errormotion.methods.spindle_drift.identification.frame_expansion import FrameWarming, frame_warming
from errormotion.methods.spindle_drift.identification.record import average_record, noise, run_out_at_rest, sensors
from errormotion.methods.spindle_drift.identification.uncertainty import REFERENCE
from errormotion.methods.spindle_drift.schema import CHANNELS
from errormotion.methods.spindle_drift.settings import TrialSettings
from errormotion.plugins import Redraw, Redrawing, replaced

if TYPE_CHECKING:
    from errormotion.arrays import Array
    from errormotion.methods.spindle_drift.identification.record import Record
    from errormotion.methods.spindle_drift.settings import Settings


def redrawing(raw: xr.Dataset, settings: Settings, errors: xr.Dataset) -> Redrawing:
    """Return the means of a drift record, or the steps of a detection, with their sources of uncertainty."""
    return _detection(raw, settings, errors) if "sphere_radius" in raw else _drift(raw, settings, errors)


def _drift(raw: xr.Dataset, settings: Settings, errors: xr.Dataset) -> Redrawing:
    with DatasetHasher(raw) as hasher:
        record = average_record(raw, settings, hasher)
    averages = record.averages
    raw = raw.drop_vars("distance").sel(channel=list(CHANNELS))
    zero = float(errors.attrs["reference_time"])
    first, last = (float(t) + zero for t in errors.attrs["reference_interval"])
    reference = np.flatnonzero(
        (averages.time > first - 1e-6) & (averages.time < last + 1e-6) & np.isfinite(averages.mean).all(axis=0)
    )
    known = np.isfinite(errors["EX"].values) | np.isin(np.arange(averages.time.size), reference)
    reduced = _means(raw, record, np.where(known, averages.mean, np.nan))
    half = settings.average / 2
    stated: dict[str, Any] = {
        "average": half,
        "spin_up": 0.0,
        "reference_time": max(first - float(averages.time[0]), 0.0),
        "reference_average": last - first + half,
        "functional_point": tuple(map(float, errors.attrs["functional_point"])),
        "frame_smoothing": 0.0,
        "unseen_rotation": 0.0,
        "noise": "stated",
    }
    sigma = noise(raw, record, settings, [])
    _, _, covariance, group = beams_of(raw, settings, [])
    sources = {"readings": _readings(sigma), group: _beams(covariance, settings.beams, group)}
    if settings.bar_radius_uncertainty:
        sources["bar radius"] = _bar_radius(settings.bar_radius_uncertainty)
    rests = run_out_at_rest(record, reference, float(raw["distance_noise"]))
    if rests:
        sources["run-out at rest"] = _changes(np.array([change for *_, change in rests]))
    warming = frame_warming(raw, record, settings, [])
    if warming is not None:
        sources["frame expansion"] = _frame_expansion(settings.frame_expansion_uncertainty)
        index = sensors(raw).index(settings.frame_temperature)
        reduced["temperature"][:, index] = warming.temperature
        if warming.noise > 0:
            sources["frame temperature"] = _frame_temperature(warming, index)
    if settings.unseen_rotation > 0:
        sources[UNSEEN] = _unseen_rotation(errors)
    return Redrawing(reduced, _of_trial(settings).model_copy(update=stated), sources)


def _means(raw: xr.Dataset, record: Record, mean: Array) -> xr.Dataset:
    """Return a record of means, in memory."""
    slow = [name for name in raw.variables if "time" in raw[name].dims]
    attrs = {key: value for key, value in raw.attrs.items() if key not in ("sample_rate", "time_start")}
    means = raw.drop_vars(slow).load().drop_attrs(deep=False).assign_attrs(attrs)
    means = means.assign_coords(time=("time", record.averages.time, {"units": "s"}))
    means["distance"] = (("channel", "time"), mean, {"units": "m"})
    if record.temperature is not None:
        means["temperature"] = (("time", "sensor"), record.temperature.T.copy(), {"units": "degC"})
    if record.spindle_speed is not None:
        means["spindle_speed"] = (("time",), record.spindle_speed, {"units": "1/min"})
    return means


def _shifted(raw: xr.Dataset, name: str, change: Array) -> xr.Dataset:
    """Return raw data with a change added to a variable, whose order of dimensions it has."""
    return replaced(raw, {name: raw.variables[name].values + change})


def _readings(sigma: Array) -> Redraw:
    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        return _shifted(raw, "distance", sigma * generator.normal(size=sigma.shape)), settings

    return Redraw(draw, groups=(REFERENCE,), own=True)


def _beams(covariance: Array, which: str, group: str) -> Redraw:
    """Return origins and directions drawn from their covariance (5, 6, 6), one draw for the record."""
    size = np.sqrt(np.einsum("cii->ci", covariance))
    unit = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(covariance / (unit[:, :, None] * unit[:, None, :]))
    factor = unit[:, :, None] * vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    origin, direction = (f"{'nominal' if which == 'nominal' else 'beam'}_{part}" for part in ("origin", "direction"))

    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        change = np.einsum("cij,cj->ci", factor, generator.normal(size=factor.shape[:2]))
        turned = raw.variables[direction].values + change[:, 3:]
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        moved = raw.variables[origin].values + change[:, :3]
        return replaced(raw, {origin: moved, direction: turned}), settings

    return Redraw(draw, groups=(group,))


def _bar_radius(uncertainty: float) -> Redraw:
    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        return _shifted(raw, "bar_radius", uncertainty * np.asarray(generator.normal())), settings

    return Redraw(draw, groups=("bar radius",))


def _changes(changes: Array) -> Redraw:
    """Return changes of the readings (source, 5, instant), with one draw for each source."""

    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        return _shifted(raw, "distance", np.tensordot(generator.normal(size=len(changes)), changes, axes=1)), settings

    return Redraw(draw, groups=("run-out at rest",))


def _frame_expansion(relative: float) -> Redraw:
    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        factor = 1.0 + relative * generator.normal()
        return replaced(raw, {"frame_expansion": raw.variables["frame_expansion"].values * factor}), settings

    return Redraw(draw, groups=("frame expansion",))


def _frame_temperature(warming: FrameWarming, index: int) -> Redraw:
    """Return the temperature of the frame: the noise of each mean, smoothed like the temperature."""

    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        changed = raw.variables["temperature"].values.copy()
        changed[:, index] += warming.smoothing(warming.noise * generator.normal(size=len(changed)))
        return replaced(raw, {"temperature": changed}), settings

    return Redraw(draw, groups=("frame temperature",), own=True)


def _unseen_rotation(errors: xr.Dataset) -> Redraw:
    """Return the rotation about the spindle axis: it displaces a functional point off the axis, but no reading."""
    rows = errors["influence"].sel(source=errors["source_group"].values == UNSEEN).transpose("source", "time", "dof")
    effect = np.nan_to_num(rows.values)

    def act(result: xr.Dataset, generator: np.random.Generator) -> xr.Dataset:
        change = np.tensordot(generator.normal(size=len(effect)), effect, axes=1)
        moved = {name: result.variables[name].values + change[:, k] for k, name in enumerate(result.em.names)}
        return replaced(result, moved)

    return Redraw(act=act, groups=(UNSEEN,))


def _detection(raw: xr.Dataset, settings: Settings, errors: xr.Dataset) -> Redrawing:
    """Return the readings of the stepped sphere; their noise is that of the residuals of each beam."""
    steps = segmented(raw, settings, []) if "scan" in raw.variables else raw
    steps = steps.load().assign(distance=steps["distance"].transpose("channel", "profile", "step"))
    noise = errors["noise"].sel(beam=[str(name) for name in raw["channel"].values]).values[:, None, None]
    sources = {"readings": _readings(np.broadcast_to(noise, steps["distance"].shape))}
    return Redrawing(steps, _of_trial(settings), sources)


def _of_trial(settings: Settings) -> TrialSettings:
    return TrialSettings(**{name: getattr(settings, name) for name in type(settings).model_fields})
