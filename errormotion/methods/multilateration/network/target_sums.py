"""Sums over the targets of a network, by array operations.

With E (n, 3) the weighted directions from the stations to a target, N orthonormal rows with N E = 0, and Q the weighted
derivatives of the readings by the parameters of the stations, a target contributes the n - 3 equations N Q ds = N r.
N is calculated by Householder reflections, without cancellation. The targets are the last dimension of the arrays.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.kinematics.twists import rigid_motions

FLAT = 1e-13
"""Determinant of the directions' products over the cube of their trace below which a target is not moved."""
NO_POSITION = 1e-12
"""Pivot of the directions' products over their trace below which a target has no position."""
_STEPS, _SHORT = 8, 1e-3
"""Further steps of a target in one pass, and the length, m, below which a step is the last."""
_LAST_STEPS, _SETTLED = 30, 1e-7
"""The same where the stations are final."""
_SILENT = np.errstate(invalid="ignore", divide="ignore", over="ignore")
"""The result is NaN for a target without a position."""


def weigh(d: Array, sigma: Array) -> tuple[Array, Array, bool]:
    """Return readings, weights (n, m), and whether the standard deviations ((n, 1) or (n, m)) are positive.

    A target with fewer than three readings has weights of 0.
    """
    known = np.isfinite(d)
    sigma = np.broadcast_to(sigma, d.shape)
    weight = np.divide(1.0, sigma, out=np.zeros(d.shape), where=known & (sigma > 0))
    positive = bool((sigma[known] > 0).all())
    weight[:, known.sum(axis=0) < 3] = 0.0
    return np.where(known, d, np.nan), weight, positive


