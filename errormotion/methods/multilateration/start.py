"""Approximate positions of the stations, from the nominal targets, station by station.

|u - U|^2 = (d + L)^2 is linear in U, L and K = L^2 - |U|^2:

    2 u . U + 2 d L + K = |u|^2 - d^2,

with five unknowns for each station. Gauss-Newton on the distances then refines U and L. Outliers have little weight.
Targets in one plane do not determine the side on which a station is; its approximate position is then required.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.robust import scale_about_zero
from errormotion.kinematics.twists import rigid_motions

MAX_READINGS = 150
"""Maximum number of readings of a station used for its start value."""
FLAT = 1e-3
"""Thickness over extent below which targets are in a plane, or on a line."""
MAX_MISFIT = 0.01
"""Misfit of a station's readings to the nominal targets, over their extent, above which they are refused."""
GROSS = 50.0
"""Contradiction of a reading to the commanded positions, over the usual one of its station, above which it is wrong."""
_GOOD_FIT = 1e-3  # over the extent, below which no further start value is tried
_MAX_STEPS = 30
_REWEIGHTINGS = 8
_DRAWS, _DRAWN = 60, 8


@dataclass(frozen=True)
class Stations:
    """Positions (n, 3) and dead paths (n,) of the stations, m."""

    position: Array
    dead_path: Array

    @property
    def table(self) -> Array:
        """Positions and dead paths, (n, 4)."""
        return np.column_stack([self.position, self.dead_path])

    def motions(self, centre: Array) -> Array:
        """Return the effect (n, 4, 6) of rigid motions of the network about ``centre`` on positions and dead paths."""
        T = np.zeros((len(self.position), 4, 6))
        T[:, :3] = rigid_motions(self.position, centre)
        return T


def readings(target: Array, stations: Stations) -> Array:
    """Return the displacements (n, m), m, of targets (m, 3) from stations."""
    return np.asarray(np.linalg.norm(target - stations.position[:, None], axis=-1) - stations.dead_path[:, None])


def directions(target: Array, position: Array) -> Array:
    """Return the unit vectors (n, m, 3) from stations at positions (n, 3) to targets (m, 3)."""
    v = target - position[:, None]
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True), dtype=float)


def initial_stations(reading: Array, weight: Array, target: Array, station: Array | None) -> Stations:
    """Return approximate stations from readings (n, m) of nominal targets (m, 3).

    Raises
    ------
    MethodError
        Readings of a station that fit no position (with the probable reason: another unit, opposite sign), or targets
        in a plane without approximate positions of the stations.
    """
    n = len(reading)
    if station is not None and station.shape != (n, 3):
        raise MethodError(
            f"Expected approximate positions ({n}, 3) of the stations, one per row; found {station.shape}.",
            code="network.stations.shape",
        )
    centre, extent, products = _shape(target, _spread(len(target), 4 * MAX_READINGS).step)
    values, axes = np.linalg.eigh(products)
    spread = np.sqrt(np.maximum(values[::-1], 0.0) / values[-1])
    if spread[1] < FLAT:
        raise MethodError(
            "Expected targets distributed in space; found them on one line, about which distances do not determine the "
            "rotation of the stations. Add targets off that line.",
            code="network.targets.on_line",
        )
    normal = axes[:, 0] if spread[2] < FLAT else None
    positions, dead_paths = np.empty((n, 3)), np.empty(n)
    if normal is None and _from_good_readings(
        reading, weight, target, centre, _GOOD_FIT * extent, positions, dead_paths
    ):
        return Stations(positions, dead_paths)
    for j in range(n):
        d, u = _selected(reading[j], weight[j], target, centre, MAX_READINGS)
        approximate = None if station is None or not np.isfinite(station[j]).all() else station[j] - centre
        if len(d) < 5:
            if approximate is None:
                raise MethodError(
                    f"Expected at least 5 readings of station {j + 1} without approximate position; found {len(d)}. "
                    "Measure more targets from it, or state its approximate position.",
                    code="network.station.readings_too_few",
                )
            positions[j], dead_paths[j] = approximate + centre, np.median(np.linalg.norm(u - approximate, axis=1) - d)
            continue
        start, scale = _best(_start_values(d, u, approximate, normal), d, u)
        if scale > MAX_MISFIT * extent and normal is None:
            start, scale = min((start, scale), _best(_from_subsets(d, u), d, u), key=lambda each: each[1])
        if scale > MAX_MISFIT * extent or _reversed(d, u, start, normal, scale):
            raise MethodError(_misfit_message(j, d, u, extent, scale), code="network.station.misfit")
        positions[j], dead_paths[j] = start[:3] + centre, start[3]
    return Stations(positions, dead_paths)


