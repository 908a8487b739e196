"""What the result says besides the errors: centres, displacements and residuals, exclusions, the published normals."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import provenance
from errormotion.errors import MethodError
from errormotion.estimation.checks.exclusions import Exclusion
from errormotion.estimation.sources import Errors, Source
from errormotion.estimation.variance import expansion
from errormotion.measurement import ModelMethod, Observed
from errormotion.measurement.identification import Solved, dataset, reliability_of, solve
from errormotion.methods.normal_vector import model
from errormotion.methods.normal_vector.contradiction import contradiction
from errormotion.methods.normal_vector.identification import normals
from errormotion.methods.normal_vector.identification.spheres import Centres, Observations, centres
from errormotion.methods.normal_vector.model import COLD, Probing
from errormotion.methods.normal_vector.schema import EACH, RESULT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from errormotion.methods.normal_vector.identification.reading import Readings
    from errormotion.methods.normal_vector.settings import NormalVectorSettings

log = logging.getLogger(__name__)

MIN_SOURCE = 1e-4
"""Smallest variance of a common source, relative to the largest one, that is stated separately."""
SHOWN = 8
"""Unknown cycles that are named."""


@dataclass(frozen=True)
class Excluded:
    """What the search for outliers excluded.

    Attributes
    ----------
    wrong : ndarray of bool (k, b, m)
        Outliers.
    moves : list of (Exclusion, int, int)
        Balls that moved: what was found, the ball, and the first cycle after the move.
    lost : ndarray of int
        Cycles that do not determine the motion.
    """

    wrong: NDArray[np.bool_]
    moves: list[tuple[Exclusion, int, int]]
    lost: NDArray[np.intp]

    @classmethod
    def of(cls, solved: Solved, probing: Probing) -> Excluded:
        """Return what was excluded from a solution."""
        k, b, m = probing.shape
        wrong = np.zeros((k, b, m), dtype=bool)
        moves = []
        made = () if solved.cleaned is None else solved.cleaned.made
        names = {probing.moved(ball, cycle): (ball, cycle) for ball in range(b) for cycle in range(k)} if made else {}
        for exclusion in made:
            if exclusion.words in names:
                moves.append((exclusion, *names[exclusion.words]))
            else:
                wrong |= exclusion.readings.any(axis=1).reshape(k, b, -1)
        lost = np.flatnonzero(~probing.usable(solved.fit.problem))
        return cls(wrong, moves, lost)


def identified(method: ModelMethod, raw: xr.Dataset, settings: NormalVectorSettings) -> xr.Dataset:
    """Return the error dataset of raw data that follow their schema.

    Raises
    ------
    MethodError
        The data do not determine the motion, or contradict the stated balls.
    """
    solved = solve(method.observe(raw, settings))
    steps = ["joint least squares of all touches"]
    if settings.procedure == "normals":
        steps = ["normals of two planes through four balls, Cayley"]
    if solved.cleaned is not None:
        steps += [f"excluded: {exclusion.words}" for exclusion in solved.cleaned.made]
    errors = dataset(method, solved, raw, method.info, provenance.make(settings, raw, None, steps=steps))
    for note in errors.em.notes:
        log.warning(note)
    return errors.assign_attrs(tool_axes=str(raw.attrs.get("tool_axes", settings.tool_axes)))


def observe(raw: xr.Dataset, settings: NormalVectorSettings) -> Observed:
    """Return the model of raw data, with what its solution says besides the errors; see `model.observe`."""
    observed, probing = model.observe(raw, settings)
    return replace(observed, finish=lambda solved: finished(solved, probing, settings, observed.notes))


def finished(solved: Solved, probing: Probing, settings: NormalVectorSettings, notes: Sequence[str]) -> Solved:
    """Return a solution with times, notes and further variables; with ``procedure = normals`` with their errors.

    Raises
    ------
    MethodError
        The normals are not determined, and are wanted.
    """
    data, problem, fit = probing.data, solved.fit.problem, solved.fit
    seen, excluded = probing.seen(problem), Excluded.of(solved, probing)
    noise = data.noise if np.isfinite(data.noise) else 1.0
    noise *= float(np.sqrt(solved.scatter.factor) * expansion(solved.scatter.freedom))
    anchor = fit.constants.centre if seen.touched else fit.unknowns.reach
    measured_reach = problem.unknowns.reach.freed
    reach = np.where(measured_reach, fit.unknowns.reach, np.nan).reshape(len(data.names), -1)
    best = solved.relative.errors
    best = _compressed(best, excluded.lost) if solved.propagated else _unknown(best, excluded.lost)
    if not solved.propagated and settings.procedure == "rigid":
        return replace(solved, relative=replace(solved.relative, errors=best))
    other, why = _published(probing, solved, seen, excluded, anchor, reach, settings, noise)
    if settings.procedure == "normals" and other is None:
        raise MethodError("procedure = normals: " + why, code="probing.normals.not_possible")
    chosen = best if other is None or settings.procedure == "rigid" else other
    time = _times(probing, seen, excluded)
    several = (
        "More than one ball appears to have moved. Check their mounting and the axes that carry the tool (tool_axes). "
        "A machine that does not move as one rigid frame has the same effect."
    )
    doubts = [contradiction(solved, probing, settings.smallest_move), several if len(excluded.moves) > 1 else ""]
    observed = replace(
        solved.observed,
        coords=dict(solved.observed.coords) | {"time": ("time", time, {"units": "s"})},
        notes=[*notes, *_exclusions(excluded, data), why],
        doubts=[*solved.observed.doubts, *doubts],
        extras=_extras(
            probing, solved, excluded, centres(_every(probing, seen, excluded), anchor, reach), noise, best, other
        ),
        attributes=dict(solved.observed.attributes)
        | {
            "reference_sources": [source.name for source in chosen.sources],
            "reference_interval": (float(time[0]), float(time[0])),
        },
    )
    return replace(solved, observed=observed, relative=replace(solved.relative, errors=chosen))


def _unknown(errors: Errors, lost: NDArray[np.intp]) -> Errors:
    """Return values that are NaN for lost cycles."""
    value = errors.value.copy()
    value[lost] = np.nan
    return replace(errors, value=value)


def _compressed(errors: Errors, lost: NDArray[np.intp]) -> Errors:
    """Return errors with a few independent sources in place of all that are common, and NaN for lost cycles."""
    shared, C = np.moveaxis(errors.influence, 0, 2), errors.covariance
    u = np.sqrt(np.einsum("kii->ki", C))
    F = np.where(u[..., None] > 0, shared / np.where(u > 0, u, 1.0)[..., None], 0.0)
    F = np.nan_to_num(F).reshape(-1, shared.shape[2])
    values, vectors = np.linalg.eigh(F.T @ F)
    shared = shared @ vectors[:, values > MIN_SOURCE * max(values[-1], 1e-300)][:, ::-1]
    value, own = errors.value.copy(), C - shared @ np.swapaxes(shared, 1, 2)
    for array in (value, own, shared):
        array[lost] = np.nan
    return Errors(value, own, [Source(f"{COLD} {i + 1}", COLD, shared[..., i]) for i in range(shared.shape[2])])


def _published(
    probing: Probing,
    solved: Solved,
    seen: Observations,
    excluded: Excluded,
    anchor: Array,
    reach: Array,
    settings: NormalVectorSettings,
    noise: float,
) -> tuple[Errors | None, str]:
    """Return the result of the published construction from four balls; None, and why, if it is not applicable."""
    data, motion = probing.data, probing.motion
    if motion.tool_axes != "XYZ":
        return None, (
            "The normals of planes through balls are not applicable: where axes carry the workpiece, a rotation of "
            "their frame shears the apparent arrangement of the balls instead of rotating it."
        )
    if len(data.names) < 4:
        return None, f"The normals of two planes need four balls; found {len(data.names)}."
    four = normals.chosen(data.names, settings.normals_balls)
    simultaneous = centres(_at_cycle_time(probing, solved, seen), anchor, reach)
    centre, cofactor = simultaneous.centre[:, four].copy(), noise**2 * simultaneous.cofactor[:, four]
    for _, ball, cycle in excluded.moves:
        if ball in four:
            centre[cycle:] = np.nan
    known = np.all(np.isfinite(centre), axis=(1, 2))
    if not known[0]:
        return None, "The normals are unknown: one of their balls is missing in the cold cycle."
    if not normals.planes_apart(centre[0]):
        return None, normals.ONE_PLANE
    k = len(centre)
    twist, own, shared = np.full((k, 6), np.nan), np.full((k, 6, 6), np.nan), np.full((k, 6, 12), np.nan)
    twist[known] = normals.twist(centre[0], centre[known], motion.point)
    total = normals.covariance(cofactor[0], cofactor[known], motion.point, centre[0])
    cold = normals.jacobian(centre[0], motion.point)
    shared[known] = np.einsum("ubi,bij->ubj", cold, np.linalg.cholesky(cofactor[0])).reshape(6, 12)
    own[known] = total - shared[known] @ np.swapaxes(shared[known], 1, 2)
    for array in (own, shared):
        array[0] = 0.0
    sources = [Source("", "", shared[..., i]) for i in range(shared.shape[2])]
    return _compressed(Errors(twist, own, sources), np.flatnonzero(~known)), ""


def _at_cycle_time(probing: Probing, solved: Solved, seen: Observations) -> Observations:
    """Return the touches corrected for the drift within each cycle, as if made simultaneously."""
    if not probing.interpolate or not seen.touched:
        return seen
    motion, twist = probing.motion, solved.fit.unknowns.twist
    at_touch = solved.fit.problem.unknowns.twist.rows(twist).reshape(*seen.time.shape, -1)
    drift = motion.error(at_touch, seen.position) - motion.error(twist[:, None, None], seen.position)
    return replace(seen, position=seen.position + np.where(seen.valid[..., None], drift, 0.0))


def _every(probing: Probing, seen: Observations, excluded: Excluded) -> Observations:
    """Return all readings but outliers: those of balls that moved show where they are."""
    every = probing.data.seen.without(excluded.wrong)
    return replace(every, position=np.where(seen.valid[..., None], seen.position, every.position))


def _times(probing: Probing, seen: Observations, excluded: Excluded) -> Array:
    """Return the time of each cycle: the mean of its valid touches if these have times, else its start."""
    every = probing.data.seen
    time = every.cycle_time.copy()
    if not probing.data.timed:
        return time
    known = every.valid.any(axis=(1, 2))
    time[known] = every.mean_time[known]
    if probing.interpolate:
        used = np.setdiff1d(np.arange(len(time)), excluded.lost)
        time[used] = seen.mean_time[used]
    return time


def _exclusions(excluded: Excluded, data: Readings) -> list[str]:
    """Return notes on outliers, balls that moved, and cycles without a result."""
    notes: list[str] = []
    wrong = excluded.wrong if data.seen.touched else excluded.wrong.any(axis=2)
    if wrong.any():
        count = int(wrong.sum())
        k, i = (int(index) for index in np.argwhere(wrong)[0][:2])
        what = data.what.removeprefix("the ")
        notes.append(
            f"{count} outliers among the {what} were excluded, the first of ball {data.names[i]} in cycle {k}."
        )
    for move, _, _ in excluded.moves:
        shift = ", ".join(f"{value * 1e6:.2g}" for value in move.size)
        others = [words for words in move.rivals if words not in [each.words for each, _, _ in excluded.moves]]
        also = f" It may also be that {' or '.join(others)}." if others else ""
        notes.append(
            f"{move.words[:1].upper()}{move.words[1:]}, by about ({shift}) um as measured; excluded from this cycle "
            f"on.{also}"
        )
    lost = excluded.lost
    if lost.size:
        shown = ", ".join(map(str, lost[:SHOWN])) + (f" and {lost.size - SHOWN} more" if lost.size > SHOWN else "")
        notes.append(f"{lost.size} cycles do not determine the motion and are unknown: {shown}.")
    return notes


def _extras(
    probing: Probing,
    solved: Solved,
    excluded: Excluded,
    measured: Centres,
    noise: float,
    best: Errors,
    other: Errors | None,
) -> dict[str, xr.DataArray]:
    """Return the further variables of the result."""
    k, b, m = probing.shape
    valid = probing.data.seen.valid
    flag = np.where(valid, 0, 1)
    moved = np.zeros((k, b), dtype=np.int8)
    for _, ball, cycle in excluded.moves:
        moved[cycle:, ball] = 1
    flag[(moved[..., None] > 0) & (flag == 0)] = 3
    flag[excluded.wrong & valid] = 2
    flag[excluded.lost] = np.where(flag[excluded.lost] == 0, 4, flag[excluded.lost])
    plain, C, loss = np.full((k, 6), np.nan), np.full((k, 6, 6), np.nan), np.full((k, 6), np.nan)
    if other is not None:
        plain, C = other.value, other.covariance
        u, u_best = (np.sqrt(np.einsum("kii->ki", each.covariance)) for each in (other, best))
        loss = np.where(u_best > 0, u / np.where(u_best > 0, u_best, 1.0), np.nan)
    values = {
        "centre": measured.centre,
        "centre_covariance": noise**2 * measured.cofactor,
        "ball_displacement": measured.centre - measured.centre[0],
        "residual": solved.fit.residual.reshape(k, b, m),
        "left_out": flag.astype(np.int8),
        "ball_moved": moved,
        "normals_errors": plain,
        "normals_covariance": C,
        "normals_loss": loss,
        "noise": noise,
    }
    checked = reliability_of(solved, "m")
    values |= {name: array.reshape(k, b, m) for name, (array, _) in checked.items()}
    of_check = {name: attrs for name, (_, attrs) in checked.items()}
    each = EACH if probing.data.seen.touched else "direction"
    return {
        name: xr.DataArray(
            values[name], dims=[each if dim == EACH else dim for dim in dims], attrs=attrs | of_check.get(name, {})
        )
        for name, (dims, attrs) in RESULT.items()
    }
