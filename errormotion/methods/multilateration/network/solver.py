"""Multilateration: targets, stations and dead paths from displacements, without outliers, as a free network.

Distances do not determine the six rigid motions of the whole. They are the gauge of the least squares; the solution is
then moved to the best fit of the targets to the nominal ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.errors import FitError, MethodError
from errormotion.estimation.fit import Fit, fit
from errormotion.estimation.normal import SingularError
from errormotion.estimation.problem import Linear, Problem, Unknown, linearised
from errormotion.methods.multilateration.network.diagnosis import determinacy, outliers
from errormotion.methods.multilateration.network.diagnosis.weakness import datum_targets, unlocated
from errormotion.methods.multilateration.network.model import Sources, Stations, stated
from errormotion.methods.multilateration.network.network import Network
from errormotion.methods.multilateration.network.start import initial_stations

DATUM_SAMPLE = 64
"""Number of evenly distributed targets whose datum is used to detect undetermined freedoms."""
_TURNED = 1e-6
"""Rotation of a solution into its datum, rad, by which the directions of its uncertainties turn noticeably."""
_GROSS_RMS = 100.0  # over the noise, from which gross outliers are searched first
_MAX_SEARCHES = 12


def solve(
    displacement: ArrayLike,
    target: ArrayLike,
    station: ArrayLike | None = None,
    *,
    noise: ArrayLike = 1e-6,
    sources: Sources | None = None,
    robust: bool = True,
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
    sources : Sources, optional
        What is uncertain besides.
    robust : bool
        Whether to find and ignore outliers.

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
    d, sd, nominal = _checked(displacement, target, noise)
    approximate = None if station is None else np.asarray(station, dtype=float)
    determinacy.refuse_too_few(d)
    start = initial_stations(d, np.where(np.isfinite(d), 1.0 / sd, 0.0), nominal, approximate)
    given = _Given(d, sd, nominal, Stations(start.position, start.dead_path), sources, approximate)
    found = outliers.Outliers.none(d)
    if not robust:
        return _network(given, found)
    network, failure = None, None
    try:
        network = _network(given, found)
    except MethodError as error:  # gross outliers make a network of another shape
        failure = error
    if network is None or not network.fit.chi2 < _GROSS_RMS**2 * d.size:
        found = outliers.gross(d, nominal, start.position, start.dead_path)
        if network is None and not found.left_out:
            raise failure or MethodError("The distances fit no network.")
        network = _network(given, found)
    for _ in range(_MAX_SEARCHES):
        now = outliers.search(network, nominal, found)
        if now == found:
            break
        found = now
        network = _network(given, found, network.fit.linear.at)
    return network


def at_truth(
    reading: Array, sd: ArrayLike, target: Array, stations: Stations, sources: Sources | None = None
) -> Network:
    """Return the network of error-free readings (n, m) of known targets and stations, with its covariances.

    Raises
    ------
    MethodError
        Positions with an undetermined freedom.
    """
    d, noise, nominal = _checked(reading, target, sd)
    given = _Given(d, noise, nominal, stations, sources, None)
    determinacy.refuse_too_few(d)
    problem = _problem(given, d)
    linear = linearised(problem, problem.start)
    try:
        return _concluded(Fit(linear, linear.normal()[0]), given, outliers.Outliers.none(d))
    except SingularError as error:
        raise _undetermined(linear, given) from error


def fitted_again(network: Network, problem: Problem) -> Array:
    """Return the targets (m, 3), m, of another problem with the same readings used, in the datum; NaN if unknown."""
    given = _Given(network.reading, network.reading, network.nominal, network.stations, None, None)
    found = fit(problem, what="the distances", start=network.fit.linear.at)
    target = _moved(found, given, network.in_datum)[0].unknowns.target
    return np.where(network.determined[:, None], target, np.nan)


@dataclass(frozen=True)
class _Given:
    """Readings and standard deviations (n, m), nominal targets (m, 3), a start, and stated positions of stations."""

    reading: Array
    sd: Array
    nominal: Array
    start: Stations
    sources: Sources | None
    approximate: Array | None


def _checked(displacement: ArrayLike, target: ArrayLike, noise: ArrayLike) -> tuple[Array, Array, Array]:
    """Return copies of readings (n, m), their standard deviations (n, m), and targets; raise for wrong shapes."""
    d, u = np.array(displacement, dtype=float), np.array(target, dtype=float)
    if d.ndim != 2 or u.shape != (d.shape[1], 3):
        raise MethodError(
            f"Expected displacements (station, target) and targets (target, 3); found {d.shape} and {u.shape}. "
            "State a row of displacements for every station and a position for every target."
        )
    if not np.isfinite(u).all():
        raise MethodError("Expected a nominal position for every target; found NaN. Remove such targets.")
    n, m = d.shape
    sd = np.asarray(noise, dtype=float)
    sd = sd[:, None] if sd.ndim == 1 and len(sd) == n else sd
    if sd.shape not in ((), (n, 1), (n, m)):
        raise MethodError(
            f"Expected the noise as one value, ({n},) or ({n}, {m}); found {sd.shape}. State it for all readings, "
            "each station, or each reading."
        )
    sd = np.broadcast_to(sd, d.shape)
    if not (sd[np.isfinite(d)] > 0).all():
        raise MethodError("Expected a positive standard deviation of every reading. State the instrument's noise, m.")
    d[~np.isfinite(d)] = np.nan
    return d, np.where(sd > 0, sd, 1.0), u


def _problem(given: _Given, used: Array) -> Problem:
    """Return the problem of the used readings (n, m), without those of targets that have no position."""
    lost = unlocated(used, given.sd, given.nominal, given.start.position)
    determinacy.refuse_flat(int(np.count_nonzero(~lost)), given.start.position, given.nominal)
    return stated(np.where(lost, np.nan, used), given.sd, given.nominal, given.start, given.sources)


def _network(given: _Given, found: outliers.Outliers, at: Unknown | None = None) -> Network:
    """Return the network without outliers."""
    used = np.where(found.out, np.nan, given.reading)
    determinacy.refuse_too_few(used)
    return _concluded(_in_datum(_problem(given, used), given, at), given, found)


def _in_datum(problem: Problem, given: _Given, at: Unknown | None) -> Fit:
    """Return the solution, moved to the best fit of its targets to the nominal ones."""
    solution, turned = _moved(_fitted(problem, given, at), given)
    if turned > _TURNED:
        solution, _ = _moved(_fitted(problem, given, solution.linear.at), given)
    return solution


def _fitted(problem: Problem, given: _Given, at: Unknown | None) -> Fit:
    try:
        return fit(problem, what="the distances", start=at)
    except FitError as error:
        if isinstance(error.__cause__, SingularError):
            raise _undetermined(linearised(problem, problem.start if at is None else at), given) from error.__cause__
        raise MethodError(f"{str(error)[:1].upper()}{str(error)[1:]}.") from error


def _moved(found: Fit, given: _Given, datum: NDArray[np.bool_] | None = None) -> tuple[Fit, float]:
    """Return a solution moved as a whole to the nominal targets, by values only, and the angle of its rotation, rad.

    The rotation is that of Kabsch, from the singular vectors of the cross products.
    """
    datum = _datum(found) if datum is None else datum
    determinacy.refuse_flat(int(datum.sum()), given.start.position, given.nominal)
    x = found.unknowns
    a, b = x.target[datum].mean(axis=0), given.nominal[datum].mean(axis=0)
    U, _, Vt = np.linalg.svd((given.nominal[datum] - b).T @ (x.target[datum] - a))
    if np.linalg.det(U @ Vt) < 0.0:
        U[:, 2] *= -1.0
    R = U @ Vt
    target, station = (x.target - a) @ R.T + b, x.station.copy()
    station[:, :3] = (station[:, :3] - a) @ R.T + b
    at = replace(found.linear.at, tables=[target, station, x.drift])
    return Fit(replace(found.linear, at=at), found.normal), float(np.linalg.norm(R - np.eye(3)))


def _datum(found: Fit) -> NDArray[np.bool_]:
    """Return which targets define the datum, (m,)."""
    free = found.problem.unknowns.target.freed[:, 0]
    return datum_targets(np.where(free, np.trace(found.normal.own, axis1=1, axis2=2), np.inf))


def _concluded(found: Fit, given: _Given, out: outliers.Outliers) -> Network:
    """Return the network of a solution in the datum; raise MethodError if a freedom is undetermined."""
    datum, x, normal = _datum(found), found.unknowns, found.normal
    determinacy.refuse_flat(int(datum.sum()), given.start.position, given.nominal)
    stations = Stations(x.station[:, :3], x.station[:, 3])
    values = determinacy.refuse_undetermined(
        normal.S, normal.F, stations, x.target, datum, given.start.position, DATUM_SAMPLE
    )
    return Network(
        found, given.reading, given.nominal, datum, float(values[-1] / values[0]), out.left_out, out.undecided,
        given.approximate,
    )  # fmt: skip


def _undetermined(linear: Linear, given: _Given) -> MethodError:
    """Return the error that names the freedoms which the distances leave undetermined."""
    [T], G, D = linear.sums()
    free = linear.problem.unknowns.target.freed[:, 0]
    F = np.where(free[:, None, None], np.linalg.pinv(T, hermitian=True) @ G, 0.0)
    D = D + np.diag(linear.border_prior()[0])
    S = D - np.tensordot(G, F, axes=((0, 1), (0, 1)))
    x = linear.at.tables
    try:
        determinacy.refuse_undetermined(
            S, F, Stations(x[1][:, :3], x[1][:, 3]), x[0], free, given.start.position, DATUM_SAMPLE
        )
    except MethodError as error:
        return error
    return MethodError("The distances do not determine stations and targets. Distribute them more widely.")
