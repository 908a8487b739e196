"""The measurement model: the mean readings over turns, and the error motion at every angle that they determine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.measurement import Block, Constant, Datum, Noise, Observed, Places, Problem
from errormotion.methods.spindle_error_motion.figures import (
    Curve,
    centred,
    curves_of,
    figures_of,
    spread_of,
    structural_of,
)
from errormotion.methods.spindle_error_motion.layout import Layout
from errormotion.methods.spindle_error_motion.schema import ASSUMED_POSITION, ASSUMED_ROUNDNESS
from errormotion.methods.spindle_error_motion.synchronous import Synchronous, synchronous_of
from errormotion.methods.spindle_error_motion.turning import TAU, Turning, turning_of

if TYPE_CHECKING:
    from errormotion.measurement.observed import Solved
    from errormotion.methods.spindle_error_motion.settings import SpindleErrorMotionSettings

T = TypeVar("T")
MOTION = "asynchronous motion and noise"
ARTEFACT = "eccentricity"
GAIN = "sensor gain"
LIMITS = ("radial_limit", "axial_limit")
"""Groups in the budget, and settings that are attributes of the result."""
FORM = 15
"""Undulations in one turn up to which a roundness deviation is distributed, with amplitudes as 1 over their number."""
PEAKS = 4.0
"""Ratio of a roundness deviation, from peak to valley, to the standard deviation of the form."""
_SMALL = 0.1
"""The batches contain all noise; the least squares take this part of the noise of a mean in addition."""
WRONG_SENSE = 2.0
"""Ratio of the circles in both senses from which on the readings turn in the wrong one."""


class Unknowns(NamedTuple, Generic[T]):
    """Tables of what is estimated: six errors for each angle."""

    motion: T


class Known(NamedTuple, Generic[T]):
    """Tables of what is known with an uncertainty; height and scatter are errors."""

    direction: T
    gain: T
    height: T
    form: T
    scatter: T


@dataclass(frozen=True, eq=False)
class Record:
    """A record as its mean over turns."""

    raw: xr.Dataset
    layout: Layout
    turning: Turning
    mean: Synchronous
    angle: Array
    settings: SpindleErrorMotionSettings

    @property
    def curves(self) -> list[Curve]:
        """The error motions in the sensitive directions."""
        return curves_of(self.layout, self.angle, self.settings.sensitive_angle)


def observe(raw: xr.Dataset, settings: SpindleErrorMotionSettings) -> Observed:
    """Return what a record means: mean reading = gain times displacement of the turning artefact, plus its form."""
    notes = list[str]()
    layout = Layout.of(raw)
    known = np.where(layout.determined, 0.0, np.nan)
    turning = turning_of(raw, layout, notes)
    mean = synchronous_of(raw, turning, min(settings.harmonics, settings.places // 4))
    angle = (np.arange(settings.places) + 0.5) * TAU / settings.places
    record = Record(raw, layout, turning, mean, angle, settings)
    problem = _problem(record, notes)
    n = angle.size
    weight = np.tile(np.isfinite(known).astype(float), (n, 1))
    each = np.tile(np.eye(6)[layout.determined], (n, 1, 1)).transpose(0, 2, 1)
    columns = np.concatenate([each, layout.eccentric(angle).transpose(1, 2, 0)], axis=2)
    limits = {name: getattr(settings, name) for name in LIMITS if getattr(settings, name) is not None}
    return Observed(
        problem=problem,
        places=Places(lambda x, _: x.motion + known, n),
        datum=Datum(columns, weight, ARTEFACT),
        robust=False,  # spikes are excluded sample by sample
        noise_increases=False,  # the scatter of the batches contains all noise
        resolution=0.0,
        correlation=0.0,
        finish=partial(_finished, record=record),
        dims=("angle",),
        coords={"angle": ("angle", angle, {"units": "rad", "long_name": f"angle of {layout.axis}"})},
        component=layout.axis,
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=layout.origin.tolist(),
        reference="axis average line; eccentricity and tilt of the artefact in the spindle are removed",
        what="the mean readings",
        attrs={
            "turns": turning.turns,
            "harmonics": mean.harmonics,
            "angle_from": turning.source,
            "samples": mean.count,
            **limits,
        },
        notes=[*notes, *mean.notes],
        doubts=mean.doubts,
    )


def _problem(record: Record, notes: list[str]) -> Problem:
    """Return readings (sensor, place), unknowns and constants."""
    raw, layout, mean, angle = record.raw, record.layout, record.mean, record.angle
    y, scatter = mean.at(angle), mean.scatter_at(angle)
    sensors, n, batches = scatter.shape
    sensor, place = (index.ravel() for index in np.indices((sensors, n)))

    def stated(name: str, default: float) -> float:
        return float(raw[name]) if name in raw else default

    u_form = stated("roundness", ASSUMED_ROUNDNESS)
    radial = layout.radial
    if "roundness" not in raw and radial.any():
        notes.append(
            f"The roundness deviation of the artefact is not stated; {1e9 * ASSUMED_ROUNDNESS:g} nm is assumed."
        )
    orders, value, factor = _form(raw, u_form, max(int(layout.sections.max()) + 1, 1), mean.harmonics)
    if not radial.any():
        factor = factor[..., :0]
    tilts = bool(layout.determined[3:].any())
    u_height = stated("position_uncertainty", ASSUMED_POSITION) if tilts else 0.0
    if tilts and "position_uncertainty" not in raw:
        notes.append(
            f"The uncertainty of the positions of the sensors is not stated; {1e3 * ASSUMED_POSITION:g} mm is assumed."
        )
    _check_sense(layout, angle, y)
    t, r = layout.tangent[sensor], layout.position[sensor]
    side = layout.side[sensor]
    phase = np.multiply.outer(layout.azimuth[sensor] - angle[place], orders)
    basis = np.concatenate([np.cos(phase), np.sin(phase)], axis=1)
    axis = np.eye(3)[layout.along]

    def equation(y: Array, x: Unknowns[Array], c: Known[Array]) -> Array:
        d = x.motion[:, :3] + np.cross(x.motion[:, 3:], r + c.height * axis)
        sagitta = np.square(np.sum(t * d, axis=1)) / (2 * layout.radius)
        surface = np.sum(basis * c.form, axis=1) - sagitta
        moved = np.sum(c.direction * d, axis=1) + side * surface
        return np.asarray(y - c.scatter[:, 0] - c.gain[:, 0] * moved)

    across = np.linalg.svd(layout.direction[:, None, :])[2][:, 1:]  # two unit vectors across each sensor
    turned = stated("sensor_direction_uncertainty", 0.0) * np.einsum("st,ski->sitk", np.eye(sensors), across)
    gain = stated("gain_uncertainty", 0.0) * np.eye(sensors)[:, None, :]
    noise = stated("displacement_noise", 0.0) * np.sqrt((2 * mean.harmonics + 1) / mean.count)
    level = float(np.sqrt(np.square(scatter).sum(axis=2).mean())) if batches else 0.0
    sd = np.hypot(max(_SMALL * noise, 1e-3 * level, 1e-15), mean.rounded)[sensor]
    return Problem(
        equation=equation,
        readings=y.ravel(),
        unknowns=Unknowns(
            Block(
                start=np.einsum("fs,sp->pf", layout.solver, y),
                index=place,
                scale=1e-4,
                free=np.tile(layout.determined, (n, 1)),
            )
        ),
        constants=Known(
            direction=Constant(
                value=layout.direction,
                factor=turned.reshape(sensors, 3, -1),
                index=sensor,
                scale=1.0,
                group="sensor direction",
            ),
            gain=Constant(value=np.ones((sensors, 1)), factor=gain, index=sensor, scale=1.0, group=GAIN),
            height=Constant(
                value=np.zeros((sensors, 1)),
                factor=u_height * np.eye(sensors)[:, None, :],
                index=sensor,
                scale=1.0,
                group="position of sensors",
            ),
            form=Constant(
                value=value,
                factor=factor,
                index=np.maximum(layout.sections, 0)[sensor],
                scale=1.0,
                group="form of the artefact",
            ),
            scatter=Constant(
                value=np.zeros((sensors * n, 1)),
                factor=scatter.reshape(sensors * n, 1, batches),
                index=np.arange(sensors * n),
                scale=1.0,
                group=MOTION,
            ),
        ),
        noise=Noise(sd=sd),
        reading_scale=1e-4,
    )


def _form(raw: xr.Dataset, roundness: float, sections: int, harmonics: int) -> tuple[Array, Array, Array]:
    """Return undulations (h,), the stated form (section, 2 h), m, and its independent sources.

    Undulations above the harmonics of the mean readings are no part of them. A roundness deviation is distributed over
    2 ... `FORM` undulations: each coefficient has a standard uncertainty
    u_k as 1 / k with sum u_k^2 = (roundness / `PEAKS`)^2, cosine and sine alike, independently in each section.
    """
    stated = "form_cosine" in raw and "form_sine" in raw
    given = np.asarray(raw["undulation"].values, int) if stated and "undulation" in raw else np.zeros(0, int)
    if stated and not given.size:
        raise MethodError(
            "undulation: expected the undulations in one turn of form_cosine and form_sine; found none",
            code="spindle.undulations.missing",
        )
    seen = given <= harmonics
    orders = np.union1d(given[seen], np.arange(2, min(FORM, harmonics) + 1))
    value = np.zeros((sections, 2 * orders.size))
    if stated:
        at = np.searchsorted(orders, given[seen])
        value[:, at] = raw["form_cosine"].values[seen]
        value[:, orders.size + at] = raw["form_sine"].values[seen]
    share = 1.0 / np.arange(2, FORM + 1)
    u = np.where((orders >= 2) & (orders <= FORM), 1.0 / np.maximum(orders, 1), 0.0)
    u *= roundness / PEAKS / float(np.linalg.norm(share))
    both = np.concatenate([u, u])
    live = np.flatnonzero(both)
    factor = np.zeros((sections, both.size, sections * live.size))
    for s in range(sections):
        factor[s, live, s * live.size + np.arange(live.size)] = both[live]
    return orders, value, factor


def _check_sense(layout: Layout, angle: Array, y: Array) -> None:
    """Refuse readings whose eccentricity turns against the stated sense."""
    first, second = layout.plane
    if not layout.determined[[first, second]].all():
        return
    E = layout.solver @ y
    both = (E[first] + 1j * E[second]) @ np.exp(-1j * np.outer(angle, [1, -1])) / angle.size
    forward, backward = np.abs(both)
    if backward > WRONG_SENSE * forward and backward > 3 * np.abs(y).std(axis=1).max() / 10:
        raise MethodError(
            f"The artefact turns in the opposite sense: its eccentricity is {1e6 * backward:.3g} um against the stated "
            f"sense and {1e6 * forward:.3g} um in it. Correct the sign of spindle_speed, or the sides of the sensors.",
            code="readings.sense.opposite",
        )


def _finished(solved: Solved, *, record: Record) -> Solved:
    """Return the solution with the figures and the motion that is not synchronous; a trial needs neither."""
    observed, errors = solved.observed, solved.relative.errors
    # There is no redundancy by which the noise could be checked; the batches show it.
    solved = replace(solved, scatter=replace(solved.scatter, note=""))
    if not solved.propagated:
        return solved
    curves, angle = record.curves, record.angle
    # A range contains the rounding of its two ends
    noise = float(np.hypot(record.raw["displacement_noise"], record.mean.step.max() / np.sqrt(12)))
    spread = spread_of(record.raw, record.layout, record.turning, record.mean, curves, noise)
    value = np.nan_to_num(errors.value)
    gains, scatter = (np.array([source.group == group for source in errors.sources]) for group in (GAIN, MOTION))
    values = figures_of(
        curves,
        angle,
        value,
        np.nan_to_num(errors.own),
        np.nan_to_num(errors.influence),
        spread,
        (float(record.raw["gain_uncertainty"]), gains),
        scatter,
        [] if "standstill" not in record.raw else structural_of(record.raw, record.layout, curves, noise),
    )
    names = [curve.name for curve in curves]
    mean = np.array([centred(np.sum(curve.weight * value, axis=1), angle, axial=curve.axial) for curve in curves])
    shared = [np.einsum("pd,spd->sp", curve.weight, np.nan_to_num(errors.influence)) for curve in curves]
    u = np.array(
        [
            np.linalg.norm(centred(each, angle, axial=curve.axial), axis=0)
            for curve, each in zip(curves, shared, strict=True)
        ]
    )
    over, meaning = ("curve", "angle"), "of each sensitive direction, m or rad"
    extras = {
        "figure_value": _array({"figure": values.names}, ("figure",), values.value, "values of ISO 230-7, m or rad"),
        "figure_bias": _array({"figure": values.names}, ("figure",), values.bias, "typical excess by noise, m or rad"),
        "figure_u": _array({"figure": values.names}, ("figure",), values.u, "standard uncertainty without the bias"),
        "figure_unit": _array({"figure": values.names}, ("figure",), np.array(values.units), "unit of each figure"),
        "figure_influence": _array(
            {"figure": values.names}, ("source", "figure"), values.influence, "effect of each source, m or rad"
        ),
        "synchronous": _array({"curve": names}, over, mean, f"synchronous error motion {meaning}"),
        "synchronous_u": _array({"curve": names}, over, u, f"standard uncertainty {meaning}"),
        "asynchronous_low": _array({"curve": names}, over, spread.low, f"lowest asynchronous motion {meaning}"),
        "asynchronous_high": _array({"curve": names}, over, spread.high, f"highest asynchronous motion {meaning}"),
        "asynchronous_rms": _array({"curve": names}, ("curve",), spread.rms, f"root mean square {meaning}"),
        "eccentricity": xr.DataArray(_eccentricity(solved, record), attrs={"units": "m"}),
    }
    few = record.turning.turns < 20
    notes = [f"The asynchronous error motion is that of {record.turning.turns} turns; expected 20 or more."] * few
    return replace(
        solved, observed=replace(observed, extras={**observed.extras, **extras}, notes=[*observed.notes, *notes])
    )


def _eccentricity(solved: Solved, record: Record) -> float:
    """Return the eccentricity of the artefact at the functional point, m; NaN without a radial sensor."""
    determined = record.layout.determined
    first, second = record.layout.plane
    if not determined[[first, second]].any():
        return float("nan")
    count = int(determined.sum())
    return float(np.hypot(*solved.relative.coefficient[count : count + 2]))


def _array(labels: dict[str, Any], dims: tuple[str, ...], values: Array, meaning: str) -> xr.DataArray:
    return xr.DataArray(values, labels, dims, attrs={"long_name": meaning})
