"""The measurement model: touches of balls that see the motion of the frame of the axes cycle by cycle.

In a touch of ball i in direction j at time t the commanded position of the tip is p, and the true one p + e(p, t),

    |p + e(p, t) - b_i| = reach_ij + noise

``reach_ij`` is the sum of ball and tip radius, form of the ball, pre-travel in this direction and geometric error of
the axes: it is the same in every cycle, and none of its parts needs to be known. Unknowns are the twists of all cycles
except the cold one, whose twist is zero, and all reaches; b_i only defines the directions of the reaches and follows
from a sphere fit. Between the cycles the twist follows a parabola through three of them, or is constant.

For a dataset of centres, p is the centre, and p + e(p, t) = b_i replaces the equation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import FitError, MethodError
from errormotion.estimation.blocks import Block, Constant, Noise
from errormotion.estimation.checks.candidates import Candidate, steps
from errormotion.estimation.checks.exclusions import Cleaned, cleaned
from errormotion.estimation.fit import Fit, fit
from errormotion.estimation.problem import Problem
from errormotion.estimation.sources import Places
from errormotion.kinematics.iso import DOF
from errormotion.measurement import Observed
from errormotion.methods.normal_vector.identification.freedoms import FLAT, Motion, check_layout, spread
from errormotion.methods.normal_vector.identification.reading import (
    Readings,
    check_balls,
    check_jumps,
    coordinates,
    read,
)
from errormotion.methods.normal_vector.identification.spheres import Observations, improved

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.methods.normal_vector.settings import NormalVectorSettings

T = TypeVar("T")
COLD = "cold reference"
"""Group of the uncertainty that all cycles have in common by the reaches."""
RADIUS = 0.01
"""Radius of balls and stylus, m: over this length a reach bends."""
CAUSE = "Check the mounting of the balls and the axes that carry the tool (tool_axes)."


class Unknowns(NamedTuple, Generic[T]):
    """Motion of each cycle, m and rad, and distance of each touch from its ball, m; for centres, their positions."""

    twist: T
    reach: T


class Known(NamedTuple, Generic[T]):
    """Centre of each ball, m: exact, since it defines the direction of the reach only."""

    centre: T


def observe(raw: xr.Dataset, settings: NormalVectorSettings) -> tuple[Observed, Probing]:
    """Return the touches, or centres, of a raw dataset as a problem of least squares, and how it is stated.

    Raises
    ------
    MethodError
        The data do not determine the motion, or contradict the stated balls.
    """
    notes: list[str] = []
    data = read(raw, settings, notes)
    motion = _motion(data, settings)
    probing = Probing(data, motion, settings.interpolate and data.timed)
    try:
        problem = probing.determined(probing.problem())
    except FitError as error:
        raise MethodError(f"{error}.", code=error.code) from error
    k = len(data.seen.cycle_time)
    reference = "cold" if settings.reference == "cold" else "first"
    observed = Observed(
        problem=problem,
        places=Places(lambda x, _: x.twist, k),
        freedoms=[DOF[i] for i in motion.seen],
        dims=("time",),
        coords=coordinates(raw, data),
        component="tool",
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=motion.point.tolist(),
        reference=f"mean state of the {reference} probing cycle",
        shared=COLD,
        what=data.what,
        noise_cause=CAUSE,
        noise_increases=settings.noise == "auto",
        noise_size=lambda size: f"{size * 1e6:.3g} um",
        refresh=probing.refreshed,
        structure=probing.determined,
        robust=settings.robust,
        suspects=probing.suspects(settings.smallest_move),
        name=probing.name,
        whole=True,
        attributes={"lever_axes": "" if data.tool_axes == "XYZ" else data.tool_axes},
        notes=notes,
    )
    return observed, probing


@dataclass(frozen=True, eq=False)
class Probing:
    """Touches of b balls in k cycles, m each; or, as m numbers, the coordinates of centres.

    Attributes
    ----------
    data : Readings
    motion : Motion
        The errors that they see.
    interpolate : bool
        Whether the motion between the cycles follows a parabola; otherwise it is constant during each.
    """

    data: Readings
    motion: Motion
    interpolate: bool

    @property
    def shape(self) -> tuple[int, int, int]:
        """Numbers of cycles, balls, and touches or coordinates."""
        k, b, m = self.data.seen.valid.shape
        return k, b, m

    @cached_property
    def _index(self) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Cycle, ball and reach of each reading."""
        k, b, m = self.shape
        m = m if self.data.seen.touched else 1
        cycle, ball, touch = (each.ravel() for each in np.meshgrid(*map(np.arange, (k, b, m)), indexing="ij"))
        return cycle, ball, ball * m + touch

    def problem(self) -> Problem:
        """Return the least-squares problem of all readings; `determined` completes it."""
        seen, motion = self.data.seen, self.motion
        cycle, ball, reach = self._index
        k, b, m = self.shape
        unknown = Block(start=np.zeros((k, len(motion.seen))), index=cycle, scale=spread_of(seen))
        stated = bool(np.isfinite(self.data.noise))
        size = self.data.noise if stated else 1.0
        if seen.touched:
            centre, radius = seen.spheres
            start = np.repeat(radius, m)[:, None]
            return Problem(
                equation=self._distance,
                derivatives=self._of_distance,
                readings=np.where(seen.valid[..., None], seen.position, np.nan).reshape(-1, 3),
                reading_scale=RADIUS,
                unknowns=Unknowns(unknown, Block(start=start, index=reach, scale=RADIUS, group=COLD)),
                constants=Known(Constant(value=centre, factor=np.zeros((b, 3, 0)), index=ball, scale=RADIUS)),
                noise=Noise(sd=np.full((k * b * m, 3), size), stated=stated),
            )
        valid = np.asarray(seen.valid.all(axis=2))
        position = np.where(valid[..., None], seen.position[:, :, 0], np.nan)
        weight = np.where(valid[..., None, None], seen.weight, np.eye(3)).reshape(-1, 3, 3)
        return Problem(
            equation=self._difference,
            derivatives=self._of_difference,
            readings=position.reshape(-1, 3),
            reading_scale=spread_of(seen),
            unknowns=Unknowns(unknown, Block(start=np.zeros((b, 3)), index=reach, scale=1.0, group=COLD)),
            noise=Noise(root=np.asarray(size * np.linalg.cholesky(np.linalg.inv(weight)), dtype=float), stated=stated),
        )

    # ------------------------------------------------------------------ the equation

    def _true(self, y: Array, x: Unknowns[Array]) -> Array:
        """Return the true positions of the tip, (n, 3)."""
        return np.asarray(y + self.motion.error(x.twist, y))

    def _distance(self, y: Array, x: Unknowns[Array], c: Known[Array]) -> Array:
        return np.asarray(np.linalg.norm(self._true(y, x) - c.centre, axis=1) - x.reach[:, 0])

    def _difference(self, y: Array, x: Unknowns[Array], _: Any) -> Array:
        return np.asarray(self._true(y, x) - x.reach)

    def _of_distance(self, y: Array, x: Unknowns[Array], c: Known[Array]) -> dict[str, Array]:
        """Return the derivatives of the distance by twist, reach and position."""
        away = self._true(y, x) - c.centre
        length = np.linalg.norm(away, axis=1, keepdims=True)
        normal = away / np.where(length > 0, length, 1.0)
        return {
            "twist": self.motion.design(y, normal, x.twist)[:, None],
            "reach": np.full((len(y), 1, 1), -1.0),
            "readings": normal[:, None],  # the stated noise is that along the normal
        }

    def _of_difference(self, y: Array, x: Unknowns[Array], _: Any) -> dict[str, Array]:
        """Return the derivatives of the coordinates by twist, centre and position."""
        axes = np.broadcast_to(np.eye(3), (len(y), 3, 3))
        position = np.broadcast_to(y[:, None], axes.shape)
        return {
            "twist": self.motion.design(position, axes, x.twist[:, None]),
            "reach": -axes,
            "readings": axes,
        }

    # ------------------------------------------------------------------ what depends on the used readings

    def seen(self, problem: Problem) -> Observations:
        """Return the readings of a problem as observations."""
        k, b, m = self.shape
        y = problem.y.reshape(k, b, -1, 3)
        return replace(self.data.seen.without(~self._valid(problem)), position=np.broadcast_to(y, (k, b, m, 3)))

    def _valid(self, problem: Problem) -> NDArray[np.bool_]:
        """Return which numbers of a problem are known, (k, b, m)."""
        k, b, _ = self.shape
        whole = ~np.isnan(problem.readings).any(axis=1)
        return np.broadcast_to(whole.reshape(k, b, -1), self.shape)

    def determined(self, problem: Problem) -> Problem:
        """Return a problem without the cycles that do not determine the motion, with the knots of the others.

        Raises
        ------
        FitError
            The cold cycle, or all others, do not determine the motion.
        """
        seen, motion = self.seen(problem), self.motion
        usable = determines_motion(seen, motion, self._anchor(problem))
        if not usable[0]:
            raise FitError(
                "the cold cycle alone does not determine the positions of the balls: too many of its touches are "
                "missing or outliers. Probe the cold machine again, or use a later cycle as the reference",
                code="probing.cold.undetermined",
            )
        used = np.flatnonzero(usable)
        if used.size < 2:
            raise FitError(
                "expected the cold cycle and at least one more; found 1 that determines the motion. Repeat the probing",
                code="probing.cycles.too_few",
            )
        cycle, _, reach = self._index
        lost = ~usable[cycle] | np.isnan(problem.readings).any(axis=1)
        readings = np.where(lost[:, None], np.nan, problem.readings)
        known = ~lost
        twist, border = problem.unknowns.twist, problem.unknowns.reach
        free = usable.copy()
        free[0] = False
        twist = replace(twist, free=free)
        if self.interpolate:
            index, weight = self._knots(seen, used)
            twist = replace(twist, index=index, weight=weight)
        measured = np.bincount(reach[known], minlength=len(border.start)) > 0
        return replace(problem, readings=readings, unknowns=Unknowns(twist, replace(border, free=measured)))

    def _anchor(self, problem: Problem) -> Array:
        """Return the centres that define the directions of the reaches, (b, 3), m; 0 for centres."""
        if not self.data.seen.touched:
            return np.zeros((self.shape[1], 3))
        centres: Array = problem.constants.centre.value
        return centres

    def _knots(self, seen: Observations, used: NDArray[np.intp]) -> tuple[NDArray[np.intp], Array]:
        """Return the cycles whose twists a reading sees, and their weights, (n, 3)."""
        k, b, m = self.shape
        weight = np.zeros((k, b, m, 3))
        weight[used] = knot_weights(seen.mean_time[used], seen.time[used], interpolate=True)
        near = np.repeat(np.arange(k)[:, None], 3, axis=1)
        near[used[1:], 0], near[used[:-1], 2] = used[:-1], used[1:]
        index = np.broadcast_to(near[:, None, None], weight.shape).reshape(-1, 3)
        return np.where(weight.reshape(-1, 3) != 0, index, self._index[0][:, None]), weight.reshape(-1, 3)

    def refreshed(self, problem: Problem, x: Unknowns[Array]) -> Problem:
        """Return the problem with centres of the balls that follow the motion."""
        if not self.data.seen.touched:
            return problem
        twist = problem.unknowns.twist.rows(x.twist)
        true = self._true(problem.y, Unknowns(twist, x.reach)).reshape(*self.shape, 3)
        centre = problem.constants.centre
        value = improved(centre.value, true, self._valid(problem))
        return replace(problem, constants=Known(replace(centre, value=value)))

    # ------------------------------------------------------------------ what may be wrong

    def usable(self, problem: Problem) -> NDArray[np.bool_]:
        """Return which cycles determine the motion, (k,), in a problem that is `determined`."""
        usable: NDArray[np.bool_] = problem.unknowns.twist.free.copy()
        usable[0] = True  # the cold one: its twist is known
        return usable

    def fitted(self, problem: Problem, cycles: NDArray[np.bool_] | None = None) -> Fit:
        """Return the fit of a problem, or of the readings in these cycles (k,) only.

        Raises
        ------
        FitError
            They do not determine the motion.
        """
        if cycles is not None:
            problem = problem.without(~cycles[self._index[0]])
        return fit(self.determined(problem), refresh=self.refreshed, what=self.data.what)

    def cleaned(self, smallest: float) -> Cleaned:
        """Return the fit of all readings without outliers and balls that moved by ``smallest``, m, or more.

        Raises
        ------
        FitError
            They do not determine the motion.
        """
        return cleaned(
            self.problem(),
            suspects=self.suspects(smallest),
            whole=True,
            name=self.name,
            refresh=self.refreshed,
            structure=self.determined,
            what=self.data.what,
        )

    def suspects(self, smallest: float) -> Callable[[Fit], Iterable[Candidate]]:
        """Return the search for balls that moved; a ball that moved is excluded from this cycle on."""
        cycle, ball, _ = self._index

        def found(fit: Fit) -> list[Candidate]:
            n = len(cycle)
            if self.data.seen.touched:
                away = fit.problem.y - fit.problem.constants.centre.rows(fit.problem.constants.centre.value)
                length = np.linalg.norm(away, axis=1, keepdims=True)
                normal = (away / np.where(length > 0, length, 1.0))[:, None]
            else:
                normal = np.broadcast_to(np.eye(3), (n, 3, 3))
            return steps(cycle.astype(float), ball, normal, self.moved, smallest=smallest)(fit)

        return found

    def moved(self, ball: int, cycle: float) -> str:
        """Return the words for a ball that moved."""
        time = self.data.seen.cycle_time[int(cycle)]
        return f"ball {self.data.names[ball]} moved before cycle {int(cycle)} ({time:g} s)"

    def name(self, at: NDArray[np.intp]) -> str:
        """Return the name of a reading."""
        cycle, ball, reach = (int(each[at[0]]) for each in self._index)
        of_ball = f"ball {self.data.names[ball]} in cycle {cycle}"
        return (
            f"touch {reach % self.shape[2] + 1} of {of_ball}" if self.data.seen.touched else f"the centre of {of_ball}"
        )


