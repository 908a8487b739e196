"""Multilateration: targets, stations and dead paths from displacements, without outliers.

The solution of `descent` is fitted to the nominal targets by a rigid motion (see `network`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.methods.multilateration.network import target_sums
from errormotion.methods.multilateration.network.descent import State, descend
from errormotion.methods.multilateration.network.diagnosis import determinacy, outliers
from errormotion.methods.multilateration.network.diagnosis.weakness import datum_targets
from errormotion.methods.multilateration.network.model import Stations
from errormotion.methods.multilateration.network.network import Network
from errormotion.methods.multilateration.network.problem import Problem, state_problem
from errormotion.methods.multilateration.network.rigid_motion import Motion
from errormotion.methods.multilateration.network.start import initial_stations

TOLERANCE = 1e-12
"""Displacement of a target by a further step, m, below which the iteration ends."""
DATUM_SAMPLE = 64
"""Number of evenly distributed targets whose datum is used to detect undetermined freedoms."""
_GROSS_RMS = 100.0  # over the noise, from which gross outliers are searched first
_MAX_SEARCHES = 12


def solve(
    displacement: ArrayLike,
    target: ArrayLike,
    station: ArrayLike | None = None,
    *,
    noise: ArrayLike = 1e-6,
    dead_path: tuple[ArrayLike, ArrayLike] | None = None,
    extra: ArrayLike | None = None,
    extra_prior: ArrayLike | None = None,
    robust: bool = True,
    tolerance: float = TOLERANCE,
) -> Network:
    """Estimate targets, stations and dead paths from displacements, in the frame of the nominal targets.

    Parameters
    ----------
    displacement : array_like (n, m)
        Readings of station j for target i, m; NaN where the beam was interrupted.
    target : array_like (m, 3)
        Nominal targets, m: start and datum.
    station : array_like (n, 3), optional
        Approximate positions of the stations, m; default: from the distances.
    noise : array_like (), (n,) or (n, m)
        Standard deviation of a reading, m: of all, of each station's, of each.
    dead_path : pair of array_like (n,), optional
        Prior values of the dead paths and their standard uncertainties, m; 0: fixed, infinite: unknown. Default: all
        are unknown.
    extra : array_like (k, n, m), optional
        Effect of a unit of each of k further parameters on every reading.
    extra_prior : array_like (k,), optional
        Standard uncertainty of each further parameter about 0. Default: infinite, unknown.
    robust : bool
        Whether to find and ignore outliers.
    tolerance : float
        Displacement of a target by a further step, m, below which the iteration ends.

    Returns
    -------
    Network

    Raises
    ------
    MethodError
        Fewer readings than unknowns, positions with an undetermined freedom, or readings that fit no network.

    Notes
    -----
    Model of Takeuchi et al. (estimation of volumetric errors by a laser tracker), with free dead paths instead of
    L_j = |u_1 - U_j|, so that the noise of the first target does not affect the others.
    """
    problem = state_problem(displacement, target, noise, dead_path, extra, extra_prior)
    determinacy.refuse_too_few(problem.by_target, problem.by_station, problem.unknown)
    positions = None if station is None else np.asarray(station, dtype=float)
    start = initial_stations(problem.reading, problem.weight, problem.nominal, positions)
    stations = Stations(start.position, start.dead_path, np.zeros(len(problem.extra)))
    if dead_path is not None:
        fixed = ~problem.free[3 : 4 * len(start.position) : 4]
        known = np.where(fixed, problem.prior[3 : 4 * len(start.position) : 4], stations.dead_path)
        stations = replace(stations, dead_path=known)
    state = descend(problem, stations, problem.nominal, tolerance)
    found = outliers.Outliers.none(problem.weight)
    if not robust:
        return conclude(problem, state, start.position, positions)
    original = problem.weight
    if not state.sums.square < _GROSS_RMS**2 * problem.reading.size:
        # Gross outliers: restart without them.
        found = outliers.gross(problem.reading, original, problem.nominal, start.position, start.dead_path)
        problem = _without(problem, original, found)
        state = descend(problem, stations, problem.nominal, tolerance)
    network = conclude(problem, state, start.position, positions, found)
    for _ in range(_MAX_SEARCHES):
        now = outliers.search(network, original, problem.nominal, found)
        if now == found:
            break
        found = now
        problem = _without(problem, original, found)
        target = np.where(np.isfinite(network.target), network.target, problem.nominal)
        state = descend(problem, network.stations, target, tolerance)
        state = replace(state, passes=state.passes + network.iterations)
        network = conclude(problem, state, start.position, positions, found)
    return network


def _without(problem: Problem, original: Array, found: outliers.Outliers) -> Problem:
    """Return the problem without outliers; ``original`` are the weights (n, m) of all readings."""
    problem = problem.weighted(found.applied(original))
    determinacy.refuse_too_few(problem.by_target, problem.by_station, problem.unknown)
    return problem


def conclude(
    problem: Problem,
    state: State,
    start: Array,
    approximate: Array | None = None,
    found: outliers.Outliers | None = None,
) -> Network:
    """Return a solution in the datum.

    Parameters
    ----------
    problem, state
        Problem and solution.
    start : ndarray (n, 3)
        Approximate positions of the stations, m, stated or calculated, for the message on an undetermined freedom.
    approximate : ndarray (n, 3), optional
        Stated ones, m, for the note on swapped stations.
    found : Outliers, optional
        Readings that were ignored.

    Raises
    ------
    MethodError
        The distances leave a freedom undetermined.
    """
    position, free = state.position, state.stations
    traces, sums = target_sums.settle_targets(
        problem.reading, problem.weight, free.position, free.dead_path, problem.extra, free.value,
        position, problem.nominal, problem.centre,
    )  # fmt: skip
    in_datum = datum_targets(traces)
    if np.count_nonzero(in_datum) != sums[0]:
        sums = target_sums.moments(position, problem.nominal, in_datum, problem.centre)
    some = slice(None, None, max(1, position.shape[1] // DATUM_SAMPLE))
    determinacy.refuse_not_finite(position[:, some], state.sums.H, sums)
    determinacy.refuse_flat(int(sums[0]), start, position[:, some].T)
    motion = Motion.of(sums, problem.centre)
    stations, target = motion.stations(free), target_sums.moved(position, motion.a, motion.b, motion.R, traces)
    Z = problem.basis(stations, motion.b)
    information = _within(state.sums.H, Z, motion.R, len(start))
    # Undetermined freedoms are detected in the datum of some of the targets.
    sample = np.flatnonzero(in_datum)[:: max(1, int(sums[0]) // DATUM_SAMPLE)]
    GG, _, GF = target_sums.datum_sums(
        problem.weight[:, sample],
        stations.position,
        problem.extra[:, :, sample],
        target[sample],
        in_datum[sample],
        motion.b,
    )
    determinacy.refuse_not_finite(GG, GF)
    basis = Z - stations.motions(motion.b) @ np.linalg.lstsq(GG, GF @ Z)[0]
    values = determinacy.refuse_undetermined(information, basis, stations, target[sample], start)
    W = Z @ np.linalg.inv(np.linalg.cholesky(information)).T
    known = int(np.count_nonzero(problem.free & (problem.precision > 0)))
    freedom = int(problem.by_station.sum()) + known - 3 * int(np.count_nonzero(problem.by_target >= 3)) - W.shape[1]
    sigma0 = float(np.sqrt(state.sums.square / freedom)) if freedom > 0 else np.nan
    found = found or outliers.Outliers.none(problem.weight)
    return Network(
        target, stations, problem.reading, problem.weight, found.left_out, found.undecided, sigma0, freedom,
        state.passes, state.converged, float(values[-1] / values[0]), problem.extra, in_datum, motion.b, W, approximate,
    )  # fmt: skip


def _within(H: Array, Z: Array, R: Array, stations: int) -> Array:
    """Return the information H within the columns of Z after a rotation R of the network with ``stations`` stations."""
    C = Z.copy()
    blocks = C[: 4 * stations].reshape(stations, 4, -1)
    blocks[:, :3] = R.T @ blocks[:, :3]
    return np.asarray(C.T @ H @ C)
