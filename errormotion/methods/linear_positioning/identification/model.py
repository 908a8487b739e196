"""The measurement model of readings along lines: the freedoms of an axis, or diagonals of a volume.

A reading y of line k in run j, approached forward (+) or backward (-), at a target i with the distance l from the zero
of the instrument and the scaled position z, fulfils, but for its noise,

    g_k (y - [alpha_m (T_m + t_m) - alpha_w (T_w + t_w)] l) + (s + c_k) l
        = m_ki +- b_ki + r_ki + (o + q z)_kj +- (p + w z)_kj

Unknowns are the mean m and the half reversal b at each target, an error r of the instrument that is alike in all runs,
and the effects of the runs; their variances, and that of the noise, are those of
`errormotion.methods.linear_positioning.identification.scatter`. Constants, with the uncertainty that is the source of
the same name in the budget, are the scale s of the lengths, the alignment c, the gain g, and the coefficients alpha and
temperatures of what expands (T above the reference). The errors are m; of a straightness, relative to the line through
its first and its last target.

Alignment: along a line at the angle a to the axis, the length l is measured as ``l cos a``, too short by ``l a^2 / 2``.
With independent components of standard uncertainty u, a^2 / 2 has an exponential distribution of mean u^2 and standard
deviation u^2. The readings are not corrected, as the standard defines its figures: c is 0, and its uncertainty is the
root mean square of this one-sided error, sqrt(2) u^2. Where the alignment is stated, further figures are corrected for
the mean; their source is the standard deviation.

The figures of ISO 230-2 are no part of the model. They are extremes of means and standard deviations of the readings,
which the standard states without weights, and their true values follow from draws of the true curves and variances
(`identification.extremes`), not of the readings. They take the effects of the constants from the solution.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.certificates import certified
from errormotion.errors import MethodError
from errormotion.estimation.checks.series import SIGNIFICANT, Trend, trend
from errormotion.estimation.problem import READINGS
from errormotion.estimation.robust import scale_about_zero
from errormotion.estimation.sources import Source
from errormotion.measurement import Block, Constant, Noise, Observed, Problem
from errormotion.methods.linear_positioning.identification.scatter import EQUAL, Scatter, scatter
from errormotion.methods.linear_positioning.schema import APPROACHES

if TYPE_CHECKING:
    from errormotion.measurement.observed import Solved
    from errormotion.methods.linear_positioning.identification.reading import Readings
    from errormotion.methods.linear_positioning.settings import LinearPositioningSettings

T = TypeVar("T")
TREND = "trend over the test"
DRIFT, ALIGNMENT, LENGTH, GAIN, EXPANSION, END, NOISE = (
    *("drift from run to run", "alignment", "scale of the lengths", "gain of the instrument", "scales"),
    *("ends of the reference line", "readings"),
)
"""Groups of sources."""
OF_LINE = "angle of the measured line to the axis"
COEFFICIENT, TEMPERATURE = "coefficient of expansion", "temperature"
_EFFECTS = (
    "offset of the runs",
    "slope of the runs",
    "offset of the runs by approach",
    "slope of the runs by approach",
)


class Unknowns(NamedTuple, Generic[T]):
    """Columns: mean, half reversal and error of the instrument of each line; the four effects of a run on each."""

    target: T
    run: T


class Known(NamedTuple, Generic[T]):
    """Constants; columns are lines, or the two sides that expand."""

    length: T
    alignment: T
    gain: T
    coefficient: T
    temperature: T


def spreads_of(readings: Readings, settings: LinearPositioningSettings, what: str = "") -> list[Scatter]:
    """Return the variances of each line; ``what`` it is, for messages, such as "Diagonal "."""
    spreads = []
    for k, (x, z) in enumerate(zip(readings.corrected, readings.z, strict=True)):
        drift, stated = (None if np.isnan(of[k]) else float(of[k]) for of in (readings.drift, readings.scatter))
        drift = None if drift is None else drift / np.sqrt(12.0)
        try:
            spreads.append(scatter(x, z, kind=settings.scatter, drift=drift, stated=stated))
        except MethodError as error:
            raise MethodError(f"{what}{readings.names[k]}: {error}", code=error.code) from None
    return spreads


def trends_of(readings: Readings) -> list[Trend | None]:
    """Return the trend from run to run of each line, None where there is none that is significant."""
    trends = []
    for x in readings.corrected:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a target, or a run, without readings
            offset = np.nanmean(x - np.nanmean(x, axis=1, keepdims=True), axis=(0, 2))
        of_runs = trend(offset)
        seen = of_runs is not None and of_runs.probability < SIGNIFICANT / len(readings.names)
        trends.append(of_runs if seen else None)
    return trends


def trend_notes(readings: Readings, trends: Sequence[Trend | None]) -> list[str]:
    """Return a sentence on lines whose readings drift."""
    sizes = []
    for name, each in zip(readings.names, trends, strict=True):
        if each is not None:
            angle = name[0] == "E" and name[1] in "ABC"
            sizes.append(f"{name}: {each.range * 1e6:+.3g} {'urad' if angle else 'um'}")
    if not sizes:
        return []
    return [
        f"The readings drift from the first to the last run ({', '.join(sizes)}): the errors are those in the middle "
        "of the test, and the drift is a part of their uncertainty. Measure when the machine has warmed up, or faster."
    ]


def reversal_by_trend(readings: Readings, trends: Sequence[Trend | None], cycle: str) -> Array:
    """Return the standard uncertainties of the reversal by a trend, (line, target).

    A trend of a in each run displaces a backward reading against the forward one by ``a dt`` after the part dt of a
    run. In a linear cycle dt decreases from 1 at the first target to 0 at the last one, in a pendulum cycle it is 1/2.
    The unknown change within a run makes it uncertain: as a rectangular distribution of this half width.
    """
    m, runs = readings.position.shape[1], readings.x.shape[2]
    later = 1.0 - np.arange(m) / max(m - 1, 1) if cycle == "linear" else np.full(m, 0.5)
    ranges = np.array([0.0 if each is None else each.range for each in trends])
    return np.asarray(np.abs(ranges)[:, None] / max(runs - 1, 1) * later / np.sqrt(3.0))


def known_of(readings: Readings) -> Array:
    """Return 0 where the mean of the measured approaches is known, otherwise NaN, (line, target).

    Raises
    ------
    MethodError
        None is known.
    """
    seen: Array = np.any(np.isfinite(readings.x), axis=2)
    measured = np.any(seen, axis=2)
    known = np.where((seen | ~measured[..., None]).all(axis=1), 0.0, np.nan)
    if np.isnan(known).all():
        raise MethodError(
            "deviation: expected a target that was reached in all measured directions; found none. Measure more.",
            code="position.target.not_reached",
        )
    return known


def problem_of(readings: Readings, spreads: Sequence[Scatter]) -> Problem:
    """Return the readings, in the order (run, approach, target) as recorded, as a problem of least squares."""
    count, m = readings.position.shape
    runs = readings.x.shape[2]
    run, way, stop = (i.ravel() for i in np.indices((runs, len(readings.approach), len(readings.order))))
    a, i = readings.approach[way], readings.order[stop]
    sign = np.where(a == 0, 1.0, -1.0)
    lever, z = readings.lever[:, i].T, readings.z[:, i].T  # (n, line)
    sides = readings.sides
    excess = np.stack([side.excess[a, run, i] for side in sides], axis=1) if sides else np.zeros((a.size, 1))
    of_side = np.array([side.sign for side in sides] or [0.0])
    x = np.moveaxis(readings.x, 0, -1)[a, run, i]
    forward = np.stack([np.ones((a.size, count)), np.broadcast_to(sign[:, None], (a.size, count))])
    design = np.stack([forward[0], z, forward[1], forward[1] * z])  # (effect, n, line)

    def equation(y: Array, u: Unknowns[Array], c: Known[Array]) -> Array:
        expansion = np.sum(of_side * c.coefficient * (excess + c.temperature), axis=1, keepdims=True)
        true = c.gain * (y - expansion * lever) + (c.length + c.alignment) * lever
        mean, half, at_target = np.split(u.target, 3, axis=1)
        effects = u.run.reshape(-1, 4, count)
        return np.asarray(true - mean - sign[:, None] * half - at_target - np.einsum("ank,nak->nk", design, effects))

    line = np.eye(count)
    derivatives = {
        "target": -np.concatenate([np.einsum("nk,kl->nkl", A, line) for A in (*forward, forward[0])], axis=2),
        "run": -np.concatenate([np.einsum("nk,kl->nkl", A, line) for A in design], axis=2),
        READINGS: np.broadcast_to(line, (a.size, count, count)),
    }
    seen: Array = np.any(np.isfinite(readings.x), axis=2)  # (line, approach, target)
    at_target = np.tile(readings.at_target, (m, 1))
    free = np.concatenate([seen.any(axis=1).T, seen.all(axis=1).T, at_target > 0], axis=1)
    prior = np.concatenate([np.full((m, 2 * count), np.inf), np.where(at_target > 0, at_target, np.inf)], axis=1)
    of_runs = np.sqrt(np.stack([spread.run_stated for spread in spreads], axis=1)).ravel()  # (effect, line)
    own = np.stack([spread.own_stated for spread in spreads])
    sd = np.moveaxis(np.sqrt(np.nan_to_num(own)), 0, -1)[a, i]
    return Problem(
        equation=equation,
        readings=x,
        unknowns=Unknowns(
            Block(start=np.zeros((m, 3 * count)), index=i, scale=1.0, free=free, prior=prior),
            Block(
                start=np.zeros((runs, 4 * count)),
                index=run,
                scale=1.0,
                free=np.tile(of_runs > 0, (runs, 1)),
                prior=np.where(of_runs > 0, of_runs, np.inf),
                group=DRIFT,
                component=tuple(f"{effect}, {name}" for effect in _EFFECTS for name in readings.names),
            ),
        ),
        constants=_constants(readings, np.zeros(a.size, dtype=np.intp)),
        noise=Noise(sd=np.maximum(sd, EQUAL)),
        derivatives=lambda *_: derivatives,
        linear=True,
    )


def _constants(readings: Readings, one: NDArray[np.intp]) -> Known[Constant]:
    """Return all constants with their uncertainty; the sign of a source is that of its effect on the errors."""
    names, sides, along = readings.names, readings.sides, (readings.lever != 0).any(axis=1)

    def constant(value: float, u: Sequence[float] | Array, group: str, sources: Sequence[str]) -> Constant:
        """Return equal values, each with its own source; without one where ``u`` is 0."""
        used = np.flatnonzero(u).tolist()
        named = [sources[k] for k in used]
        ids = certified(readings.attrs, {name: item for name, item in items.items() if name in named})
        return Constant(
            value=np.full((1, len(u)), value),
            factor=np.diag(u)[None, :, used],
            index=one,
            scale=1.0,
            group=group,
            names=named,
            identity=[ids.get(name, "") for name in named],
        )

    items = {
        LENGTH: ("tracker", "scale"),
        f"{COEFFICIENT}, machine": ("scales", "coefficient of expansion"),
        f"{TEMPERATURE}, machine": ("scale_thermometer", f"offset at {readings.axis}"),
    }
    coefficient = constant(
        0.0,
        [-side.coefficient_u for side in sides] or [0.0],
        EXPANSION,
        [f"{COEFFICIENT}, {side.name}" for side in sides],
    )
    u_T = [-side.temperature_u * (side.coefficient != 0) for side in sides] or [0.0]
    return Known(
        length=constant(0.0, [readings.length * along.any()], LENGTH, [LENGTH]),
        alignment=constant(
            0.0, np.sqrt(2.0) * readings.alignment**2 * along, ALIGNMENT, [f"{OF_LINE}, {name}" for name in names]
        ),
        gain=constant(1.0, readings.gain, GAIN, [f"gain of {name}" for name in names]),
        coefficient=replace(coefficient, value=np.array([[side.coefficient for side in sides] or [0.0]])),
        temperature=constant(0.0, u_T, EXPANSION, [f"{TEMPERATURE}, {side.name}" for side in sides]),
    )


def observed(
    readings: Readings, problem: Problem, names: Sequence[str], trends: Sequence[Trend | None] = (), **others: Any
) -> Observed:
    """Return readings with what the results of axes and diagonals have in common; ``others`` as for `Observed`.

    Outliers are named, but not excluded, and the reliability of single readings is not stated: the figures of the
    standard are those of all readings.
    """
    shifts = [None if straight else each for straight, each in zip(readings.straight, trends, strict=bool(trends))]
    return Observed(
        problem=problem,
        frame=str(readings.attrs.get("frame", "machine")),
        shared=NOISE,
        robust=False,
        reliability=False,
        noise_increases=False,
        examined=_examined(readings, problem),
        name=partial(_name_of, readings),
        finish=partial(_finished, names=names, trends=shifts),
        **others,
    )


def _examined(readings: Readings, problem: Problem) -> Problem:
    """Return the readings with a noise that outliers do not increase: of each target, at least that of its line."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a target without readings
        scatter = readings.corrected - np.nanmedian(readings.corrected, axis=2, keepdims=True)
    of_line = np.array([scale_about_zero(one) for one in scatter])
    of_target = np.array([[scale_about_zero(at) for at in np.moveaxis(one, -1, 0)] for one in scatter])
    sd = np.fmax(of_target, of_line[:, None])[:, _stops(readings)].T
    return replace(problem, noise=Noise(sd=np.maximum(sd, EQUAL)))


