"""What distances determine, and which freedom is loose where they do not.

A target with k readings gives k - 3 equations for the stations, which have 4 n - 6 unknowns: positions and dead
paths without the six motions of the whole. Four stations need ten targets. Where stations or targets stand badly, these
equations depend on one another: with stations in one plane two freedoms are loose whatever the targets, and a target in
one line with two stations, or in one plane with all, has a direction in which no distance changes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.multilateration.network.model import Stations

LOOSE = 0.05
"""A freedom with a standard uncertainty above this share of the distances is loose: nothing is linear any more."""
DIGITS = 1e-13
"""An eigenvalue below this share of the largest is rounding."""
FLAT = 0.03
"""Stations thinner than this share of their extent count as standing in a plane, or on a line."""
WEAK = 20.0
"""Noise multiplied by more than this in a target is noted."""
_NOTHING = 1e-30
NEAR = 0.05
"""Stations seen from the targets within this angle, rad, are in one line with them."""
_NAMED = 3
_LISTED = 12
_SHARE = 0.1


def refuse_too_few(by_target: NDArray[np.int64], by_station: NDArray[np.int64], unknown: int) -> None:
    """Raise MethodError where readings are fewer than unknowns.

    Parameters
    ----------
    by_target, by_station : ndarray (m,), (n,)
        Readings of each target and from each station.
    unknown : int
        Parameters of the stations of which nothing is known beforehand.
    """
    n, m = len(by_station), len(by_target)
    if n < 4:
        raise MethodError(
            f"expected at least four stations, found {n}: with three every target has as many unknowns as distances, "
            "and the stations are not determined; measure the targets from a further station"
        )
    blind = np.flatnonzero(by_station < 4)
    if len(blind):
        raise MethodError(
            f"expected at least 4 readings of every station, found "
            f"{', '.join(f'{by_station[j]} of station {j + 1}' for j in blind)}; measure more targets "
            "from it, or leave the station out"
        )
    count = by_target
    equations, needed = int(np.maximum(count - 3, 0).sum()), unknown - 6
    if equations < needed:
        full = -(-needed // (n - 3))
        raise MethodError(
            f"expected at least {full} targets seen by all {n} stations, or as many readings spread otherwise, for "
            f"{needed} unknowns of the stations (positions and dead paths); found {equations} equations in {m} "
            f"targets, of which {int(np.count_nonzero(count == n))} are seen by all and "
            f"{int(np.count_nonzero(count < 3))} by fewer than three; measure more targets"
        )


def refuse_nowhere(*sums: Array) -> None:
    """Raise MethodError where sums over the targets are no numbers."""
    if not all(np.isfinite(each).all() for each in sums):
        raise MethodError(
            "expected every target away from every station, and noise and distances in metres, found a distance that "
            "is zero or a weight that is not finite; check positions and noise"
        )


def refuse_loose(information: Array, basis: Array, stations: Stations, target: Array, rough: Array) -> Array:
    """Raise MethodError where a freedom is loose; else return eigenvalues of the information, its diagonal made 1.

    Parameters
    ----------
    information : ndarray (p, p)
        1/m^2, within the columns of ``basis``.
    basis : ndarray (4 n + k, p)
        In the datum of the targets: a station that is loose alone then moves alone.
    stations : Stations
        Where they were found.
    target : ndarray (m, 3)
        Where the targets were found, m.
    rough : ndarray (n, 3)
        Rough places of the stations, m: where they were found is no guide when a freedom is loose.
    """
    refuse_nowhere(information)
    values, motions, sigma, loose = freedoms(information, basis, stations.place, target)
    if not loose.any():
        return values
    centre = target.mean(axis=0)
    k = int(np.count_nonzero(loose))
    named = "; ".join(describe(motions[:, i], stations, centre) for i in np.flatnonzero(loose)[:_NAMED])
    worst = sigma[0] if values[0] > DIGITS * values[-1] else np.inf
    raise MethodError(
        f"expected positions of stations and targets that the distances determine, found {k} "
        f"undetermined {'freedom' if k == 1 else 'freedoms'} (standard uncertainty {_length(worst)}): {named}. "
        f"Cause: {_reason(rough, target)}"
    )


def freedoms(
    information: Array, basis: Array, place: Array, target: Array
) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Return eigenvalues of the information with its diagonal made 1, and for each the motion by one deviation.

    Also the size of the motion (positions and dead paths), and whether it is loose.
    """
    far = LOOSE * np.sqrt(np.mean((place - target.mean(axis=0)) ** 2, axis=0).sum())
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), _NOTHING * np.trace(information)))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    motions = basis @ (scale[:, None] * vectors / np.sqrt(np.maximum(values, _NOTHING * values[-1])))
    sigma = np.linalg.norm(motions[: 4 * len(place)], axis=0)
    return values, motions, sigma, (values < DIGITS * values[-1]) | (sigma > far)


