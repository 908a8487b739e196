"""Freedoms that distances do not determine.

A target with k readings contributes k - 3 equations for the stations, which have 4 n - 6 unknowns: positions and dead
paths without the six rigid motions. Four stations require ten targets. With an unsuitable layout these equations are
dependent: with stations in one plane two freedoms are undetermined with any targets, and a target in one line with two
stations, or in one plane with all, has a direction in which no distance changes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import FitError, MethodError
from errormotion.estimation.fit import Fit
from errormotion.estimation.linear.system import linearised
from errormotion.estimation.problem import Problem
from errormotion.kinematics.twists import rigid_motions
from errormotion.methods.multilateration.start import Stations

MAX_SHARE = 0.05
"""Standard uncertainty over the distances above which a freedom is undetermined: the model is not linear over it."""
ROUNDING = 1e-13
"""An eigenvalue below this fraction of the largest is a rounding error."""
FLAT = 0.03
"""Thickness over extent below which stations or targets are in a plane, or on a line."""
WEAK = 20.0
"""Ratio of the uncertainty of a target to the noise from which a note is made."""
WEAK_POSITION = 10.0
"""Uncertainty of a target over the median one, with known stations, above which it has no position. Of m targets, one
with the ratio sqrt(m) does not harm the datum: the limit is half of this if that is larger."""
SINGULAR = 1e-10
"""Determinant of the products of a target's directions, over the cube of their trace, without a position."""
DATUM_SAMPLE = 64
"""Number of evenly distributed targets whose datum is used to detect undetermined freedoms."""
NOT_FINITE = (
    "Expected distances between stations and targets, and a noise, that are not zero; found one of zero, or not "
    "finite. Check positions and noise, and that both are in metres."
)
_TINY = 1e-30
SAME_DIRECTION = 0.05
"""Angle between the lines of sight of two stations, rad, below which these are in one line with the targets."""
_DESCRIBED = 3
_SHARE = 0.1


