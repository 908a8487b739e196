"""Predicted uncertainty of a layout: the Cramer-Rao bound of targets and stations.

The covariance of a network depends only on positions and noise. The estimates of `solver` reach it if the uncertainty
of the stations is small compared with their distances.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.normal import SingularError, factorised
from errormotion.kinematics.twists import rigid_motions
from errormotion.methods.multilateration.network.diagnosis import determinacy
from errormotion.methods.multilateration.network.diagnosis.weakness import FLAT, datum_targets
from errormotion.methods.multilateration.network.model import Sources, Stations, readings
from errormotion.methods.multilateration.network.network import Network
from errormotion.methods.multilateration.network.solver import at_truth


def bound(
    target: ArrayLike,
    station: ArrayLike,
    *,
    noise: ArrayLike = 1e-6,
    seen: ArrayLike | None = None,
    sources: Sources | None = None,
) -> Network:
    """Return the network of error-free readings with the expected covariances.

    Parameters
    ----------
    target : array_like (m, 3)
        m.
    station : array_like (n, 3)
        m.
    noise : array_like (), (n,) or (n, m)
        Standard deviation of a reading, m.
    seen : array_like of bool (n, m), optional
        Which readings exist; default: all.
    sources : Sources, optional
        What is uncertain besides.

    Raises
    ------
    MethodError
        Positions with an undetermined freedom.
    """
    u, U = np.asarray(target, dtype=float), np.asarray(station, dtype=float)
    if u.ndim != 2 or u.shape[1] != 3 or U.ndim != 2 or U.shape[1] != 3:
        raise MethodError(f"Expected positions (target, 3) and (station, 3); found {u.shape} and {U.shape}.")
    if not (np.isfinite(u).all() and np.isfinite(U).all()):
        raise MethodError("Expected finite positions of targets and stations; found NaN or infinite ones.")
    stations = Stations(U, np.zeros(len(U)))
    d = readings(u, stations)
    if seen is not None:
        d = np.where(np.asarray(seen, dtype=bool), d, np.nan)
    return at_truth(d, noise, u, stations, sources)


@np.errstate(all="ignore")
def predicted_uncertainty(weight: Array, station: Array, target: Array) -> Array | None:
    """Return the standard uncertainties (m,) of targets (m, 3), three coordinates together, m; NaN without a position.

    None if a freedom is undetermined. They are those of `bound`, which is four times slower, for a search of positions.
    """
    n, m = weight.shape
    weight = np.where(np.count_nonzero(weight, axis=0) >= 3, weight, 0.0)
    v = target - station[:, None]
    e = v / np.sqrt(np.einsum("jta,jta->jt", v, v))[:, :, None]
    # Readings by target, and by station and dead path, each times the weight: E and -(E, w)
    E = weight[:, :, None] * e
    B = np.concatenate([-E, -weight[:, :, None]], axis=2)
    T = np.einsum("jta,jtb->tab", E, E)
    whole = np.linalg.det(T) > FLAT * np.trace(T, axis1=1, axis2=2) ** 3
    T[~whole], B = np.eye(3), B * whole[:, None]
    G = np.einsum("jta,jtb->tajb", E, B).reshape(m, 3, 4 * n)
    D = np.zeros((n, 4, n, 4))
    D[np.arange(n), :, np.arange(n)] = np.einsum("jta,jtb->jab", B, B)
    stations = Stations(station, np.zeros(n))
    try:
        normal = factorised([T], G, D.reshape(4 * n, 4 * n), stations.motions(target.mean(axis=0)).reshape(4 * n, 6))
    except SingularError:
        return None
    own = normal.own
    used = whole & datum_targets(np.where(whole, np.trace(own, axis1=1, axis2=2), np.inf))
    if np.count_nonzero(used) < 3:
        return None
    information, basis = determinacy.without_motions(normal.S, normal.F[used], stations, target[used])
    if determinacy.freedoms(information, basis, station, target[used])[3].any():
        return None
    # The free network on the targets used; see `network`.
    g = rigid_motions(target, target[used].mean(axis=0))
    flat = g[used].reshape(-1, 6)
    H = np.linalg.inv(flat.T @ flat)
    F = normal.shared
    F = F - g @ (H @ (flat.T @ F[used].reshape(len(flat), -1)))
    DG = own @ g * used[:, None, None]
    K = H @ (flat.T @ DG[used].reshape(-1, 6)) @ H
    variance = np.trace(own, axis1=1, axis2=2) + np.einsum("tap,tap->t", F, F)
    variance += np.einsum("tap,tap->t", g @ K - 2 * DG @ H, g)
    return np.where(whole, np.sqrt(variance), np.nan)