def gross(reading: Array, nominal: Array, stations: Stations, noise: float) -> NDArray[np.bool_]:
    """Return the readings (n, m) that contradict the commanded positions far more than others of their station.

    With four stations the residuals of a target are equal whichever of its readings is wrong; its commanded position,
    from which a machine is off by little, shows which. It has no rate of false alarms: valid readings never differ as
    much. Smaller outliers are found by the residuals.
    """
    off = np.empty_like(reading)
    for j in range(len(reading)):
        off[j] = np.abs(np.linalg.norm(nominal - stations.position[j], axis=1) - stations.dead_path[j] - reading[j])
    usual = np.nanmedian(off, axis=1, keepdims=True)
    return np.asarray(off > GROSS * np.maximum(usual, noise))


def _spread(count: int, most: int) -> slice:
    """Return a slice of at most ``most`` evenly distributed values out of ``count``."""
    return slice(None, None, max(1, -(-count // most)))


def _shape(target: Array, every: int) -> tuple[Array, float, Array]:
    """Return mean (3,), extent, m, and products (3, 3) about the mean of every ``every``-th of targets (m, 3)."""
    some = target[::every]
    centre = some.mean(axis=0)
    return centre, float(np.linalg.norm(np.ptp(some, axis=0))), (some - centre).T @ (some - centre)


def _selected(reading: Array, weight: Array, target: Array, centre: Array, most: int) -> tuple[Array, Array]:
    """Return evenly distributed readings (k,) of a station and their targets (k, 3) about ``centre``."""
    known = np.flatnonzero(weight > 0.0)
    taken = known[:: max(1, -(-len(known) // most))]
    return reading[taken], target[taken] - centre


def _reweighted(A: Array, b: Array) -> Array:
    """Return the robust solution of linear equations A x = b (n, p), with little weight of outliers."""
    w, x = np.ones(len(b)), np.zeros(A.shape[1])
    scale = 1.0 / np.linalg.norm(A, axis=0)
    for _ in range(_REWEIGHTINGS):
        x = scale * np.linalg.lstsq(w[:, None] * A * scale, w * b, rcond=None)[0]
        off = np.abs(A @ x - b)
        typical = float(np.median(off))
        # Unweighted least squares is sufficient without outliers.
        if off.max() <= 10 * typical:
            break
        w = 1.0 / np.sqrt(1.0 + (off / (3 * typical + 1e-300)) ** 2)
    return x


def _linear(d: Array, u: Array) -> Array:
    """Return (U, L) of a station from the equations that are linear in U, L and K."""
    middle = np.median(d)
    d = d - middle
    solution = _reweighted(np.column_stack([2 * u, 2 * d, np.ones(len(d))]), np.sum(u**2, axis=1) - d**2)[:4]
    solution[3] -= middle
    return solution


def _start_values(d: Array, u: Array, approximate: Array | None, normal: Array | None) -> Iterator[Array]:
    """Yield start values of position and dead path (U, L), the best first."""
    yield _linear(d, u) if normal is None else _off_plane(d, u, approximate, normal)
    if approximate is not None:
        yield np.append(approximate, np.median(np.linalg.norm(u - approximate, axis=1) - d))


def _off_plane(d: Array, u: Array, approximate: Array | None, normal: Array) -> Array:
    """Return (U, L) from the linear equations for targets in a plane through their mean."""
    middle = np.median(d)
    d = d - middle
    # With targets in a plane the normal component of U has no column.
    B = np.linalg.svd(normal[None])[2][1:].T
    x = _reweighted(np.column_stack([2 * u @ B, 2 * d, np.ones(len(d))]), np.sum(u**2, axis=1) - d**2)
    U, L, K = B @ x[:-2], x[-2], x[-1]
    height = np.sqrt(max(L**2 - K - U @ U, 0.0))
    if approximate is None and height > FLAT * np.linalg.norm(u, axis=1).max():
        raise MethodError(
            "Expected targets distributed in space, or approximate positions of the stations; found targets in one "
            "plane, where distances do not determine on which side a station is. State approximate positions, or "
            "measure targets off that plane.",
            code="network.targets.in_plane",
        )
    side = -1.0 if approximate is not None and normal @ approximate < 0 else 1.0
    return np.append(U + side * height * normal, L - middle)


def _from_subsets(d: Array, u: Array) -> list[Array]:
    """Return the best start values from random subsets of the readings, some of which are without outliers."""
    rng = np.random.default_rng(0)
    tried = []
    for _ in range(_DRAWS):
        some = rng.permutation(len(d))[:_DRAWN]
        x = _linear(d[some], u[some])
        tried.append((scale_about_zero(d - np.linalg.norm(u - x[:3], axis=1) + x[3]), x))
    return [x for _, x in sorted(tried, key=lambda each: each[0])[:3]]


def _reversed(d: Array, u: Array, position: Array, normal: Array | None, scale: float) -> bool:
    """Return whether readings fit much better with the opposite sign; with far stations both fit nearly as well."""
    x = _linear(d, u) if normal is None else position
    return bool(x[3] + np.median(d) < 0 and _refined(np.append(x[:3], -x[3]), -d, u)[1] < 0.3 * scale)


def _best(start_values: Iterable[Array], d: Array, u: Array) -> tuple[Array, float]:
    """Return the best (U, L) from some start values, and the robust scale of its residuals, m."""
    good, solutions = _GOOD_FIT * _shape(u, 1)[1], []
    for x in start_values:
        solutions.append(_refined(x, d, u))
        if solutions[-1][1] < good:
            break
    return min(solutions, key=lambda each: each[1])


def _residuals(x: Array, d: Array, u: Array) -> tuple[Array, Array, float]:
    """Return residuals (n,) and directions (n, 3) of readings from a station (U, L), and their robust scale, m."""
    v = u - x[:3]
    distance = np.sqrt(np.einsum("ia,ia->i", v, v))
    r = d - distance + x[3]
    return r, v / distance[:, None], scale_about_zero(r)


def _refined(x: Array, d: Array, u: Array) -> tuple[Array, float]:
    """Return (U, L) fitted to the distances from nominal targets by damped Gauss-Newton with Cauchy weights."""
    (r, e, scale), mu = _residuals(x, d, u), 0.0
    for _ in range(_MAX_STEPS):
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
        # Sufficient for a start value.
        converged = mu == 0.0 and size > 0.98 * scale
        x, scale, r, e = tried, size, r_tried, e_tried
        if converged:
            break
    return x, scale


def _from_good_readings(
    reading: Array, weight: Array, target: Array, centre: Array, max_scale: float, position: Array, dead_path: Array
) -> bool:
    """Fill positions (n, 3) and dead paths (n,) of stations; return False if the readings of one do not fit."""
    for j in range(len(reading)):
        d, u = _selected(reading[j], weight[j], target, centre, MAX_READINGS)
        if len(d) < 5:
            return False
        x, scale = _of_good_readings(d.tobytes(), u.tobytes())
        if not scale < max_scale:
            return False
        position[j], dead_path[j] = x[:3] + centre, x[3]
    return True


@lru_cache(maxsize=32)
def _of_good_readings(reading: bytes, target: bytes) -> tuple[Array, float]:
    """Return (U, L) and robust scale, m, from the bytes of readings (k,) and targets (k, 3), if the sign is correct.

    A search of a station that moved starts with the same readings of all other stations.
    """
    d, u = np.frombuffer(reading), np.frombuffer(target).reshape(-1, 3)
    x = _linear(d, u)
    # Negative distances: the sign may be reversed.
    return _refined(x, d, u) if x[3] + np.median(d) >= 0.0 else (x, np.inf)


def _misfit_message(j: int, d: Array, u: Array, extent: float, scale: float) -> str:
    """Return the error message for readings that fit no position of a station, with the probable reason."""
    span = float(np.ptp(d))
    text = (
        f"Expected readings of station {j + 1} that agree with the distances from one position; the best one differs "
        f"by {scale * 1e3:.3g} mm (extent of the targets {extent * 1e3:.4g} mm, range of the readings "
        f"{span * 1e3:.4g} mm)"
    )
    factor, reversed_sign = _factor(d, u)
    for k, name in ((1e3, "readings in mm, stated as m"), (1e6, "readings in um, stated as m"),
                    (1e-3, "targets in mm, stated as m"), (2.0, "the optical path, twice the displacement"),
                    (0.5, "half of the displacement")):  # fmt: skip
        if abs(factor / k - 1) < 0.2 and _best(_start_values(d / k, u, None, None), d / k, u)[1] < MAX_MISFIT * extent:
            return f"{text}. They are about {k:g} times as large as expected; probable cause: {name}."
    if reversed_sign or scale < MAX_MISFIT * extent:
        return f"{text}. They fit with the opposite sign: a displacement increases with the distance."
    return (
        f"{text}. Check that displacements and targets have the same order, that the station did not move, and that "
        "the beam was not interrupted without a new zero."
    )


def _factor(d: Array, u: Array) -> tuple[float, bool]:
    """Return the estimated factor of the readings, and whether they decrease with the distance.

    With a factor k of the readings, |u|^2 = 2 u . U + 2 d L / k + K + d^2 / k^2 is linear in 1 / k^2, too.
    """
    d = d - np.median(d)
    A = np.column_stack([2 * u, 2 * d, np.ones(len(d)), d**2])
    scale = 1.0 / np.linalg.norm(A, axis=0)
    x = scale * np.linalg.lstsq(A * scale, np.sum(u**2, axis=1), rcond=None)[0]
    factor = 1.0 / np.sqrt(x[5]) if x[5] > 0 else np.nan
    return float(factor), bool(x[3] < 0)