def describe(motion: Array, stations: Stations, centre: Array) -> str:
    """Say in words what a motion (4 n + k,) of the stations' parameters is, largest parts first."""
    n = len(stations.place)
    blocks = motion[: 4 * n].reshape(n, 4)
    line = centre - stations.place
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    along = np.einsum("ja,ja->j", blocks[:, :3], line)
    across = np.linalg.norm(blocks[:, :3] - along[:, None] * line, axis=1)
    # Along the line of sight it is the sum with the dead path that distances see.
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
    """Return stations, counted from 0, by name."""
    names = [str(j + 1) for j in which]
    return f"station {names[0]}" if len(names) == 1 else f"stations {', '.join(names[:-1])} and {names[-1]}"


def _length(sigma: float) -> str:
    return "without bound" if not np.isfinite(sigma) or sigma > 1e3 else f"{sigma * 1e3:.3g} mm"


def _reason(place: Array, target: Array) -> str:
    """Say what is special about the places, and what to do."""
    n, found = len(place), []
    thin = np.linalg.svd(place - place.mean(axis=0), compute_uv=False)
    if thin[1] < FLAT * thin[0]:
        found.append("the stations stand on one line: move two of them off it, to different sides")
    elif thin[2] < FLAT * thin[0]:
        found.append(
            f"the stations stand in one plane (to {thin[2] / thin[0]:.1%} of their extent): move one of them off it, "
            "by about their distance"
        )
    flat = np.linalg.svd(target - target.mean(axis=0), full_matrices=False, compute_uv=False)
    if flat[1] < FLAT * flat[0]:
        found.append("the targets lie on one line: add targets off it")
    elif flat[2] < FLAT * flat[0]:
        found.append("the targets lie in one plane: add targets off it")
    sight = target.mean(axis=0) - place
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    for j in range(n):
        for k in range(j + 1, n):
            if np.linalg.norm(place[j] - place[k]) < NEAR * np.linalg.norm(target.mean(axis=0) - place[j]):
                found.append(f"stations {j + 1} and {k + 1} stand nearly at one place: move one of them away")
            elif np.linalg.norm(np.cross(sight[j], sight[k])) < NEAR:
                found.append(f"stations {j + 1} and {k + 1} stand in one line with the targets: move one of them aside")
    if not found:
        found.append("spread stations and targets wider and in all three directions, or measure more targets")
    return "; ".join(found)


def refuse_flat(determined: int, rough: Array, target: Array) -> None:
    """Raise MethodError where fewer than three targets have a place of their own: nothing carries the datum."""
    if determined < 3:
        raise MethodError(
            f"expected stations that see the targets from all sides, found {determined} of {len(target)} targets whose "
            f"distances determine a place: all others lie in one plane with the stations that see them. What is "
            f"special: {_reason(rough, target)}"
        )


def weak_layout(covariance: Array, weight: Array, place: Array, target: Array) -> list[str]:
    """Return a note where the layout makes much of the noise: covariances (m, 3, 3) against weights (n, m)."""
    trace = np.trace(covariance, axis1=1, axis2=2)
    known = np.isfinite(trace)
    factor = float(np.sqrt(np.median(trace[known]) / 3) * np.median(weight[weight > 0]))
    if factor < WEAK:
        return []
    what = f"this layout makes {factor:.3g} times the noise of a reading of it in each direction of a target"
    return [f"{what}: {_reason(place, target[known])}"]