def _stops(readings: Readings) -> NDArray[np.intp]:
    """Return the target of each reading, in the order of the problem."""
    return np.tile(readings.order, readings.x.shape[2] * len(readings.approach))


def _name_of(readings: Readings, at: NDArray[np.intp]) -> str:
    """Return the name of a reading (reading, line)."""
    per_run = len(readings.approach) * len(readings.order)
    run, rest = divmod(int(at[0]), per_run)
    way, stop = divmod(rest, len(readings.order))
    line = int(at[1]) if len(at) > 1 else 0
    place = 1e3 * readings.position[line, readings.order[stop]]
    return f"{readings.names[line]} at {place:.6g} mm, {APPROACHES[readings.approach[way]]}, run {run + 1}"


def _finished(solved: Solved, names: Sequence[str], trends: Sequence[Trend | None]) -> Solved:
    """Return a solution with the effects of the runs first and the noise last.

    A trend is a further source: at any instant of the test the errors are those of its middle but for a part of the
    range, as a rectangular distribution. A straightness is relative to its ends, and has none.

    The noise has been estimated from the same readings, and is not compared with them again.
    """
    if not solved.propagated:
        return solved
    errors = solved.relative.errors
    sources = sorted(errors.sources, key=lambda source: {DRIFT: 0, NOISE: 2}.get(source.group, 1))
    for k, each in enumerate(trends):
        if each is not None:
            effect = np.where(np.isnan(errors.value), np.nan, 0.0)
            of_line = effect[:, k] if effect.shape[1] == len(names) else effect.reshape(len(names), -1)[k]
            of_line += each.range / np.sqrt(12.0)
            sources.append(Source(f"{TREND}, {names[k]}", TREND, effect))
    relative = replace(solved.relative, errors=replace(errors, sources=sources))
    return replace(solved, relative=relative, scatter=replace(solved.scatter, note=""))