def refuse_too_few(used: NDArray[np.bool_], approximate: Array | None, target: Array) -> None:
    """Raise MethodError if the readings that are used (n, m) are fewer than the unknowns of the stations.

    Positions of stations (n, 3) and targets (m, 3), m, are those by which the cause is described, if they are known.
    """
    by_target, by_station = used.sum(axis=0), used.sum(axis=1)
    n, m = used.shape
    if n < 4:
        raise MethodError(
            f"Expected at least four stations; found {n}. With three every target has as many unknowns as distances, "
            "so that the stations are not determined. Measure the targets from a further station.",
            code="network.stations.too_few",
        )
    blind = np.flatnonzero(by_station < 4)
    if len(blind):
        raise MethodError(
            f"Expected at least 4 readings of every station; found "
            f"{', '.join(f'{by_station[j]} of station {j + 1}' for j in blind)} for targets with a position. "
            + _cause(approximate, target, "Measure more targets from it, or remove the station."),
            code="network.station.readings_too_few",
        )
    equations, needed = int(np.maximum(by_target - 3, 0).sum()), 4 * n - 6
    if equations < needed:
        full = -(-needed // (n - 3))
        raise MethodError(
            f"Expected at least {full} targets measured from all {n} stations, or an equivalent number of readings, "
            f"for {needed} unknowns of the stations (positions and dead paths); found {equations} equations from {m} "
            f"targets, {int(np.count_nonzero(by_target == n))} of them measured from all stations and "
            f"{int(np.count_nonzero(by_target < 3))} without a position. "
            + _cause(approximate, target, "Measure more targets."),
            code="network.targets.few_common",
        )


def _cause(approximate: Array | None, target: Array, remedy: str) -> str:
    """Return why targets have no position, where the stations are known, or the remedy."""
    return remedy if approximate is None else f"{remedy} Possible cause: {_reason(approximate, target)}."


def lost_targets(known: NDArray[np.bool_], e: Array, sd: Array) -> NDArray[np.bool_]:
    """Return which targets (m,) have no position: fewer than three readings, or a weakly determined direction.

    A target with three readings nearly in one plane with its stations moves by a millimetre out of that plane while its
    distances change by a micrometre. It would affect the datum of all.

    Parameters
    ----------
    known : ndarray of bool (n, m)
        Readings.
    e : ndarray (n, m, 3)
        Unit vectors from stations to targets.
    sd : ndarray (n, m)
        Standard deviations, m.

    Raises
    ------
    FitError
        Directions or standard deviations are not finite.
    """
    with np.errstate(all="ignore"):
        E = np.where(known, 1.0 / sd, 0.0)[..., None] * e
        A = np.einsum("jta,jtb->tab", E, E)
        few = np.count_nonzero(known, axis=0) < 3
        A[few] = np.eye(3)
        if not np.isfinite(A).all():
            raise FitError(NOT_FINITE, code="network.distances.zero")
        # sum(1 / eigenvalue) = second invariant / determinant
        trace, determinant = np.trace(A, axis1=1, axis2=2), np.linalg.det(A)
        second = (trace**2 - np.einsum("tab,tab->t", A, A)) / 2
        square = np.where(determinant > SINGULAR * trace**3, second / determinant, np.inf)
        u = np.sqrt(np.where(few, np.nan, square))
    if few.all():
        return np.asarray(few)
    limit = max(WEAK_POSITION, 0.5 * np.sqrt(len(u))) * float(np.median(u[~few]))
    return np.asarray(few | ~np.isfinite(u) | (u > limit))


def condition(fit: Fit, approximate: Array) -> float:
    """Return the condition of the stations' information without rigid motions, scaled to a diagonal of 1.

    Raises
    ------
    FitError
        A freedom is undetermined; it is described, with its cause by the approximate stations (n, 3), m.
    """
    x, free = fit.unknowns, fit.problem.unknowns.target.freed[:, 0]
    stations = Stations(x.station[:, :3], x.station[:, 3])
    decomposed = _freedoms(fit.normal.S, fit.normal.F, stations, x.target, free)
    if decomposed[3].any():
        raise FitError(_described(decomposed, stations, x.target[free], approximate), code="network.undetermined")
    return float(decomposed[0][-1] / decomposed[0][0])


def undetermined(problem: Problem, approximate: Array) -> str:
    """Return what the readings of a problem leave undetermined, and why; see `condition`."""
    linear = linearised(problem, problem.start)
    [T], G, D = linear.sums()
    free = problem.unknowns.target.freed[:, 0]
    F = np.where(free[:, None, None], np.linalg.pinv(T, hermitian=True) @ G, 0.0)
    S = D + np.diag(linear.border_prior()[0]) - np.tensordot(G, F, axes=((0, 1), (0, 1)))
    target, station = linear.at.tables[:2]
    stations = Stations(station[:, :3], station[:, 3])
    decomposed = _freedoms(S, F, stations, target, free)
    if not decomposed[3].any():
        return "The distances do not determine stations and targets. Distribute them more widely."
    return _described(decomposed, stations, target[free], approximate)


def _freedoms(
    S: Array, F: Array, stations: Stations, target: Array, free: NDArray[np.bool_]
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Return the freedoms (`freedoms`) of information S (q, q), by which targets move by -F (m, 3, q).

    In the datum of a few targets an undetermined station moves alone.
    """
    if not (np.isfinite(S).all() and np.isfinite(target).all()):
        raise FitError(NOT_FINITE, code="network.distances.zero")
    some = np.flatnonzero(free)
    some = some[:: max(1, len(some) // DATUM_SAMPLE)]
    information, basis = without_motions(S, F[some], stations, target[some])
    return freedoms(information, basis, stations.position, target[some])


def _described(
    decomposed: tuple[Array, Array, Array, NDArray[np.bool_]], stations: Stations, target: Array, approximate: Array
) -> str:
    """Return the undetermined freedoms as text, with the cause."""
    values, motions, sigma, lost = decomposed
    k, centre = int(np.count_nonzero(lost)), target.mean(axis=0)
    named = "; ".join(describe(motions[:, i], stations, centre) for i in np.flatnonzero(lost)[:_DESCRIBED])
    worst = sigma[0] if values[0] > ROUNDING * values[-1] else np.inf
    return (
        f"Expected positions of stations and targets that the distances determine; found {k} "
        f"undetermined {'freedom' if k == 1 else 'freedoms'} (standard uncertainty {_length(worst)}): {named}. "
        f"Cause: {_reason(approximate, target)}."
    )


def without_motions(S: Array, F: Array, stations: Stations, target: Array) -> tuple[Array, Array]:
    """Return the information (q - 6, q - 6) within the complement of rigid motions, and its columns (q, q - 6).

    The columns are in the datum of the targets (m, 3), which move by -F (m, 3, q).
    """
    q, centre = len(S), target.mean(axis=0)
    T = np.zeros((q, 6))
    T[: 4 * len(stations.position)] = stations.motions(centre).reshape(-1, 6)
    size = np.linalg.norm(T, axis=0)
    Z = np.linalg.qr(T / np.where(size > 0, size, 1.0), mode="complete")[0][:, 6:]
    G = rigid_motions(target, centre).reshape(-1, 6)
    return Z.T @ S @ Z, Z - T @ np.linalg.lstsq(G, -F.reshape(len(G), q) @ Z)[0]


def freedoms(
    information: Array, basis: Array, position: Array, target: Array
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Return the eigenvalues of the information, scaled to a diagonal of 1, and for each its freedom.

    Freedoms are the motion by one standard uncertainty, its size (positions and dead paths), and whether it is
    undetermined.
    """
    far = MAX_SHARE * np.sqrt(np.mean((position - target.mean(axis=0)) ** 2, axis=0).sum())
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), _TINY * np.trace(information)))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    motions = basis @ (scale[:, None] * vectors / np.sqrt(np.maximum(values, _TINY * values[-1])))
    sigma = np.linalg.norm(motions[: 4 * len(position)], axis=0)
    return values, motions, sigma, (values < ROUNDING * values[-1]) | (sigma > far)