def _motion(data: Readings, settings: NormalVectorSettings) -> Motion:
    """Return the model of the motion; check the balls."""
    seen, names = data.seen, data.names
    ever = np.any(seen.valid, axis=(0, 2))
    if not ever.all():
        lost = ", ".join(name for name, touched in zip(names, ever, strict=True) if not touched)
        raise MethodError(
            f"Ball {lost} was never touched: remove it from the data, or touch it.", code="probing.ball.not_touched"
        )
    check_jumps(seen, names, settings.ball_tolerance)
    if seen.touched:
        touched = seen.valid.any(axis=0).sum(axis=1)
        if (touched < 4).any():
            i = int(np.argmin(touched))
            raise MethodError(
                f"Ball {names[i]} was touched in {touched[i]} directions; a sphere needs four, preferably five: "
                "around it and on top.",
                code="probing.ball.directions_too_few",
            )
        centre, radius = seen.spheres
    else:
        count = np.maximum(seen.valid[..., 0].sum(axis=0), 1)[:, None]
        centre = np.where(seen.valid[..., :1], seen.position[:, :, 0], 0.0).sum(axis=0) / count
        radius = np.full(len(names), np.nan)
    check_balls(centre, radius, data, settings.ball_tolerance)
    check_layout(centre, names, data.tool_axes)
    point = settings.functional_point
    return Motion(data.tool_axes, np.round(centre.mean(axis=0), 4) if point is None else np.array(point, float))