def count(weight: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return how many weights (n, m) are not 0, by column and by row."""
    used = weight > 0.0
    return used.sum(axis=0), used.sum(axis=1)


def copied(u: Array) -> tuple[Array, Array]:
    """Return a copy of positions (m, 3), and their mean (3,)."""
    return u.copy(), u.sum(axis=0) / max(len(u), 1)


def moments(position: Array, nominal: Array, used: NDArray[np.bool_], centre: Array) -> Array:
    """Return number, sums and products (16,) of used targets (3, m) and nominal ones (m, 3), about ``centre``."""
    u, v = position[:, used] - centre[:, None], nominal[used].T - centre[:, None]
    return np.concatenate([[np.count_nonzero(used)], u.sum(axis=1), v.sum(axis=1), (v @ u.T).ravel()])


def moved(position: Array, a: Array, b: Array, R: Array, traces: Array) -> Array:
    """Return R (u - a) + b (m, 3) of targets u (3, m); NaN where the traces (m,) is infinite."""
    target = (position.T - a) @ R.T + b
    target[~(traces < np.inf)] = np.nan
    return np.asarray(target)


@_SILENT
def residuals(reading: Array, station: Array, dead_path: Array, extra: Array, value: Array, target: Array) -> Array:
    """Return readings (n, m) minus the model at stations and targets (m, 3), m."""
    return _reach(reading, dead_path, extra, value) - _sight(target.T, station)[1]


@_SILENT
def reduce_targets(
    reading: Array, weight: Array, station: Array, dead_path: Array, extra: Array, value: Array,
    position: Array,
) -> tuple[Array, float]:  # fmt: skip
    """Move every target and sum its equations for the stations.

    Parameters
    ----------
    reading, weight : ndarray (n, m)
        Displacements, m, and 1 / standard deviation, 1/m; 0 for readings that are not used, whatever their value.
    station, dead_path : ndarray (n, 3), (n,)
        m.
    extra, value : ndarray (k, n, m), (k,)
        Effect of a unit of each further parameter on a reading, and the parameters.
    position : ndarray (3, m)
        Targets, m; changed in place.

    Returns
    -------
    sums : ndarray (4 n + k + 1, 4 n + k + 1)
        V V^T; the columns of V are the equations of the targets, derivatives of the readings by (U, L) of every
        station and by the further parameters, and last the residual.
    moved : float
        Longest first step of a target, m.
    """
    reach = np.where(weight > 0, _reach(reading, dead_path, extra, value), 0.0)
    far, _ = _locate(reach, weight, station, position, _STEPS, _SHORT)
    e, distance = _sight(position, station)
    N = orthogonal_rows(weight[:, None] * e)
    c = N * weight
    rows = [equations(c, e)]
    if len(extra):
        rows.append(np.einsum("ajm,kjm->kam", c, extra).reshape(len(extra), -1))
    rows.append(np.einsum("ajm,jm->am", N, weight * (reach - distance)).reshape(1, -1))
    V = np.concatenate(rows)
    return V @ V.T, far


@_SILENT
def settle_targets(
    reading: Array, weight: Array, station: Array, dead_path: Array, extra: Array, value: Array,
    position: Array, nominal: Array, centre: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Move every target (3, m) to the best fit of its distances from the final stations.

    Returns
    -------
    traces : ndarray (m,)
        Trace of each target's covariance with known stations, m^2; infinite if a direction is not determined.
    moments : ndarray (16,)
        Of the targets with a position: their number, sums of targets and of nominal ones (m, 3) about ``centre`` (3,),
        and the sum (3, 3) of nominal times target.
    """
    reach = np.where(weight > 0, _reach(reading, dead_path, extra, value), 0.0)
    _, traces = _locate(reach, weight, station, position, _LAST_STEPS, _SETTLED)
    return traces, moments(position, nominal, traces < np.inf, centre)


@_SILENT
def datum_sums(
    weight: Array, station: Array, extra: Array, target: Array, in_datum: NDArray[np.bool_], centre: Array
) -> tuple[Array, Array, Array]:
    """Return sums over the targets that define the datum: G^T G (6, 6), G^T D G (6, 6) and G^T F (6, 4 n + k).

    G is the displacement of a target by rigid motions about ``centre``, D its covariance with known stations, F its
    displacement by the stations' parameters.
    """
    weight, extra, target = weight[:, in_datum], extra[:, :, in_datum], target[in_datum]
    e, D, whole = seen(weight, station, target)
    weight, extra, target, e, D = weight[:, whole], extra[:, :, whole], target[whole], e[:, :, whole], D[:, :, whole]
    G = rigid_motions(target, centre)
    own = weight[:, None] ** 2 * np.einsum("abm,jbm->jam", D, e)
    F = response(own, e)
    if len(extra):
        F = np.concatenate([F, -np.einsum("jam,kjm->mak", own, extra)], axis=2)
    flat = G.reshape(-1, 6)
    return flat.T @ flat, flat.T @ (D.transpose(2, 0, 1) @ G).reshape(-1, 6), flat.T @ F.reshape(len(flat), -1)


@_SILENT
def examine(
    weight: Array, station: Array, extra: Array, target: Array, in_datum: NDArray[np.bool_],
    centre: Array, W: Array, shift: Array, H: Array, K: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Return covariances (m, 3, 3) of the targets, m^2, and redundancies (n, m) of the readings.

    Parameters
    ----------
    W : ndarray (4 n + k, p)
        Factor of the covariance of the stations' parameters, in any datum.
    shift : ndarray (6, p)
        Effect of the factor on the rigid motion of the datum.
    H, K : ndarray (6, 6)
        Inverse of the sum of G^T G; and H (sum of G^T D G) H.
    """
    n = len(station)
    e, D, whole = seen(weight, station, target)
    # Readings by the stations' factor, then targets: both sum over the stations.
    by_station = W[: 4 * n].reshape(n, 4, -1)
    q = -np.einsum("jam,jap->mjp", e, by_station[:, :3]) - by_station[:, 3]
    if len(extra):
        q += np.einsum("kjm,kp->mjp", extra, W[4 * n :])
    q *= weight.T[:, :, None]
    E = (weight[:, None] * e).transpose(2, 0, 1)
    own = D.transpose(2, 0, 1)
    F = -(own @ E.transpose(0, 2, 1)) @ q
    hat = np.einsum("mja,mab,mjb->jm", E, own, E)
    taken = np.einsum("mjp,mjp->jm", left := q + E @ F, left)
    redundancy = np.where(whole & (weight > 0), 1.0 - hat - taken, np.nan)
    G = rigid_motions(target, centre)
    F = F - G @ shift
    DG = np.where(in_datum[:, None, None], own @ G, 0.0)
    # (1/2 G K - D G H) G^T and its transpose are the terms of the datum.
    side = (0.5 * G @ K - DG @ H) @ G.transpose(0, 2, 1)
    covariance = own + F @ F.transpose(0, 2, 1) + side + side.transpose(0, 2, 1)
    covariance[~whole] = np.nan
    return covariance, redundancy


def equations(c: Array, e: Array) -> Array:
    """Return the equations (4 n, (n - 3) m) of targets for (U, L) of every station, from rows c (n - 3, n, m)."""
    by_station = -c[:, :, None] * np.concatenate([e, np.ones_like(e[:, :1])], axis=1)
    return np.asarray(by_station.transpose(1, 2, 0, 3).reshape(4 * len(e), -1))


def response(own: Array, e: Array) -> Array:
    """Return the motion (m, 3, 4 n) of targets by (U, L) of every station, from w^2 D e (n, 3, m)."""
    by_station = np.einsum("jam,jbm->majb", own, np.concatenate([e, np.ones_like(e[:, :1])], axis=1))
    return np.asarray(by_station.reshape(e.shape[2], 3, -1))


def _reach(reading: Array, dead_path: Array, extra: Array, value: Array) -> Array:
    """Return the distances (n, m) measured by the readings, m."""
    found = reading + dead_path[:, None]
    return found - np.tensordot(value, extra, 1) if len(value) else found


def _sight(position: Array, station: Array) -> tuple[Array, Array]:
    """Return unit vectors (n, 3, m) from the stations to targets (3, m), and distances (n, m), m."""
    v = position - station[:, :, None]
    distance = np.sqrt(np.einsum("jam,jam->jm", v, v))
    return v / distance[:, None], distance


def seen(weight: Array, station: Array, target: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return directions (n, 3, m) and D (3, 3, m) of targets (m, 3), and which have a D; else 0 and the unit matrix."""
    e, _ = _sight(target.T, station)
    D, _, whole = _inverse(weight[:, None] * e)
    if not whole.all():
        e, D = np.where(whole, e, 0.0), np.where(whole, D, np.eye(3)[:, :, None])
    return e, D, whole


def _inverse(E: Array) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return D (3, 3, m), the inverse of E^T E, whether it can move a target, and whether it determines a position."""
    (a00, a01, a02), (_, a11, a12), (_, _, a22) = np.einsum("jam,jbm->abm", E, E)
    trace = a00 + a11 + a22
    least = NO_POSITION * trace
    # E^T E = R^T R, and D = R^-1 R^-T.
    i00 = 1.0 / np.sqrt(a00)
    r01, r02 = a01 * i00, a02 * i00
    p11 = a11 - r01 * r01
    i11 = 1.0 / np.sqrt(p11)
    r12 = (a12 - r01 * r02) * i11
    p22 = a22 - r02 * r02 - r12 * r12
    i22 = 1.0 / np.sqrt(p22)
    i01, i12 = -i00 * r01 * i11, -i11 * r12 * i22
    i02 = -(i00 * r02 + i01 * r12) * i22
    d01, d02, d12 = i01 * i11 + i02 * i12, i02 * i22, i12 * i22
    D = np.array([[i00 * i00 + i01 * i01 + i02 * i02, d01, d02], [d01, i11 * i11 + i12 * i12, d12],
                  [d02, d12, i22 * i22]])  # fmt: skip
    moves = a00 * p11 * p22 > FLAT * trace**3
    whole = (a00 > least) & (p11 > least) & (p22 > least)
    return D, moves, whole


def _locate(
    reach: Array, weight: Array, station: Array, position: Array, steps: int, short: float
) -> tuple[float, Array]:
    """Move targets (3, m) in place by Gauss-Newton steps on their distances (n, m) until the longest is short.

    Return the length of the longest first step, m, and the traces (m,) of the targets' covariances with known stations,
    m^2: infinite if a direction is not determined.
    """
    first = 0.0
    for step in range(steps + 1):
        e, distance = _sight(position, station)
        E = weight[:, None] * e
        D, moves, whole = _inverse(E)
        right = np.einsum("jam,jm->am", E, weight * (reach - distance))
        s = np.where(moves, np.einsum("abm,bm->am", D, right), 0.0)
        size = np.sqrt(np.einsum("am,am->m", s, s))
        # At most half the distance to the nearest station.
        half = 0.5 * np.where(weight > 0, distance, np.inf).min(axis=0)
        if (size > half).any():
            s *= np.minimum(1.0, half / np.maximum(size, 1e-300))
        position += s
        far = float(size.max(initial=0.0))
        first = far if step == 0 else first
        if not far >= short:
            break
    return first, np.where(whole, np.einsum("aam->m", D), np.inf)


def orthogonal_rows(E: Array) -> Array:
    """Return orthonormal rows (n - 3, n, m) that are orthogonal to the columns of E (n, 3, m)."""
    n, _, m = E.shape
    R = np.concatenate([E, np.broadcast_to(np.eye(n)[:, :, None], (n, n, m))], axis=1)
    for c in range(3):
        v = R[c:, c].copy()
        square = np.einsum("jm,jm->m", v, v)
        alpha = -np.copysign(np.sqrt(square), v[0])
        twice = square - alpha * v[0]
        beta = np.divide(1.0, twice, out=np.zeros(m), where=square > 0)
        v[0] -= alpha
        R[c:] -= v[:, None] * (beta * np.einsum("jm,jkm->km", v, R[c:]))
    return R[3:, 3:]