def describe(motion: Array, stations: Stations, centre: Array) -> str:
    """Return a description of a motion (4 n + k,) of the stations' parameters, largest components first."""
    n = len(stations.position)
    blocks = motion[: 4 * n].reshape(n, 4)
    line = centre - stations.position
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    along = np.einsum("ja,ja->j", blocks[:, :3], line)
    across = np.linalg.norm(blocks[:, :3] - along[:, None] * line, axis=1)
    # Along the line of sight distances depend on the sum with the dead path.
    shares = {
        ("across its line of sight", "across their lines of sight"): across**2,
        ("along its line of sight with its dead path", "along their lines of sight with their dead paths"): (
            along**2 + blocks[:, 3] ** 2
        ),
    }
    parts = []
    for (of_one, of_some), share in shares.items():
        which = np.flatnonzero(share > _SHARE * motion @ motion)
        if len(which):
            parts.append((share.sum(), f"{_stations(which)} {of_one if len(which) == 1 else of_some}"))
    parts += [
        (p**2, f"further parameter {k + 1}") for k, p in enumerate(motion[4 * n :]) if p**2 > _SHARE * motion @ motion
    ]
    return " and ".join(name for _, name in sorted(parts, reverse=True))


def _stations(which: NDArray[np.intp]) -> str:
    """Return the names of stations, numbered from 0."""
    names = [str(j + 1) for j in which]
    return f"station {names[0]}" if len(names) == 1 else f"stations {', '.join(names[:-1])} and {names[-1]}"


def _length(sigma: float) -> str:
    return "without bound" if not np.isfinite(sigma) or sigma > 1e3 else f"{sigma * 1e3:.3g} mm"