def spread_of(seen: Observations) -> float:
    """Return the root mean square distance of the measured positions from their mean, m; 1 m without any."""
    positions = seen.position[seen.valid]
    return (spread(positions) or 1.0) if len(positions) else 1.0


def determines_motion(seen: Observations, motion: Motion, anchor: Array) -> NDArray[np.bool_]:
    """Return which cycles determine the motion alone, (k,), with touches of balls at ``anchor`` (b, 3), m."""
    if seen.touched:
        away = seen.position - anchor[:, None]
        length = np.linalg.norm(away, axis=-1, keepdims=True)
        normal = away / np.where(length > 0, length, 1.0)
    else:
        normal = np.broadcast_to(np.eye(3), (*seen.position.shape[:2], 3, 3))
    H = motion.design(seen.position, normal)
    H = H / np.where(np.array(motion.seen) < 3, 1.0, spread_of(seen))
    H = np.where(seen.valid[..., None], H, 0.0).reshape(len(H), -1, H.shape[-1])
    N = np.swapaxes(H, 1, 2) @ H
    eigenvalues = np.linalg.eigvalsh(N)
    return np.asarray((eigenvalues[:, 0] > FLAT**2 * eigenvalues[:, -1]) & (eigenvalues[:, -1] > 0))


def knot_weights(time: Array, at: Array, interpolate: bool) -> Array:
    """Return the weights of the twists of the previous, the same and the next cycle in that at times ``at`` (k, b, m).

    There is no drift within the first cycle, which is the reference state; in the last cycle the drift is linear.
    """
    weights = np.zeros((*at.shape, 3))
    weights[..., 1] = 1.0
    if interpolate:
        u = at - time[:, None, None]
        a, b = (step[:, None, None] for step in (time[1:-1] - time[:-2], time[2:] - time[1:-1]))
        w = u[1:-1]
        weights[1:-1, ..., 0] = w * (w - b) / (a * (a + b))
        weights[1:-1, ..., 2] = w * (w + a) / (b * (a + b))
        weights[-1, ..., 0] = -u[-1] / (time[-1] - time[-2])
        weights[1:, ..., 1] -= weights[1:, ..., 0] + weights[1:, ..., 2]
    weights[0] = 0.0
    return weights
