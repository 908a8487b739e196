"""Freedoms that distances do not determine.

A target with k readings contributes k - 3 equations for the stations, which have 4 n - 6 unknowns: positions and dead
paths without the six rigid motions. Four stations require ten targets. With an unsuitable layout these equations are
dependent: with stations in one plane two freedoms are undetermined with any targets, and a target in one line with two
stations, or in one plane with all, has a direction in which no distance changes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.twists import rigid_motions
from errormotion.methods.multilateration.network.model import Stations

MAX_SHARE = 0.05
"""Standard uncertainty over the distances above which a freedom is undetermined: the model is not linear over it."""
ROUNDING = 1e-13
"""An eigenvalue below this fraction of the largest is a rounding error."""
FLAT = 0.03
"""Thickness over extent below which stations or targets are in a plane, or on a line."""
WEAK = 20.0
"""Ratio of the uncertainty of a target to the noise from which a note is made."""
_TINY = 1e-30
SAME_DIRECTION = 0.05
"""Angle between the lines of sight of two stations, rad, below which these are in one line with the targets."""
_DESCRIBED = 3
_LISTED = 12
_SHARE = 0.1


def refuse_too_few(reading: Array) -> None:
    """Raise MethodError if there are fewer readings (n, m) than unknowns of the stations."""
    known = np.isfinite(reading)
    by_target = known.sum(axis=0)
    by_station = (known & (by_target >= 3)).sum(axis=1)
    n, m = len(by_station), len(by_target)
    if n < 4:
        raise MethodError(
            f"Expected at least four stations; found {n}. With three every target has as many unknowns as distances, "
            "so that the stations are not determined. Measure the targets from a further station."
        )
    blind = np.flatnonzero(by_station < 4)
    if len(blind):
        raise MethodError(
            f"Expected at least 4 readings of every station; found "
            f"{', '.join(f'{by_station[j]} of station {j + 1}' for j in blind)}. Measure more targets "
            "from it, or remove the station."
        )
    count = by_target
    equations, needed = int(np.maximum(count - 3, 0).sum()), 4 * n - 6
    if equations < needed:
        full = -(-needed // (n - 3))
        raise MethodError(
            f"Expected at least {full} targets measured from all {n} stations, or an equivalent number of readings, "
            f"for {needed} unknowns of the stations (positions and dead paths); found {equations} equations from {m} "
            f"targets, {int(np.count_nonzero(count == n))} of them measured from all stations and "
            f"{int(np.count_nonzero(count < 3))} from fewer than three. Measure more targets."
        )


def refuse_not_finite(*values: Array) -> None:
    """Raise MethodError if values by distances and noise are not finite."""
    if not all(np.isfinite(each).all() for each in values):
        raise MethodError(
            "Expected distances between stations and targets, and a noise, that are not zero; found one of zero, or "
            "not finite. Check positions and noise, and that both are in metres."
        )


def refuse_undetermined(
    S: Array, F: Array, stations: Stations, target: Array, in_datum: NDArray[np.bool_], approximate: Array, most: int
) -> Array:
    """Return the eigenvalues of the stations' information without rigid motions, scaled to a diagonal of 1.

    Parameters
    ----------
    S : ndarray (q, q)
        Information of the stations' parameters and of further ones, 1/m^2.
    F : ndarray (m, 3, q)
        Negative motion of the targets by these parameters, m.
    stations : Stations
        As estimated.
    target : ndarray (m, 3)
        As estimated, m.
    in_datum : ndarray of bool (m,)
        Targets that define the datum. In the datum of ``most`` of these an undetermined station moves alone.
    approximate : ndarray (n, 3)
        Approximate positions of the stations, m: the estimated ones are wrong if a freedom is undetermined.

    Raises
    ------
    MethodError
        A freedom is undetermined.
    """
    refuse_not_finite(S, target)
    some = np.flatnonzero(in_datum)
    some = some[:: max(1, len(some) // most)]
    information, basis = without_motions(S, F[some], stations, target[some])
    values, motions, sigma, undetermined = freedoms(information, basis, stations.position, target[some])
    if not undetermined.any():
        return values
    centre = target[some].mean(axis=0)
    k = int(np.count_nonzero(undetermined))
    named = "; ".join(describe(motions[:, i], stations, centre) for i in np.flatnonzero(undetermined)[:_DESCRIBED])
    worst = sigma[0] if values[0] > ROUNDING * values[-1] else np.inf
    raise MethodError(
        f"Expected positions of stations and targets that the distances determine; found {k} "
        f"undetermined {'freedom' if k == 1 else 'freedoms'} (standard uncertainty {_length(worst)}): {named}. "
        f"Cause: {_reason(approximate, target[some])}."
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
    n, found = len(position), []
    thin = np.linalg.svd(position - position.mean(axis=0), compute_uv=False)
    if thin[1] < FLAT * thin[0]:
        found.append("the stations are on one line: move two of them off it, to different sides")
    elif thin[2] < FLAT * thin[0]:
        found.append(
            f"the stations are in one plane (within {thin[2] / thin[0]:.1%} of their extent): move one of them off it, "
            "by about their distance"
        )
    flat = np.linalg.svd(target - target.mean(axis=0), full_matrices=False, compute_uv=False)
    if flat[1] < FLAT * flat[0]:
        found.append("the targets are on one line: add targets off it")
    elif flat[2] < FLAT * flat[0]:
        found.append("the targets are in one plane: add targets off it")
    sight = target.mean(axis=0) - position
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    for j in range(n):
        for k in range(j + 1, n):
            if np.linalg.norm(position[j] - position[k]) < SAME_DIRECTION * np.linalg.norm(
                target.mean(axis=0) - position[j]
            ):
                found.append(f"stations {j + 1} and {k + 1} are nearly at the same position: move one of them")
            elif np.linalg.norm(np.cross(sight[j], sight[k])) < SAME_DIRECTION:
                found.append(f"stations {j + 1} and {k + 1} are in one line with the targets: move one of them aside")
    if not found:
        found.append("distribute stations and targets more widely in all three directions, or measure more targets")
    return "; ".join(found)


def refuse_flat(determined: int, approximate: Array, target: Array) -> None:
    """Raise MethodError if fewer than three targets have a position: the datum is not determined."""
    if determined < 3:
        raise MethodError(
            f"Expected stations on all sides of the targets; found {determined} of {len(target)} targets with a "
            "position determined by the distances: each of the others is in one plane with its stations. "
            f"Cause: {_reason(approximate, target)}."
        )


def weak_layout(covariance: Array, weight: Array, position: Array, target: Array) -> list[str]:
    """Return a note if the layout amplifies the noise much, by covariances (m, 3, 3) and weights (n, m)."""
    trace = np.trace(covariance, axis1=1, axis2=2)
    known = np.isfinite(trace)
    factor = float(np.sqrt(np.median(trace[known]) / 3) * np.median(weight[weight > 0]))
    if factor < WEAK:
        return []
    return [
        f"In this layout the standard uncertainty of a target in each direction is {factor:.3g} times the noise of a "
        f"reading: {_reason(position, target[known])}."
    ]


def outside_datum(in_datum: NDArray[np.bool_], target: Array) -> list[str]:
    """Return a note on the targets (m, 3) that have a position but do not define the datum."""
    weak = np.flatnonzero(~in_datum & np.isfinite(target[:, 0]))
    if not len(weak):
        return []
    return [f"Weakly determined targets, not used for the datum ({len(weak)}): {_listed(weak)}."]


def without_position(weight: Array, named: tuple[int, ...]) -> list[str]:
    """Return a note on the targets with too few readings, by weight (n, m), except those already ``named``."""
    few = np.setdiff1d(np.flatnonzero(np.count_nonzero(weight, axis=0) < 3), named)
    if not len(few):
        return []
    return [
        "Targets with fewer than three valid readings, or in one plane with their stations, without a position "
        f"({len(few)}): {_listed(few)}."
    ]


def _listed(targets: NDArray[np.intp]) -> str:
    """Return the numbers of the first targets, and how many more there are."""
    more = f" and {len(targets) - _LISTED} more" if len(targets) > _LISTED else ""
    return f"{', '.join(str(i + 1) for i in targets[:_LISTED])}{more}"


def weak_targets(target: Array, covariance: Array, position: Array) -> list[str]:
    """Return notes on targets (m, 3) with a weakly determined direction, by their covariances (m, 3, 3)."""
    trace = np.trace(covariance, axis1=1, axis2=2)
    known = np.isfinite(trace)
    if not known.any():
        return []
    weak = np.flatnonzero(known & (trace > WEAK**2 * np.median(trace[known])))
    notes = []
    for i in weak[:_DESCRIBED]:
        values, vectors = np.linalg.eigh(covariance[i])
        direction = ", ".join(f"{c:+.2f}" for c in vectors[:, -1])
        notes.append(
            f"Target {i + 1} is weakly determined along ({direction}), with a standard uncertainty of "
            f"{np.sqrt(values[-1]) * 1e3:.3g} mm: {_of_target(target[i], position)}."
        )
    if len(weak) > _DESCRIBED:
        notes.append(f"Further targets with a weakly determined direction: {len(weak) - _DESCRIBED}.")
    return notes


def _of_target(target: Array, position: Array) -> str:
    sight = target - position
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    for j in range(len(position)):
        for k in range(j + 1, len(position)):
            if np.linalg.norm(np.cross(sight[j], sight[k])) < SAME_DIRECTION:
                return f"it is in one line with stations {j + 1} and {k + 1}"
    return "it is nearly in one plane with its stations"


def swapped_stations(found: Array, approximate: Array | None) -> list[tuple[int, int]]:
    """Return pairs of stations (j, k), from 0, if another order fits much better: j is at the stated position of k.

    Positions are (n, 3), m: estimated, and stated.
    """
    if approximate is None or not np.isfinite(approximate).all():
        return []
    off = np.linalg.norm(found[:, None] - approximate[None], axis=-1)
    if (off.argmin(axis=1) == np.arange(len(off))).all():
        return []  # each is closest to its own: no other order has a smaller sum
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(off)
    if (rows == columns).all() or not off[rows, columns].sum() < 0.5 * np.diag(off).sum():
        return []
    return [(int(j), int(k)) for j, k in zip(rows, columns, strict=True) if j != k]


def swap_note(found: Array, approximate: Array | None) -> list[str]:
    """Return a note on swapped stations."""
    pairs = swapped_stations(found, approximate)
    if not pairs or approximate is None:
        return []
    order = np.arange(len(found))
    for j, k in pairs:
        order[j] = k
    own, other = (np.linalg.norm(found - each, axis=1).max() * 1e3 for each in (approximate, approximate[order]))
    changed = ", ".join(f"the readings of station {j + 1} are those of station {k + 1}" for j, k in pairs)
    return [
        f"Stations are probably swapped: {changed}. As stated, they are up to {own:.4g} mm from their approximate "
        f"positions; swapped, up to {other:.4g} mm. The targets are correct, the names of the stations are not."
    ]
