"""Approximate positions of the stations, from the nominal targets, station by station.

|u - U|^2 = (d + L)^2 is linear in U, L and K = L^2 - |U|^2:

    2 u . U + 2 d L + K = |u|^2 - d^2,

five unknowns for each station. Gauss-Newton on the distances themselves then sharpens U and L. Readings that are far
off are given little weight, so a few of them do no harm. Targets in one plane leave the side open on which a station
is; then its approximate position decides.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from errormotion.arrays import NORMAL_MAD, Array
from errormotion.errors import MethodError

MOST_READINGS = 150
"""Most readings of a station that are used for its start value."""
FLAT = 1e-3
"""Targets thinner than this share of their extent lie in a plane, or on a line."""
FITS = 0.01
"""A station whose readings fit the nominal targets worse than this share of their extent is not found."""
_ENOUGH = 1e-3
_STEPS = 30
_REWEIGHTED = 8
_DRAWS, _FEW = 60, 8


@dataclass(frozen=True)
class Start:
    """Rough places (n, 3) and dead paths (n,) of the stations, m."""

    place: Array
    dead_path: Array


def initial_stations(reading: Array, weight: Array, target: Array, station: Array | None) -> Start:
    """Return approximate stations from readings (n, m) of nominal targets (m, 3).

    Raises
    ------
    MethodError
        Readings of a station that no place explains (with what they look like: another unit, sign reversed), or
        targets in a plane without the stations' rough places.
    """
    n = len(reading)
    if station is not None and station.shape != (n, 3):
        raise MethodError(
            f"expected approximate positions ({n}, 3) of the stations, found {station.shape}; give one per row"
        )
    centre, extent, products = _shape(target, _spread(len(target), 4 * MOST_READINGS).step)
    values, axes = np.linalg.eigh(products)
    spread = np.sqrt(np.maximum(values[::-1], 0.0) / values[-1])
    if spread[1] < FLAT:
        raise MethodError(
            "expected targets spread in space, found them on one line; distances to these leave every station free "
            "to turn about that line: add targets off it"
        )
    normal = axes[:, 0] if spread[2] < FLAT else None
    places, dead_paths = np.empty((n, 3)), np.empty(n)
    if normal is None and _from_plain_readings(reading, weight, target, centre, _ENOUGH * extent, places, dead_paths):
        return Start(places, dead_paths)
    for j in range(n):
        d, u = _selected(reading[j], weight[j], target, centre, MOST_READINGS)
        rough = None if station is None or not np.isfinite(station[j]).all() else station[j] - centre
        if len(d) < 5:
            if rough is None:
                raise MethodError(
                    f"expected at least 5 readings of station {j + 1} to find it, found {len(d)}; measure more "
                    "targets from it, or state its approximate position"
                )
            places[j], dead_paths[j] = rough + centre, np.median(np.linalg.norm(u - rough, axis=1) - d)
            continue
        found, scale = _best(_guesses(d, u, rough, normal), d, u)
        if scale > FITS * extent and normal is None:
            found, scale = min((found, scale), _best(_from_few(d, u), d, u), key=lambda each: each[1])
        if scale > FITS * extent or _reversed(d, u, found, normal, scale):
            raise MethodError(_what_is_wrong(j, d, u, extent, scale))
        places[j], dead_paths[j] = found[:3] + centre, found[3]
    return Start(places, dead_paths)


def _spread(count: int, most: int) -> slice:
    """Return which of so many values to take: at most so many, evenly spread."""
    return slice(None, None, max(1, -(-count // most)))


def _shape(target: Array, every: int) -> tuple[Array, float, Array]:
    """Return mean (3,), extent, m, and products (3, 3) about the mean of every so many-th of targets (m, 3)."""
    some = target[::every]
    centre = some.mean(axis=0)
    return centre, float(np.linalg.norm(np.ptp(some, axis=0))), (some - centre).T @ (some - centre)


def _selected(reading: Array, weight: Array, target: Array, centre: Array, most: int) -> tuple[Array, Array]:
    """Return some of a station's readings (k,) and their targets (k, 3) about ``centre``, evenly spread."""
    known = np.flatnonzero(weight > 0.0)
    taken = known[:: max(1, -(-len(known) // most))]
    return reading[taken], target[taken] - centre


def _reweighted(A: Array, b: Array) -> Array:
    """Return the solution of linear equations A x = b (n, p), rows that are far off given little weight."""
    w, x = np.ones(len(b)), np.zeros(A.shape[1])
    scale = 1.0 / np.linalg.norm(A, axis=0)
    for _ in range(_REWEIGHTED):
        x = scale * np.linalg.lstsq(w[:, None] * A * scale, w * b, rcond=None)[0]
        off = np.abs(A @ x - b)
        typical = float(np.median(off))
        # Plain least squares suffices where no row is far off.
        if off.max() <= 10 * typical:
            break
        w = 1.0 / np.sqrt(1.0 + (off / (3 * typical + 1e-300)) ** 2)
    return x


def _linear(d: Array, u: Array) -> Array:
    """Return (U, L) of a station from the equations that are linear in U, L and K."""
    middle = np.median(d)
    d = d - middle
    found = _reweighted(np.column_stack([2 * u, 2 * d, np.ones(len(d))]), np.sum(u**2, axis=1) - d**2)[:4]
    found[3] -= middle
    return found


def _guesses(d: Array, u: Array, rough: Array | None, normal: Array | None) -> Iterator[Array]:
    """Yield places and dead paths (U, L) to start from, the best first."""
    yield _linear(d, u) if normal is None else _off_plane(d, u, rough, normal)
    if rough is not None:
        yield np.append(rough, np.median(np.linalg.norm(u - rough, axis=1) - d))


def _off_plane(d: Array, u: Array, rough: Array | None, normal: Array) -> Array:
    """Return (U, L) by the linear equations where targets lie in a plane through their mean."""
    middle = np.median(d)
    d = d - middle
    # In the plane of flat targets the normal part of U has no column.
    B = np.linalg.svd(normal[None])[2][1:].T
    x = _reweighted(np.column_stack([2 * u @ B, 2 * d, np.ones(len(d))]), np.sum(u**2, axis=1) - d**2)
    U, L, K = B @ x[:-2], x[-2], x[-1]
    height = np.sqrt(max(L**2 - K - U @ U, 0.0))
    if rough is None and height > FLAT * np.linalg.norm(u, axis=1).max():
        raise MethodError(
            "expected targets spread in space or the stations' approximate positions, found targets in one plane: "
            "distances do not determine on which side of it a station is; state approximate positions, or measure "
            "targets off that plane"
        )
    side = -1.0 if rough is not None and normal @ rough < 0 else 1.0
    return np.append(U + side * height * normal, L - middle)


def _from_few(d: Array, u: Array) -> list[Array]:
    """Return the best of guesses from a few readings each: some of these have no wrong one among them."""
    rng = np.random.default_rng(0)
    tried = []
    for _ in range(_DRAWS):
        some = rng.permutation(len(d))[:_FEW]
        x = _linear(d[some], u[some])
        tried.append((_scale(d - np.linalg.norm(u - x[:3], axis=1) + x[3]), x))
    return [x for _, x in sorted(tried, key=lambda each: each[0])[:3]]


def _reversed(d: Array, u: Array, found: Array, normal: Array | None, scale: float) -> bool:
    """Return whether readings fit much better with their sign reversed: far stations bear either nearly as well."""
    x = _linear(d, u) if normal is None else found
    return bool(x[3] + np.median(d) < 0 and _sharpened(np.append(x[:3], -x[3]), -d, u)[1] < 0.3 * scale)


def _best(guesses: Iterable[Array], d: Array, u: Array) -> tuple[Array, float]:
    """Return the best (U, L) from some guesses, and the robust scale of its residuals, m."""
    enough, found = _ENOUGH * _shape(u, 1)[1], []
    for guess in guesses:
        found.append(_sharpened(guess, d, u))
        if found[-1][1] < enough:
            break
    return min(found, key=lambda each: each[1])


def _residuals(x: Array, d: Array, u: Array) -> tuple[Array, Array, float]:
    """Return residuals (n,) and directions (n, 3) of readings from a station (U, L), and their robust scale, m."""
    v = u - x[:3]
    distance = np.sqrt(np.einsum("ia,ia->i", v, v))
    r = d - distance + x[3]
    return r, v / distance[:, None], _scale(r)


def _sharpened(x: Array, d: Array, u: Array) -> tuple[Array, float]:
    """Fit (U, L) to the distances from nominal targets by damped Gauss-Newton with Cauchy's weights."""
    (r, e, scale), mu = _residuals(x, d, u), 0.0
    for _ in range(_STEPS):
        w = 1.0 / (1.0 + (r / (3.0 * scale + 1e-15)) ** 2)
        J = np.column_stack([-e, np.full(len(d), -1.0)])
        A, g = J.T @ (w[:, None] * J), J.T @ (w * r)
        A[np.diag_indices(4)] *= 1.0 + mu + 1e-14
        tried = x + np.linalg.solve(A, g)
        r_tried, e_tried, size = _residuals(tried, d, u)
        if not size <= scale * (1 + 1e-3):
            if mu == 0.0 and size < 1.25 * scale:
                break
            mu = max(10 * mu, 1e-3)
            if mu > 1e8:
                break
            continue
        mu = 0.1 * mu if mu > 1e-3 else 0.0
        # A start need not be sharper than this.
        settled = mu == 0.0 and size > 0.98 * scale
        x, scale, r, e = tried, size, r_tried, e_tried
        if settled:
            break
    return x, scale


def _from_plain_readings(
    reading: Array, weight: Array, target: Array, centre: Array, enough: float, place: Array, dead_path: Array
) -> bool:
    """Fill positions (n, 3) and dead paths (n,) of stations from plain readings; return whether all were found."""
    for j in range(len(reading)):
        d, u = _selected(reading[j], weight[j], target, centre, MOST_READINGS)
        if len(d) < 5:
            return False
        x = _linear(d, u)
        # A sign reversed is looked into where the distances would be negative.
        if not x[3] + np.median(d) >= 0.0:
            return False
        x, scale = _sharpened(x, d, u)
        if not scale < enough:
            return False
        place[j], dead_path[j] = x[:3] + centre, x[3]
    return True


def _scale(r: Array) -> float:
    """Return the robust scale of residuals about zero."""
    return NORMAL_MAD * float(np.median(np.abs(r)))


def _what_is_wrong(j: int, d: Array, u: Array, extent: float, scale: float) -> str:
    """Say what readings look like that no place of a station explains."""
    span = float(np.ptp(d))
    text = (
        f"expected readings of station {j + 1} that some place of it explains, found none nearer than "
        f"{scale * 1e3:.3g} mm to the nominal targets (their extent is {extent * 1e3:.4g} mm, the readings span "
        f"{span * 1e3:.4g} mm)"
    )
    factor, reversed_sign = _factor(d, u)
    for k, name in ((1e3, "millimetres given as metres"), (1e6, "micrometres given as metres"),
                    (1e-3, "targets in millimetres given as metres"), (2.0, "the double path counted as a single one"),
                    (0.5, "half of the path counted")):  # fmt: skip
        if abs(factor / k - 1) < 0.2 and _best(_guesses(d / k, u, None, None), d / k, u)[1] < FITS * extent:
            return f"{text}; they are about {k:g} times what they should be: it looks like {name}"
    if reversed_sign or scale < FITS * extent:
        return f"{text}; they fit with their sign reversed: a displacement grows as the target moves away"
    return (
        f"{text}; check that displacements and targets are in the same order, that the station stood still, and that "
        "its count was not lost"
    )


def _factor(d: Array, u: Array) -> tuple[float, bool]:
    """Return by what readings seem to be multiplied, and whether they fall with distance.

    With a factor k on the readings |u|^2 = 2 u . U + 2 d L / k + K + d^2 / k^2: its square is linear, too.
    """
    d = d - np.median(d)
    A = np.column_stack([2 * u, 2 * d, np.ones(len(d)), d**2])
    scale = 1.0 / np.linalg.norm(A, axis=0)
    x = scale * np.linalg.lstsq(A * scale, np.sum(u**2, axis=1), rcond=None)[0]
    factor = 1.0 / np.sqrt(x[5]) if x[5] > 0 else np.nan
    return float(factor), bool(x[3] < 0)
