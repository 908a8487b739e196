"""Multilateration: targets, stations and dead paths from displacements, readings that are wrong left out.

The solution is that of `descent`; at the end the whole is fitted to the nominal targets (see `network`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.methods.multilateration.network.descent import State, descend
from errormotion.methods.multilateration.network.diagnosis import determinacy, outliers
from errormotion.methods.multilateration.network.diagnosis.weakness import carriers
from errormotion.methods.multilateration.network.loops import loops
from errormotion.methods.multilateration.network.model import Stations
from errormotion.methods.multilateration.network.network import Network
from errormotion.methods.multilateration.network.problem import Problem, state_problem
from errormotion.methods.multilateration.network.start import initial_stations
from errormotion.methods.multilateration.network.turning import Motion

TOLERANCE = 1e-12
"""What a further step may still move a target, m."""
LOOKED_AT = 64
"""Targets on whose datum a loose freedom is judged: an even choice of them does for all."""
_HOPELESS = 100.0
_ROUNDS = 12


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
        Readings of station j for target i, m; NaN where the beam was broken.
    target : array_like (m, 3)
        Nominal targets, m: start and datum.
    station : array_like (n, 3), optional
        Rough places of the stations, m; default: from the distances.
    noise : array_like (), (n,) or (n, m)
        Standard deviation of a reading, m: of all, of each station's, of each.
    dead_path : pair of array_like (n,), optional
        What is known of the dead paths: values and standard uncertainties, m; 0 fixes one, infinite leaves it free.
        All are free without it.
    extra : array_like (k, n, m), optional
        What a unit of each of k further parameters adds to every reading.
    extra_prior : array_like (k,), optional
        Standard uncertainty of each further parameter about 0; infinite (not known) without it.
    robust : bool
        Find readings that are wrong and leave them out; without it all count.
    tolerance : float
        What a further step may still move a target, m.

    Returns
    -------
    Network

    Raises
    ------
    MethodError
        Fewer readings than unknowns, positions that leave a freedom undetermined, or readings that fit no network.

    Notes
    -----
    Model of Takeuchi et al. (estimation of volumetric errors by a laser tracker), with dead paths free in place of
    L_j = |u_1 - U_j|, so that the noise of the first target stays its own.
    """
    problem = state_problem(displacement, target, noise, dead_path, extra, extra_prior)
    determinacy.refuse_too_few(problem.by_target, problem.by_station, problem.unknown)
    places = None if station is None else np.asarray(station, dtype=float)
    start = initial_stations(problem.reading, problem.weight, problem.nominal, places)
    stations = Stations(start.place, start.dead_path, np.zeros(len(problem.extra)))
    if dead_path is not None:
        fixed = ~problem.free[3 : 4 * len(start.place) : 4]
        known = np.where(fixed, problem.prior[3 : 4 * len(start.place) : 4], stations.dead_path)
        stations = replace(stations, dead_path=known)
    state = descend(problem, stations, problem.nominal, tolerance)
    found = outliers.Found.none(problem.weight)
    if not robust:
        return conclude(problem, state, start.place, places)
    original = problem.weight
    if not state.sums.square < _HOPELESS**2 * problem.reading.size:
        # Gross ones have led it astray: without them, from the start.
        found = outliers.gross(problem.reading, original, problem.nominal, start.place, start.dead_path)
        problem = _without(problem, original, found)
        state = descend(problem, stations, problem.nominal, tolerance)
    network = conclude(problem, state, start.place, places, found)
    for _ in range(_ROUNDS):
        now = outliers.search(network, original, problem.nominal, found)
        if now == found:
            break
        found = now
        problem = _without(problem, original, found)
        target = np.where(np.isfinite(network.target), network.target, problem.nominal)
        state = descend(problem, network.stations, target, tolerance)
        state = replace(state, passes=state.passes + network.iterations)
        network = conclude(problem, state, start.place, places, found)
    return network


def _without(problem: Problem, original: Array, found: outliers.Found) -> Problem:
    """Return the problem without readings that were found wrong; ``original`` are the weights (n, m) of all."""
    problem = problem.weighted(found.applied(original))
    determinacy.refuse_too_few(problem.by_target, problem.by_station, problem.unknown)
    return problem


def conclude(
    problem: Problem, state: State, start: Array, rough: Array | None = None, found: outliers.Found | None = None
) -> Network:
    """Bring a solution into the datum and return it.

    Parameters
    ----------
    problem, state
        What was solved, and how.
    start : ndarray (n, 3)
        Approximate positions of the stations, m, stated or found, for the message on a loose freedom.
    rough : ndarray (n, 3), optional
        Stated ones, m, for the note on swapped stations.
    found : Found, optional
        What was left out.
    """
    place, free = state.place, state.stations
    of = loops(place.shape[1])
    openness, sums = of.settle_targets(
        problem.reading, problem.weight, free.place, free.dead_path, problem.extra, free.value,
        place, problem.nominal, problem.centre,
    )  # fmt: skip
    carries = carriers(openness)
    if np.count_nonzero(carries) != sums[0]:
        sums = of.moments(place, problem.nominal, carries, problem.centre)
    some = slice(None, None, max(1, place.shape[1] // LOOKED_AT))
    determinacy.refuse_nowhere(place[:, some], state.sums.H, sums)
    determinacy.refuse_flat(int(sums[0]), start, place[:, some].T)
    motion = Motion.of(sums, problem.centre)
    stations, target = motion.stations(free), of.moved(place, motion.a, motion.b, motion.R, openness)
    Z = problem.basis(stations, motion.b)
    information = _within(state.sums.H, Z, motion.R, len(start))
    # A loose freedom is judged in the datum of some of the targets.
    sample = np.flatnonzero(carries)[:: max(1, int(sums[0]) // LOOKED_AT)]
    GG, _, GF = loops(len(sample)).datum_sums(
        problem.weight[:, sample],
        stations.place,
        problem.extra[:, :, sample],
        target[sample],
        carries[sample],
        motion.b,
    )
    determinacy.refuse_nowhere(GG, GF)
    basis = Z - stations.motions(motion.b) @ np.linalg.lstsq(GG, GF @ Z)[0]
    values = determinacy.refuse_loose(information, basis, stations, target[sample], start)
    W = Z @ np.linalg.inv(np.linalg.cholesky(information)).T
    known = int(np.count_nonzero(problem.free & (problem.precision > 0)))
    freedom = int(problem.by_station.sum()) + known - 3 * int(np.count_nonzero(problem.by_target >= 3)) - W.shape[1]
    sigma0 = float(np.sqrt(state.sums.square / freedom)) if freedom > 0 else np.nan
    found = found or outliers.Found.none(problem.weight)
    return Network(
        target, stations, problem.reading, problem.weight, found.left_out, found.undecided, sigma0, freedom,
        state.passes, state.converged, float(values[-1] / values[0]), problem.extra, carries, motion.b, W, rough,
    )  # fmt: skip


def _within(H: Array, Z: Array, R: Array, stations: int) -> Array:
    """Return the information H within the columns of Z when the whole, with so many stations, has been turned by R."""
    C = Z.copy()
    blocks = C[: 4 * stations].reshape(stations, 4, -1)
    blocks[:, :3] = R.T @ blocks[:, :3]
    return np.asarray(C.T @ H @ C)