def _reason(position: Array, target: Array) -> str:
    """Return the deficiencies of the positions, each with its remedy."""
    n, reasons = len(position), []
    thin = np.linalg.svd(position - position.mean(axis=0), compute_uv=False)
    if thin[1] < FLAT * thin[0]:
        reasons.append("the stations are on one line: move two of them off it, to different sides")
    elif thin[2] < FLAT * thin[0]:
        reasons.append(
            f"the stations are in one plane (within {thin[2] / thin[0]:.1%} of their extent): move one of them off it, "
            "by about their distance"
        )
    flat = np.linalg.svd(target - target.mean(axis=0), full_matrices=False, compute_uv=False)
    if flat[1] < FLAT * flat[0]:
        reasons.append("the targets are on one line: add targets off it")
    elif flat[2] < FLAT * flat[0]:
        reasons.append("the targets are in one plane: add targets off it")
    sight = target.mean(axis=0) - position
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    for j in range(n):
        for k in range(j + 1, n):
            if np.linalg.norm(position[j] - position[k]) < SAME_DIRECTION * np.linalg.norm(
                target.mean(axis=0) - position[j]
            ):
                reasons.append(f"stations {j + 1} and {k + 1} are nearly at the same position: move one of them")
            elif np.linalg.norm(np.cross(sight[j], sight[k])) < SAME_DIRECTION:
                reasons.append(f"stations {j + 1} and {k + 1} are in one line with the targets: move one of them aside")
    if not reasons:
        reasons.append("distribute stations and targets more widely in all three directions, or measure more targets")
    return "; ".join(reasons)


def weak_layout(own: Array, shared: Sequence[Array], noise: float, approximate: Array, target: Array) -> list[str]:
    """Return a note if the layout amplifies the noise of a reading much.

    Parameters
    ----------
    own, shared : ndarray (m, 3, 3), sequence of ndarray (m, 3)
        Covariances by the readings of each target, m^2, NaN if unknown, and effects that targets have in common, m.
    noise : float
        m.
    approximate, target : ndarray (n, 3), (m, 3)
        Stations and targets, m.
    """
    trace = np.trace(own, axis1=1, axis2=2) + sum(np.sum(np.square(each), axis=1) for each in shared)
    known = np.isfinite(trace)
    factor = float(np.sqrt(np.median(trace[known]) / 3)) / noise
    if factor < WEAK:
        return []
    return [
        f"In this layout the standard uncertainty of a target in each direction is {factor:.3g} times the noise of "
        f"a reading: {_reason(approximate, target[known])}."
    ]


def swapped_stations(position: Array, approximate: Array | None) -> list[tuple[int, int]]:
    """Return pairs of stations (j, k), from 0, if another order fits much better: j is at the stated position of k.

    Positions are (n, 3), m: estimated, and stated.
    """
    if approximate is None or not np.isfinite(approximate).all():
        return []
    off = np.linalg.norm(position[:, None] - approximate[None], axis=-1)
    if (off.argmin(axis=1) == np.arange(len(off))).all():
        return []  # each is closest to its own: no other order has a smaller sum
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(off)
    if (rows == columns).all() or not off[rows, columns].sum() < 0.5 * np.diag(off).sum():
        return []
    return [(int(j), int(k)) for j, k in zip(rows, columns, strict=True) if j != k]


def swap_note(position: Array, approximate: Array | None) -> list[str]:
    """Return a note on swapped stations."""
    pairs = swapped_stations(position, approximate)
    if not pairs or approximate is None:
        return []
    order = np.arange(len(position))
    for j, k in pairs:
        order[j] = k
    own, other = (np.linalg.norm(position - each, axis=1).max() * 1e3 for each in (approximate, approximate[order]))
    changed = ", ".join(f"the readings of station {j + 1} are those of station {k + 1}" for j, k in pairs)
    return [
        f"Stations are probably swapped: {changed}. As stated, they are up to {own:.4g} mm from their approximate "
        f"positions; swapped, up to {other:.4g} mm. The targets are correct, the names of the stations are not."
    ]
