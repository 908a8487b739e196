"""Predicted uncertainty of a layout: the Cramer-Rao bound of targets and stations.

The covariance of a network depends only on positions and noise. Its estimates reach it if the uncertainty of the
stations is small compared with their distances.
"""

from __future__ import annotations

import numpy as np

from errormotion.arrays import Array
from errormotion.estimation.linear.normal import SingularError, factorised
from errormotion.kinematics.twists import rigid_motions
from errormotion.methods.multilateration import determinacy
from errormotion.methods.multilateration.start import Stations


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
    whole = ~determinacy.lost_targets(weight > 0, e, 1.0 / weight)
    T[~whole], B = np.eye(3), B * whole[:, None]
    G = np.einsum("jta,jtb->tajb", E, B).reshape(m, 3, 4 * n)
    D = np.zeros((n, 4, n, 4))
    D[np.arange(n), :, np.arange(n)] = np.einsum("jta,jtb->jab", B, B)
    stations = Stations(station, np.zeros(n))
    try:
        normal = factorised([T], G, D.reshape(4 * n, 4 * n), stations.motions(target.mean(axis=0)).reshape(4 * n, 6))
    except SingularError:
        return None
    own, used = normal.own, whole
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
