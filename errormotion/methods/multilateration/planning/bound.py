"""Predicted uncertainty of a layout: the Cramer-Rao bound of targets and stations.

The covariance of a network depends only on positions and noise. The estimates of `solver` reach it if the uncertainty
of the stations is small compared with their distances. The formulation of the paper, L_j = |u_1 - U_j|, assumes the
readings of the first target to be exact: their noise affects all results, but is not in the stated covariance.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.twists import rigid_motions
from errormotion.methods.multilateration.network import target_sums
from errormotion.methods.multilateration.network.descent import State
from errormotion.methods.multilateration.network.diagnosis import determinacy
from errormotion.methods.multilateration.network.diagnosis.weakness import datum_targets
from errormotion.methods.multilateration.network.model import Stations, readings
from errormotion.methods.multilateration.network.network import Network
from errormotion.methods.multilateration.network.problem import state_problem
from errormotion.methods.multilateration.network.solver import conclude

_EXACT = 1e-3
"""Ratio by which the noise of the first target's readings is reduced to assume them exact."""


def bound(
    target: ArrayLike,
    station: ArrayLike,
    *,
    noise: ArrayLike = 1e-6,
    seen: ArrayLike | None = None,
    dead_path_uncertainty: ArrayLike | None = None,
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
    dead_path_uncertainty : array_like (n,), optional
        Standard uncertainties of the dead paths, m; default: unknown dead paths.

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
    stations = Stations(U, np.zeros(len(U)), np.zeros(0))
    d = readings(u, stations)
    if seen is not None:
        d = np.where(np.asarray(seen, dtype=bool), d, np.nan)
    known = None if dead_path_uncertainty is None else (np.zeros(len(U)), dead_path_uncertainty)
    problem = state_problem(d, u, noise, known)
    determinacy.refuse_too_few(problem.by_target, problem.by_station, problem.unknown)
    position = np.ascontiguousarray(u.T)
    return conclude(problem, State(stations, position, problem.reduce(stations, position), 0, True), U)


@np.errstate(all="ignore")
def predicted_uncertainty(weight: Array, station: Array, target: Array) -> Array | None:
    """Return the standard uncertainties (m,) of targets (m, 3), three coordinates together, m; NaN without a position.

    None if a freedom is undetermined. Stations and dead paths are unknown; the covariances are those of `examine`.
    """
    weight = np.where(np.count_nonzero(weight, axis=0) >= 3, weight, 0.0)
    e, D, whole = target_sums.seen(weight, station, target)
    own = np.einsum("aam->m", D)
    used = whole & datum_targets(np.where(whole, own, np.inf))
    if np.count_nonzero(used) < 3:
        return None
    N = target_sums.orthogonal_rows(weight[:, None] * e)
    V = target_sums.equations(N * weight, e)
    n, centre = len(station), target[used].mean(axis=0)
    stations = Stations(station, np.zeros(n), np.zeros(0))
    Z = stations.complement(centre, np.ones(4 * n, dtype=bool))
    G = rigid_motions(target, centre)
    F = target_sums.response(weight[:, None] ** 2 * np.einsum("abm,jbm->jam", D, e), e)
    flat = G[used].reshape(-1, 6)
    H = np.linalg.inv(flat.T @ flat)
    shift = H @ (flat.T @ F[used].reshape(len(flat), -1))
    information = Z.T @ (V @ V.T) @ Z
    if determinacy.freedoms(information, Z - stations.motions(centre) @ (shift @ Z), station, target[used])[3].any():
        return None
    W = Z @ np.linalg.inv(np.linalg.cholesky(information)).T
    F = (F - G @ shift) @ W
    DG = D.transpose(2, 0, 1) @ G * used[:, None, None]
    K = H @ (flat.T @ DG[used].reshape(-1, 6)) @ H
    variance = own + np.einsum("map,map->m", F, F) + np.einsum("map,map->m", G @ K - 2 * DG @ H, G)
    return np.where(whole, np.sqrt(variance), np.nan)


def relative_bound(
    target: ArrayLike, station: ArrayLike, *, noise: float = 1e-6, first: int = 0
) -> tuple[Array, Array, Network]:
    """Return the covariances of the formulation relative to one target.

    Returns
    -------
    target_covariance, joint_covariance : ndarray (m, 3, 3), (4 n, 4 n)
        Of its estimates, in the datum of the free network.
    stated : Network
        With the covariances that it states: the readings of that target are assumed exact.
    """
    n, m = len(np.asarray(station)), len(np.asarray(target))
    sigma = np.full((n, m), float(noise))
    sigma[:, first] *= _EXACT
    stated = bound(target, station, noise=sigma)
    covariance, joint = stated.target_covariance.copy(), stated.joint_covariance.copy()
    for j in range(n):
        change = np.zeros((n, m))
        change[j, first] = float(noise) * np.sqrt(1.0 - _EXACT**2)
        moved, parameters = stated.response(change)
        covariance += moved[:, :, None] * moved[:, None, :]
        joint += np.outer(parameters, parameters)
    return covariance, joint, stated
