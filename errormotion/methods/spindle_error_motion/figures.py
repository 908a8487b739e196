"""Error motions in the sensitive directions, and their values as ISO 230-7 and ASME B89.3.4 define them.

The text of the standards was not available; definitions are those of public descriptions (E. Marsh, Precision Spindle
Metrology; CIRP Annals 25 (1976) 545; ASME B89.3.4 in catalogues of instruments). With the first direction across the
axis i, the second j, and the spindle angle q from i towards j:

======================  ======================================================================
rotating                ``E_i cos p + E_j sin p``, ``p = q + sensitive angle``: of a tool that turns
fixed i, fixed j        ``E_i``, ``E_j``: of a tool that stands still
axial                   displacement along the axis
tilt                    the same of the inclination of the axis, rad: ``W_j`` towards i, ``-W_i`` towards j
======================  ======================================================================

``synchronous``
    Range of the mean over turns: radial separation of two circles that enclose its polar plot, concentric with its
    least-squares circle. An axial plot has the centre of the chart.
``synchronous, MZC``, ``MIC``, ``MCC``
    The same about the centre of the minimum zone, the maximum inscribed, the minimum circumscribed circle: radial only.
``asynchronous``
    Largest range of the motion at one angle (a sector) over all turns, without the synchronous part.
``total``
    The same as the synchronous value, of the whole plot of all turns.
``structural``
    Range of the motion with the spindle at rest, if such a record is stated.
``fundamental axial``, ``residual synchronous axial``
    Range of what occurs once a turn, and of the remaining synchronous motion.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.estimation.extremes import FLAT, POINTED, expanded, of_noisy_values
from errormotion.methods.spindle_error_motion.averaging import DRAWS, extremes
from errormotion.methods.spindle_error_motion.circles import CIRCLES, range_about
from errormotion.methods.spindle_error_motion.layout import Layout
from errormotion.methods.spindle_error_motion.synchronous import SAMPLE, Synchronous, limits
from errormotion.methods.spindle_error_motion.turning import TAU, Turning, angles_of, chunks

_TABLE = 4096
_SEED = 230
_NORMAL = 1 << 16
_DRAWS = 200
FEWEST_AT_REST = 20
"""Readings at rest from which a range follows."""


@dataclass(frozen=True, eq=False)
class Curve:
    """An error motion in a sensitive direction: ``weight`` (place, 6) of the freedoms, in m or rad."""

    name: str
    unit: str
    weight: Array

    @property
    def axial(self) -> bool:
        """Whether its plot has the centre of the chart."""
        return self.name == "axial"


def curves_of(layout: Layout, angle: Array, sensitive: float) -> list[Curve]:
    """Return the curves that the sensors determine, at angles of the axis (place,), rad."""
    first, second = layout.plane
    names = ["XYZ"[first], "XYZ"[second]]
    p, curves = angle + sensitive, list[Curve]()
    one, cos, sin = np.ones(angle.size), np.cos(p), np.sin(p)

    def curve(name: str, unit: str, **weight: Array) -> None:
        each = np.zeros((angle.size, 6))
        for freedom, values in weight.items():
            each[:, int(freedom[1:])] = values
        if layout.determined[[int(freedom[1:]) for freedom in weight]].all():
            curves.append(Curve(name, unit, each))

    i, j, k = f"_{first}", f"_{second}", f"_{layout.along}"
    a, b = f"_{first + 3}", f"_{second + 3}"
    curve("radial, rotating", "m", **{i: cos, j: sin})
    curve(f"radial, fixed {names[0]}", "m", **{i: one})
    curve(f"radial, fixed {names[1]}", "m", **{j: one})
    curve("axial", "m", **{k: one})
    curve("tilt, rotating", "rad", **{b: cos, a: -sin})
    curve(f"tilt, fixed {names[0]}", "rad", **{b: one})
    curve(f"tilt, fixed {names[1]}", "rad", **{a: -one})
    return curves


def centred(values: Array, angle: Array, *, axial: bool) -> Array:
    """Return curves (..., place) without the centre and radius of their least-squares circle; axial: without mean."""
    design = np.ones((angle.size, 1)) if axial else np.stack([np.ones(angle.size), np.cos(angle), np.sin(angle)], 1)
    return np.asarray(values - values @ np.linalg.pinv(design).T @ design.T)


def range_of(values: Array, angle: Array, *, axial: bool) -> Array:
    """Return the synchronous value of curves (..., place)."""
    return np.asarray(np.ptp(centred(values, angle, axial=axial), axis=-1))


def fundamental(values: Array, angle: Array) -> Array:
    """Return the range of what occurs once a turn in curves (..., place)."""
    return np.asarray(4 / angle.size * np.hypot(values @ np.cos(angle), values @ np.sin(angle)))


@dataclass(frozen=True, eq=False)
class Spread:
    """Extremes over turns of the motion that is not synchronous, (curve, sector), and with further noise (draw, ...).

    NaN for a sector without samples, as with few samples at the same angles in every turn.

    ``rms`` is the root mean square of each curve, ``noise`` the standard deviation of the noise of the sensors in it.
    """

    low: Array
    high: Array
    noisy_low: Array
    noisy_high: Array
    rms: Array
    noise: Array


def spread_of(
    raw: xr.Dataset, layout: Layout, turning: Turning, mean: Synchronous, curves: list[Curve], noise: float
) -> Spread:
    """Return the extremes over all turns of a record, which is read once more."""
    to_curves = np.array([curve.weight for curve in curves]).transpose(1, 0, 2) @ layout.solver
    size = noise * np.sqrt(np.mean(np.square(to_curves).sum(axis=2), axis=0))
    normal = np.random.default_rng(_SEED).standard_normal(_NORMAL)
    grid = np.arange(_TABLE + 1) * TAU / _TABLE
    table = mean.at(grid)
    by_angle = np.ascontiguousarray(table.T)
    drift = np.ascontiguousarray(mean.level.T)
    groups = [_Group.of(to_curves[:, part], size[part], seed) for seed, part in enumerate(_parts(len(curves)))]
    before, limit = np.nan, mean.limit
    with ThreadPoolExecutor(len(groups)) as pool:
        for number, chunk in enumerate(chunks(raw)):
            angle, before = angles_of(chunk, turning, before)
            if number == 0 and np.isfinite(mean.limit).any():
                place = np.nan_to_num(turning.sense * angle[:SAMPLE])
                rest = chunk.reading[:, :SAMPLE] - np.array([np.interp(place % TAU, grid, row) for row in table])
                limit = np.maximum(np.minimum(limits(rest), mean.limit), 4 * mean.step)
            given = chunk.reading, angle / TAU, turning.sense, turning.turns, limit, by_angle, drift, normal
            running = [pool.submit(group.update, given) for group in groups]
            for thread in running:
                thread.result()
    low, high, rms = (np.concatenate([getattr(group, name) for group in groups]) for name in ("low", "high", "rms"))
    noisy = [np.concatenate([getattr(group, name) for group in groups], axis=1) for name in ("noisy_low", "noisy_high")]
    for each in (low, high, *noisy):
        each[np.isinf(each)] = np.nan  # no sample
    return Spread(low, high, noisy[0], noisy[1], rms, size)


def _parts(count: int) -> list[slice]:
    """Return the curves of two threads; the result does not depend on whether they run at the same time."""
    half = (count + 1) // 2
    return [slice(0, half), slice(half, count)] if count > 1 else [slice(0, 1)]


@dataclass(eq=False)
class _Group:
    """Curves that one thread follows: see `errormotion.methods.spindle_error_motion.averaging.extremes`."""

    weight: Array
    noise: Array
    seed: int
    low: Array
    high: Array
    noisy_low: Array
    noisy_high: Array
    power: Array

    @classmethod
    def of(cls, weight: Array, noise: Array, number: int) -> _Group:
        """Return curves without samples; ``weight`` is (sector, curve, sensor)."""
        shape = (weight.shape[1], weight.shape[0])
        draws = (DRAWS, *shape)
        return cls(
            weight=np.ascontiguousarray(weight),
            noise=noise.copy(),
            seed=_SEED + number,
            low=np.full(shape, np.inf),
            high=np.full(shape, -np.inf),
            noisy_low=np.full(draws, np.inf),
            noisy_high=np.full(draws, -np.inf),
            power=np.zeros(shape[0] + 1),
        )

    @property
    def rms(self) -> Array:
        """Root mean square of each curve."""
        return np.asarray(np.sqrt(self.power[:-1] / max(self.power[-1], 1.0)))

    def update(self, chunk: Any) -> None:
        """Follow the samples of a chunk: the arguments of `extremes` up to the weights, and normal numbers."""
        *given, normal = chunk
        extreme = self.low, self.high, self.noisy_low, self.noisy_high
        run: Any = extremes
        self.seed = run(*given, self.weight, self.noise, normal, self.seed, *extreme, self.power)


@dataclass(frozen=True, eq=False)
class Figures:
    """The values in their order: names, units, values, biases, standard uncertainties, effects (source, figure)."""

    names: list[str]
    units: list[str]
    value: Array
    bias: Array
    u: Array
    influence: Array

    @property
    def expanded(self) -> Array:
        """Expanded uncertainty, k = 2, of values that are not corrected for their bias."""
        return expanded(self.bias, self.u)


def figures_of(
    curves: list[Curve],
    angle: Array,
    errors: Array,
    own: Array,
    influence: Array,
    spread: Spread,
    gain: tuple[float, NDArray[np.bool_]],
    scatter: NDArray[np.bool_],
    structural: list[tuple[str, str, Array]],
) -> Figures:
    """Return all values.

    Parameters
    ----------
    errors : ndarray, (place, 6)
        Synchronous error motion; unknown freedoms are 0.
    own : ndarray, (place, 6, 6)
        Its covariance that is independent from place to place.
    influence : ndarray, (source, place, 6)
        Effects of its sources.
    gain : float, and ndarray of bool, (source,)
        Relative standard uncertainty of the gain of each sensor, and which sources are gains.
    scatter : ndarray of bool, (source,)
        Sources that the mean over turns does not share with the whole motion: its error is in their difference.
    structural : list
        Of `structural_of`.
    """
    names, units = list[str](), list[str]()
    parts: list[tuple[float, float, float]] = []
    effects: list[Array] = []

    def add(name: str, unit: str, value: float, bias: float, u: float, effect: Array) -> None:
        names.append(name)
        units.append(unit)
        parts.append((value, bias, u))
        effects.append(effect)

    for c, curve in enumerate(curves):
        values = np.sum(curve.weight * errors, axis=1)
        shared = np.einsum("pd,spd->sp", curve.weight, influence)
        single = np.sqrt(np.maximum(np.einsum("pd,pde,pe->p", curve.weight, own, curve.weight), 0.0))
        wanted = [("synchronous " + curve.name, partial(range_of, angle=angle, axial=curve.axial))]
        if curve.name.startswith("radial"):
            wanted += [
                (f"synchronous {curve.name}, {circle}", partial(range_about, angle=angle, circle=circle))
                for circle in CIRCLES
            ]
        if curve.axial:
            wanted += [
                ("fundamental axial", partial(fundamental, angle=angle)),
                ("residual synchronous axial", partial(range_of, angle=angle, axial=False)),
            ]
        for name, function in wanted:
            found = of_noisy_values(
                function, values, single, shared, draws=_DRAWS // (2 if name[-3:] in CIRCLES else 1)
            )
            effect = function(values + shared) - function(values)
            add(name, curve.unit, float(found.value), float(found.bias), float(found.u), effect)
        # What scales with the gain of a sensor
        of_gain = gain[0] / np.sqrt(max(int(gain[1].sum()), 1)) * gain[1]
        width = spread.high[c] - spread.low[c]
        value = float(np.nanmax(width))
        noisy = float(np.nanmax((spread.noisy_high - spread.noisy_low)[:, c], axis=1).mean())
        bias, u = _by_noise(value, noisy, spread.noise[c])
        scale = float(np.linalg.norm(of_gain))
        u = float(np.hypot(u, value * gain[0]))
        add("asynchronous " + curve.name, curve.unit, value, bias, u, value * of_gain)
        whole = centred(values, angle, axial=curve.axial)
        value = float(np.nanmax(whole + spread.high[c]) - np.nanmin(whole + spread.low[c]))
        noisy = float(
            np.mean(
                np.nanmax(whole + spread.noisy_high[:, c], axis=1) - np.nanmin(whole + spread.noisy_low[:, c], axis=1)
            )
        )
        bias, u = _by_noise(value, noisy, spread.noise[c])
        top, bottom = int(np.nanargmax(whole + spread.high[c])), int(np.nanargmin(whole + spread.low[c]))
        moved = centred(np.where(scatter[:, None], 0.0, shared), angle, axial=curve.axial)
        effect = moved[:, top] - moved[:, bottom]
        u = float(np.sqrt(u**2 + float(effect @ effect) + (scale * (value - np.ptp(whole))) ** 2))
        add("total " + curve.name, curve.unit, value, bias, u, effect)
    for name, unit, (value, bias, u) in structural:
        add(name, unit, value, bias, float(np.hypot(u, value * gain[0])), value * of_gain)
    value, bias, u = np.array(parts).T
    return Figures(names, units, value, bias, u, np.array(effects).T)


def structural_of(raw: xr.Dataset, layout: Layout, curves: list[Curve], noise: float) -> list[tuple[str, str, Array]]:
    """Return the structural error motion in the fixed directions and along the axis: name, unit, value, bias and u.

    The range of the motion with the spindle at rest, without a line in time. ``noise`` is that of the sensors.
    """
    reading = raw["standstill"].transpose("rest", "sensor").values.astype(float)
    reading = reading[np.isfinite(reading).all(axis=1)]
    if len(reading) < FEWEST_AT_REST:
        return []
    step = np.linspace(-1, 1, len(reading))
    reading = reading - reading.mean(axis=0)
    reading -= np.multiply.outer(step, step @ reading / (step @ step))
    generator, structural = np.random.default_rng(_SEED), []
    for curve in curves:
        if "rotating" in curve.name:
            continue
        weight = curve.weight[0] @ layout.solver
        motion, size = reading @ weight, noise * float(np.linalg.norm(weight))
        again = [np.ptp(motion + size * generator.standard_normal(motion.size)) for _ in range(DRAWS)]
        value = float(np.ptp(motion))
        values = np.array([value, *_by_noise(value, float(np.mean(again)), size)])
        structural.append((f"structural {curve.name}", curve.unit, values))
    return structural


def _by_noise(value: float, noisy: float, noise: float) -> tuple[float, float]:
    """Return the bias of a range by the noise of the sensors, and its standard uncertainty.

    The bias follows from the change by noise of the same size that is added once more
    (`errormotion.estimation.extremes`): between that of a motion with a pointed distribution and that of one which is
    flat about its extremes, such as a vibration. The two extreme values have noise of their own.
    """
    change = max(noisy - value, 0.0)
    return FLAT * change, float(np.hypot((FLAT - POINTED) * change, np.sqrt(2) * noise))
