"""The measurement model of a drift: five readings of a bar at each instant, and all that makes them uncertain.

The state of the bar is the end E of its axis and the direction a of the axis, 5 numbers. A beam with origin P and
direction u hits it at S = P + p k (theta - theta0) + u (g d + o): p is the displacement of the origin with the
temperature theta of the measuring frame, k a factor for its uncertainty, d the reading of a sensor with the gain g, and
o the run-out at rest. With
t = a . (S - E), the part of S - E across the axis q = S - E - a t, and the radius R of the bar,

    |q| - R = 0    X1, X2, Y1, Y2           t = 0    Z

The reference state is one more state, seen by the mean readings of its instants. With its E0 and a0, the functional
point f, and the rotation c of the spindle about its axis, which no reading sees, the errors are

    w = a0 x a,    T = E - E0 + w x (f - E0) + c a0 x (f - E0)

Source: Geiselhart et al. (euspen 2024), section 2.4; derivatives by the authors of this package.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.certificates import certified
from errormotion.datasets.provenance import identity
from errormotion.errors import MethodError
from errormotion.measurement import Block, Constant, Noise, Observed, Places, Problem
from errormotion.methods.spindle_drift.identification.bar import axis_direction, errors_of, states
from errormotion.methods.spindle_drift.identification.frame_expansion import frame_warming, hats, smoothing_sources
from errormotion.methods.spindle_drift.identification.record import (
    average_record,
    count_unknown,
    noise,
    reference_windows,
    run_out_at_rest,
    run_out_left,
    settling,
    slow,
    without_spikes,
)
from errormotion.methods.spindle_drift.identification.setup import Setup
from errormotion.methods.spindle_drift.result import REFERENCE, Result
from errormotion.methods.spindle_drift.schema import CHANNELS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.spindle_drift.identification.record import Record
    from errormotion.methods.spindle_drift.settings import SpindleDriftSettings

T = TypeVar("T")
UNSEEN = "rotation about the spindle axis"
"""Group of the rotation that no reading sees; without effect on the axis."""
CERTIFIED = {
    "bar radius": ("bar", "radius"),
    "frame expansion": ("frame", "coefficient of expansion"),
    **{f"gain {name}": ("sensor", f"gain {name}") for name in CHANNELS},
}
"""Sources that are one draw in all measurements with one certificate."""
_UNSEEN_KNOTS = 8
_LEAST_NOISE = 1e-4
"""Smallest noise of a reading, relative to the largest one: a reading without noise would have infinite weight."""
_NO_NOISE = 1e-15
"""The noise of readings that all have none, m or K."""
_WARMING = 1e3
"""K, and a factor: at some micrometres per kelvin the frame then expands by a radius of the bar."""


class Unknowns(NamedTuple, Generic[T]):
    """Tables of what is estimated: E (m) and the slopes a_x / a_z, a_y / a_z, of each instant and of the reference."""

    state: T
    reference: T


class Known(NamedTuple, Generic[T]):
    """Tables of what is known with an uncertainty; of the frame: a factor, and the temperature of each instant, K."""

    beam: T
    radius: T
    gain: T
    run_out: T
    expansion: T
    warming: T
    rotation: T


@dataclass(frozen=True, eq=False)
class Seen:
    """Equations of five readings of a bar, the last row being that of the reference state.

    Attributes
    ----------
    reference : ndarray of int
        The instants whose mean is the reading of the reference state.
    per_kelvin : ndarray, (5, 3)
        Displacement of the origin of each beam with the temperature of the frame, m/K.
    """

    reference: NDArray[np.int64]
    per_kelvin: Array

    def residual(self, y: Array, x: Unknowns[Array], c: Known[Array]) -> Array:
        """Return the residuals (n, 5), m."""
        _, _, _, t, q = self._geometry(y, x, c)
        residual: Array = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2) - c.radius
        residual[:, 4] = t[:, 4]
        return residual

    def derivatives(self, y: Array, x: Unknowns[Array], c: Known[Array]) -> dict[str, Array]:
        """Return the derivatives of the residuals by states and readings."""
        _, a, norm, t, q = self._geometry(y, x, c)
        n = self._normals(a, q)
        across = -t / norm
        state = np.empty((*t.shape, 5))
        for k in range(3):
            state[:, :, k] = -n[k]
        for k in range(2):
            state[:, :, 3 + k] = across * n[k]  # n . a = 0
            state[:, 4, 3 + k] = q[k][:, 4] / norm[:, 0]
        reference = np.zeros_like(state)
        reference[-1] = state[-1]
        state[-1] = 0.0
        readings = np.zeros((*t.shape, y.shape[1]))
        readings[:, range(5), range(5)] = self._along(n, c) * c.gain
        if y.shape[1] > 5:
            readings[:-1, :, 5] = (self._warmed(n) * c.expansion)[:-1]
        return {"state": state, "reference": reference, "readings": readings}

    def effects(self, y: Array, x: Unknowns[Array], c: Known[Array]) -> dict[str, Array]:
        """Return the derivatives of the residuals by the constants."""
        d, a, _, t, q = self._geometry(y, x, c)
        n = self._normals(a, q)
        beam = np.zeros((*t.shape, 5, 6))
        for k in range(3):
            beam[:, range(5), range(5), k] = n[k]
            beam[:, range(5), range(5), 3 + k] = n[k] * d
        radius = np.full((*t.shape, 1), -1.0)
        radius[:, 4] = 0.0
        gain, run_out = np.zeros((*t.shape, 5)), np.zeros((*t.shape, 5))
        run_out[:, range(5), range(5)] = self._along(n, c)
        gain[:, range(5), range(5)] = self._along(n, c) * self._read(y)
        warmed = self._warmed(n)
        expansion = (warmed * self._warming(y, c))[..., None]
        warming = (warmed * c.expansion)[..., None]
        warming[-1] = 0.0
        return {
            "beam": beam,
            "radius": radius,
            "gain": gain,
            "run_out": run_out,
            "expansion": expansion,
            "warming": warming,
            "rotation": np.zeros((*t.shape, 1)),
        }

    def _read(self, y: Array) -> Array:
        """Return the readings (n, 5), m; that of the reference state is the mean of its instants."""
        d = y[:, :5].copy()
        d[-1] = d[self.reference].mean(axis=0)
        return d

    def _warming(self, y: Array, c: Known[Array]) -> Array:
        """Return the temperature of the frame relative to the reference state, (n, 1), K."""
        warming: Array = c.warming + y[:, 5:] if y.shape[1] > 5 else c.warming.copy()
        warming[-1] = 0.0
        return warming

    def _geometry(
        self, y: Array, x: Unknowns[Array], c: Known[Array]
    ) -> tuple[Array, list[Array], Array, Array, list[Array]]:
        """Return g d + o (n, 5), a by coordinate (n, 1), 1 / a_z, t (n, 5), and q by coordinate (n, 5)."""
        state = x.state.copy()
        state[-1] = x.reference[-1]
        d = c.gain * self._read(y) + c.run_out
        P, u = c.beam[0, :, :3], c.beam[0, :, 3:]  # all readings see the same rows
        expansion = c.expansion * self._warming(y, c) if self.per_kelvin.any() else np.zeros((1, 1))
        norm = np.sqrt(1.0 + state[:, 3:4] ** 2 + state[:, 4:] ** 2)
        a = [state[:, 3:4] / norm, state[:, 4:] / norm, 1.0 / norm]
        w = [(P[:, k] + self.per_kelvin[:, k] * expansion - state[:, k : k + 1]) + u[:, k] * d for k in range(3)]
        t = w[0] * a[0] + w[1] * a[1] + w[2] * a[2]
        return d, a, norm, t, [w[k] - t * a[k] for k in range(3)]

    def _normals(self, a: list[Array], q: list[Array]) -> list[Array]:
        """Return the normals of the surface of the bar, (n, 5) by coordinate."""
        length = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
        length[:, 4] = 1.0
        n = [each / length for each in q]
        for k in range(3):
            n[k][:, 4] = a[k][:, 0]
        return n

    def _along(self, n: list[Array], c: Known[Array]) -> Array:
        """Return n . u, (n, 5)."""
        u = c.beam[0, :, 3:]
        return n[0] * u[:, 0] + n[1] * u[:, 1] + n[2] * u[:, 2]

    def _warmed(self, n: list[Array]) -> Array:
        """Return n . p, (n, 5), m/K."""
        p = self.per_kelvin
        return n[0] * p[:, 0] + n[1] * p[:, 1] + n[2] * p[:, 2]


def observe(raw: xr.Dataset, settings: SpindleDriftSettings) -> Observed:
    """Return what a drift record means.

    Raises
    ------
    MethodError
        No valid reference state, beams that do not determine the axis, or a record without time.
    """
    notes: list[str] = []
    doubts: list[str] = []
    record = without_spikes(average_record(raw, settings), settings, notes)
    raw = raw.drop_vars("distance").sel(channel=list(CHANNELS))
    averages = record.averages
    time = averages.time
    count_unknown(averages, notes)
    if time.size < 2:
        span = float(time.size * settings.average)
        raise MethodError(
            f"The record gives {time.size} mean of {settings.average:g} s; expected at least two. "
            f"Reduce 'average', or record longer than {2 * span:g} s.",
            code="drift.record.too_short",
        )
    setup = Setup.of(raw, settings, notes)
    coming_up = settling(record, settings.spin_up)
    reference = reference_windows(averages, settings, coming_up, notes)
    warming = frame_warming(raw, record, settings, notes)
    reading = averages.mean.T
    if warming is not None:
        reading = np.column_stack([reading, warming.temperature - warming.temperature[reference].mean()])
        if np.isnan(reading[reference]).any():
            raise MethodError(
                f"The temperature of the frame ({settings.frame_temperature}) is unknown in the reference state. "
                "Choose another one with reference_time and reference_average, or set compensate_frame = false.",
                code="drift.temperature.reference",
            )
    reading = np.vstack([reading, reading[reference].mean(axis=0)])
    per_kelvin = np.zeros((5, 3)) if warming is None else warming.per_kelvin
    state = _states(reading, setup, per_kelvin)
    E0 = state[-1, :3]
    point = np.round(E0, 4) + 0.0 if settings.functional_point is None else np.array(settings.functional_point)
    if not settings.bar_radius_uncertainty:
        notes.append("Assumed: no uncertainty of the radius of the bar (bar_radius_uncertainty = 0).")
    if not settings.gain_uncertainty:
        notes.append("Assumed: no uncertainty of the gains of the sensors (gain_uncertainty = 0).")
    if coming_up.any():
        notes.append(
            f"{int(coming_up.sum())} means within {settings.spin_up:g} s of a change of the spindle's speed are NaN."
        )
    sigma = np.where(np.isfinite(averages.mean), noise(raw, record, settings, notes), 0.0).T
    sigma = np.hypot(sigma, run_out_left(record, float(raw["distance_noise"]), settings, notes, doubts))
    beyond = slow(record, sigma.T, settings, notes, doubts)
    parts, own = (
        (None, None) if warming is None else smoothing_sources(warming.smoothing, warming.noise, time, reference)
    )
    constants = _constants(raw, record, setup, settings, reference, parts)
    seen = Seen(reference, per_kelvin)
    known: NDArray[np.bool_] = np.asarray(np.isfinite(state).all(axis=1))
    index = np.arange(len(state))
    scale = np.array([setup.radius] * 3 + [0.1] * 2)
    problem = Problem(
        equation=seen.residual,
        derivatives=seen.derivatives,
        constant_derivatives=seen.effects,
        readings=np.where(known[:, None], reading, np.nan),
        reading_scale=np.array([setup.radius] * 5 + [_WARMING])[: reading.shape[1]],
        unknowns=Unknowns(
            state=Block(
                start=np.where(known[:, None], state, state[-1]),
                index=index,
                scale=scale,
                free=known & (index < time.size),
            ),
            reference=Block(start=state[-1:], index=np.zeros_like(index), scale=scale, group=REFERENCE),
        ),
        constants=constants,
        noise=Noise(sd=_noise(sigma, beyond.sd, reference, own)),
    )
    shown = np.where(known[:-1] & ~coming_up, 0.0, np.nan)[:, None]
    result = Result(raw, record, setup, settings, reference, state, point, UNSEEN, beyond)
    return Observed(
        problem=problem,
        places=Places(
            lambda x, c: errors_of(x.state, x.reference, point, c.rotation[:, 0]) + shown,
            time.size,
            only=("state", "reference", "rotation"),
            rows={"state": index[:-1]},
        ),
        freedoms=("EX", "EY", "EZ", "EA", "EB"),
        dims=("time",),
        coords=result.coordinates,
        component="spindle",
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=point.tolist(),
        reference=result.reference_words,
        shared=REFERENCE,
        what="the readings of the bar",
        robust=False,  # as many readings as unknowns: nothing checks them
        resolution=0.0,  # of means; rounded samples are part of their noise
        finish=result.finish,
        attributes={"reference_interval": result.interval},
        attrs={"reference_time": result.zero, "beams": settings.beams},
        zero=result.zero,
        raw_hash=record.hash,
        notes=notes,
        doubts=doubts,
    )


def _states(reading: Array, setup: Setup, per_kelvin: Array) -> Array:
    """Return the states (n, 5) that fulfil the equation for the stated constants; NaN where none does."""
    known = np.isfinite(reading).all(axis=1)
    origin = setup.origin
    if reading.shape[1] > 5:
        origin = origin + per_kelvin * np.where(known, reading[:, 5], 0.0)[:, None, None]
    state = states(np.where(known, reading[:, :5].T, np.nan), origin, setup.direction, setup.radius, setup.levels)
    if not np.isfinite(state[-1]).all():
        raise MethodError(
            "No cylinder of the stated radius fits the readings of the reference state. Check bar_radius "
            f"({setup.radius * 1e3:g} mm), the beams' origins and directions, and that the X beams cross the Y beams.",
            code="drift.radius.no_fit",
        )
    setup.check_senses(reading[-1, :5], state[-1, :3], np.concatenate(axis_direction(state[-1:])))
    return state


def _noise(sigma: Array, beyond: Array, reference: NDArray[np.int64], own: Array | None) -> Array:
    """Return the standard deviations of the readings of all instants, (n, 5), and of the reference state.

    The mean of the reference state keeps the noise ``beyond`` (5,), which may be alike in all its instants. With the
    standard uncertainty of the temperature of each instant alone, (n,), where it is a reading.
    """
    mean = np.sqrt(np.sum(sigma[reference] ** 2, axis=0)) / reference.size
    every = np.hypot(np.vstack([sigma, mean]), beyond)
    every = np.maximum(every, np.maximum(_LEAST_NOISE * every.max(), _NO_NOISE))
    return every if own is None else np.column_stack([every, np.maximum(np.append(own, 0.0), _NO_NOISE)])


def _constants(
    raw: xr.Dataset,
    record: Record,
    setup: Setup,
    settings: SpindleDriftSettings,
    reference: NDArray[np.int64],
    parts: list[Array] | None,
) -> Known[Constant]:
    """Return all sources of uncertainty but the noise."""
    n = record.averages.time.size
    one = np.zeros(n + 1, dtype=np.intp)

    def constant(
        group: str, value: Array, factor: Array, index: NDArray[np.intp] = one, scale: float = setup.radius, **more: Any
    ) -> Constant:
        names = more.get("names", [group][: factor.shape[2]])
        given = certified(raw.attrs, {name: CERTIFIED[name] for name in names if name in CERTIFIED})
        if given:
            more["identity"] = [given.get(name, "") for name in names]
        return Constant(value=value, factor=factor, index=index, scale=scale, group=group, **more)

    def scalar(group: str, value: float, u: float, scale: float = setup.radius) -> Constant:
        return constant(group, np.full((1, 1), value), np.full((1, 1, 1 if u else 0), u), scale=scale)

    beam, names, ids = _beam_factor(setup, calibrated=settings.beams != "nominal")
    of_beams = np.concatenate([setup.origin, setup.direction], axis=1)
    spread, rest, rests = run_out_at_rest(record, reference, float(raw["distance_noise"]))
    channel = np.flatnonzero(spread > 0)
    run_out = np.zeros((len(rests) + 1, 5, len(rests), channel.size))  # the last row: the spindle turns
    for k in range(len(rests)):
        run_out[k, channel, k, range(channel.size)] = spread[channel]
    of_parts = np.zeros((n + 1, 1, len(parts or ())))
    of_parts[:-1, 0] = np.array(parts or ()).reshape(-1, n).T
    weight = hats(record.averages.time, _UNSEEN_KNOTS)
    # The rotation changes as the head warms: it is modelled by knots, each one draw, so that distant instants are
    # nearly independent.
    weight = (weight - weight[:, reference].mean(axis=1, keepdims=True)) / np.sqrt(2.0)
    return Known(
        beam=constant(setup.group, of_beams, beam, np.tile(np.arange(5), (n + 1, 1)), names=names, identity=ids),
        radius=scalar("bar radius", setup.radius, settings.bar_radius_uncertainty),
        gain=constant(
            "sensor gain",
            np.ones((1, 5)),
            settings.gain_uncertainty * np.eye(5)[None] if settings.gain_uncertainty else np.zeros((1, 5, 0)),
            scale=1.0,
            names=[f"gain {name}" for name in CHANNELS] if settings.gain_uncertainty else [],
        ),
        run_out=constant(
            "run-out at rest",
            np.zeros((len(rests) + 1, 5)),
            run_out.reshape(len(rests) + 1, 5, -1),
            rest,
            names=[f"run-out {CHANNELS[i]}, rest {k}" for k in rests for i in channel],
        ),
        expansion=scalar(
            "frame expansion", 1.0, 0.0 if parts is None else settings.frame_expansion_uncertainty, _WARMING
        ),
        warming=constant(
            "frame temperature",
            np.zeros((n + 1, 1)),
            of_parts,
            np.arange(n + 1),
            _WARMING,
            names=[f"frame temperature, part {k + 1}" for k in range(of_parts.shape[2])],
        ),
        rotation=constant(
            UNSEEN,
            np.zeros((n, 1)),
            settings.unseen_rotation * weight.T[:, None] if settings.unseen_rotation else np.zeros((n, 1, 0)),
            one,
            names=[f"{UNSEEN}, part {k + 1}" for k in range(_UNSEEN_KNOTS if settings.unseen_rotation else 0)],
        ),
    )


def _beam_factor(setup: Setup, *, calibrated: bool) -> tuple[Array, list[str], list[str]]:
    """Return the covariance of the beams as sources (5, 6, k), the columns of its factors, with names and identities.

    The parts of beams that were ``calibrated`` are the same draws in all records with this calibration. Those of
    nominal beams have no identity: every set-up is off its nominal beams in its own way.
    """
    columns, names, ids = [], [], []
    for i, (o, u, C) in enumerate(zip(setup.origin, setup.direction, setup.covariance, strict=True)):
        # Scaled, so that metres and radians have the same weight in the decision on the rank.
        size = np.sqrt(np.diag(C))
        unit = np.where(size > 0, size, 1.0)
        values, vectors = np.linalg.eigh(C / np.outer(unit, unit))
        for k in np.flatnonzero(values > 1e-12):
            column = np.zeros((5, 6))
            column[i] = unit * vectors[:, k] * np.sqrt(values[k])
            columns.append(column)
            names.append(f"beam {CHANNELS[i]}.{k}")
            ids.append(identity(o, u, C, part=f"part {k + 1}", along=vectors[:, k]) if calibrated else "")
    return np.moveaxis(np.array(columns).reshape(-1, 5, 6), 0, -1), names, ids