def without_say(carries: NDArray[np.bool_], target: Array) -> list[str]:
    """Return a note on the targets (m, 3) that have a place and do not carry the datum."""
    weak = np.flatnonzero(~carries & np.isfinite(target[:, 0]))
    if not len(weak):
        return []
    more = f" and {len(weak) - _LISTED} more" if len(weak) > _LISTED else ""
    return [
        f"targets that are hardly determined by their readings do not carry the datum ({len(weak)} of them): "
        f"{', '.join(str(i + 1) for i in weak[:_LISTED])}{more}"
    ]


def without_place(weight: Array, named: tuple[int, ...]) -> list[str]:
    """Return a note on the targets that have too few readings, by weight (n, m), except those ``named`` already."""
    few = np.setdiff1d(np.flatnonzero(np.count_nonzero(weight, axis=0) < 3), named)
    if not len(few):
        return []
    more = f" and {len(few) - _LISTED} more" if len(few) > _LISTED else ""
    return [
        f"targets with fewer than three readings in use have no place ({len(few)} of them): "
        f"{', '.join(str(i + 1) for i in few[:_LISTED])}{more}"
    ]


def weak_targets(target: Array, covariance: Array, place: Array) -> list[str]:
    """Return notes on targets (m, 3) whose distances leave a direction nearly open, by their covariances (m, 3, 3)."""
    trace = np.trace(covariance, axis1=1, axis2=2)
    known = np.isfinite(trace)
    if not known.any():
        return []
    weak = np.flatnonzero(known & (trace > WEAK**2 * np.median(trace[known])))
    notes = []
    for i in weak[:_NAMED]:
        values, vectors = np.linalg.eigh(covariance[i])
        direction = ", ".join(f"{c:+.2f}" for c in vectors[:, -1])
        notes.append(
            f"target {i + 1} is hardly determined along ({direction}), standard uncertainty "
            f"{np.sqrt(values[-1]) * 1e3:.3g} mm: {_of_target(target[i], place)}"
        )
    if len(weak) > _NAMED:
        notes.append(f"{len(weak) - _NAMED} further targets are hardly determined in a direction, for like reasons")
    return notes


def _of_target(target: Array, place: Array) -> str:
    sight = target - place
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    for j in range(len(place)):
        for k in range(j + 1, len(place)):
            if np.linalg.norm(np.cross(sight[j], sight[k])) < NEAR:
                return f"it lies in one line with stations {j + 1} and {k + 1}"
    return "it lies nearly in one plane with the stations that see it"


def swapped_stations(found: Array, rough: Array | None) -> list[tuple[int, int]]:
    """Return stations (j, k), from 0, of which j was found where k is stated, where another order fits much better.

    Positions are (n, 3), m: as found, and as stated.
    """
    if rough is None or not np.isfinite(rough).all():
        return []
    off = np.linalg.norm(found[:, None] - rough[None], axis=-1)
    if (off.argmin(axis=1) == np.arange(len(off))).all():
        return []  # each is nearest to its own: no other order has a smaller sum
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(off)
    if (rows == columns).all() or not off[rows, columns].sum() < 0.5 * np.diag(off).sum():
        return []
    return [(int(j), int(k)) for j, k in zip(rows, columns, strict=True) if j != k]


def swap_note(found: Array, rough: Array | None) -> list[str]:
    """Return a note on swapped stations."""
    pairs = swapped_stations(found, rough)
    if not pairs or rough is None:
        return []
    order = np.arange(len(found))
    for j, k in pairs:
        order[j] = k
    own, other = (np.linalg.norm(found - each, axis=1).max() * 1e3 for each in (rough, rough[order]))
    changed = ", ".join(f"the readings of station {j + 1} are those of station {k + 1}" for j, k in pairs)
    return [
        f"stations are probably swapped: {changed} (as stated, they are {own:.4g} mm off their approximate positions, "
        f"swapped {other:.4g} mm); the targets are right, the names of the stations are not"
    ]
