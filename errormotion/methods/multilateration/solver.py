"""Gauss-Newton of a multilateration network with each target's block eliminated: cost and memory linear in the targets.

A pass puts every target where its distances from the present stations are best fulfilled, and adds up what is left of
its readings: information and gradient of 4 n parameters, whatever the number of targets. Their step follows from a
system of that size, in which the six motions of the whole are left out. Levenberg's damping comes in when a step makes
things worse. At the end the whole is fitted to the nominal targets (see `network`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.errors import MethodError
from errormotion.methods.multilateration import determinacy, outliers
from errormotion.methods.multilateration.examination import datum_sums, examine
from errormotion.methods.multilateration.kernels import reduce_targets
from errormotion.methods.multilateration.model import Stations
from errormotion.methods.multilateration.network import Datum, Network
from errormotion.methods.multilateration.start import initial_stations
from errormotion.methods.multilateration.turning import fitted

Array = NDArray[np.float64]

TOLERANCE = 1e-13
"""What a further step may still move a target, m."""
_PASSES = 200
_HOPELESS = 100.0
_DAMPED = 1e-8
_UNDAMPED = 1e-11
_LONG = 12
_ROUNDS = 12


@dataclass(frozen=True)
class Problem:
    """Readings, their weights, and what is known of the stations' parameters.

    Attributes
    ----------
    reading, weight : ndarray (n, m)
        m, 0 where there is none, and 1 / standard deviation, 1/m, 0 for what does not count.
    extra : ndarray (k, n, m)
        Derivatives of the readings by further parameters.
    precision : ndarray (4 n + k,)
        1 / variance of what is known of each parameter beforehand, about ``prior``; infinite for what is fixed.
    prior : ndarray (4 n + k,)
        Only where the precision is not 0.
    nominal : ndarray (m, 3)
        Nominal targets, m: the datum.
    """

    reading: Array
    weight: Array
    extra: Array
    precision: Array
    prior: Array
    nominal: Array

    @property
    def free(self) -> NDArray[np.bool_]:
        """Parameters that are estimated."""
        return np.isfinite(self.precision)

    def basis(self, stations: Stations, centre: Array) -> Array:
        """Return orthonormal columns (4 n + k, p) that span the free parameters without the motions of the whole."""
        T = stations.motions(centre)[self.free]
        full = np.linalg.qr(T / np.linalg.norm(T, axis=0), mode="complete")[0]
        Z = np.zeros((len(self.free), full.shape[1] - 6))
        Z[self.free] = full[:, 6:]
        return Z

    def reduce(self, stations: Stations, target: Array) -> Sums:
        """Move the targets in place and return what they say about the stations."""
        sums, moved = reduce_targets(
            self.reading, self.weight, stations.place, stations.dead_path, self.extra, stations.value, target
        )
        known = np.isfinite(self.precision) & (self.precision > 0)
        H, h, square = sums[:-1, :-1], sums[:-1, -1].copy(), float(sums[-1, -1])
        if known.any():
            off = np.where(known, self.prior - _vector(stations), 0.0)
            weight = np.where(known, self.precision, 0.0)
            H = H + np.diag(weight)
            h += weight * off
            square += float(weight @ off**2)
        return Sums(H, h, square, moved, len(stations.value))


@dataclass(frozen=True)
class Sums:
    """Information H, gradient h, sum of squares, how far targets went, m, and how many further parameters there are."""

    H: Array
    h: Array
    square: float
    moved: float
    further: int

    def turned(self, R: Array) -> Sums:
        """Return what the targets say when the whole has been turned by R (3, 3)."""
        B = np.eye(len(self.h))
        for j in range(0, len(self.h) - self.further, 4):
            B[j : j + 3, j : j + 3] = R
        return replace(self, H=B @ self.H @ B.T, h=B @ self.h)


@dataclass(frozen=True)
class State:
    """Stations and targets, passes taken, and whether the last step was small enough."""

    stations: Stations
    target: Array
    sums: Sums
    passes: int
    converged: bool


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
        Rough places of the stations, m; without them the distances tell.
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
        Fewer readings than unknowns, places that leave a freedom loose, or readings that fit no network.

    Notes
    -----
    Model of Takeuchi et al. (estimation of volumetric errors by a laser tracker), with dead paths free in place of
    L_j = |u_1 - U_j|, so that the noise of the first target stays its own.
    """
    problem = state_problem(displacement, target, noise, dead_path, extra, extra_prior)
    determinacy.refuse_too_few(problem.weight, int(np.count_nonzero(problem.precision == 0)))
    places = None if station is None else np.asarray(station, dtype=float)
    start = initial_stations(problem.reading, problem.weight, problem.nominal, places)
    stations = Stations(start.place, start.dead_path, np.zeros(len(problem.extra)))
    given = dead_path is not None
    if given:
        fixed = ~problem.free[3 : 4 * len(start.place) : 4]
        known = np.where(fixed, problem.prior[3 : 4 * len(start.place) : 4], stations.dead_path)
        stations = replace(stations, dead_path=known)
    state = descend(problem, stations, problem.nominal.copy(), tolerance)
    found, original = outliers.Found.none(problem.weight), problem.weight
    if robust and not state.sums.square < _HOPELESS**2 * problem.reading.size:
        # Gross ones have led it astray: without them, from the start.
        found = outliers.gross(problem.reading, original, problem.nominal, start.place, start.dead_path)
        problem = _without(problem, original, found)
        state = descend(problem, stations, problem.nominal.copy(), tolerance)
    network = conclude(problem, state, start.place)
    if robust:
        network, found = _without_wrong(problem, original, network, found, start.place, tolerance)
    notes = [
        *found.notes,
        *determinacy.without_place(network.weight, found.undecided),
        *determinacy.weak_layout(network.target_covariance, network.weight, network.station, network.target),
        *determinacy.weak_targets(network.target, network.target_covariance, network.station),
        *determinacy.swapped_stations(network.station, places),
    ]
    residual = network.residual
    for j, i in found.left_out:
        distance = np.linalg.norm(network.target[i] - network.station[j])
        model = distance - network.dead_path[j] + network.stations.value @ problem.extra[:, j, i]
        residual[j, i] = problem.reading[j, i] - model
    return replace(network, left_out=found.left_out, undecided=found.undecided, notes=tuple(notes))


def state_problem(
    displacement: ArrayLike,
    target: ArrayLike,
    noise: ArrayLike,
    dead_path: tuple[ArrayLike, ArrayLike] | None = None,
    extra: ArrayLike | None = None,
    extra_prior: ArrayLike | None = None,
) -> Problem:
    """Check shapes and values, and turn them into a problem."""
    d, u = np.asarray(displacement, dtype=float), np.array(target, dtype=float, order="C")
    if d.ndim != 2 or u.shape != (d.shape[1], 3):
        raise MethodError(
            f"expected displacements (station, target) and targets (target, 3), found {d.shape} and {u.shape}; "
            "give a row of displacements for every station and a place for every target"
        )
    n, m = d.shape
    if not np.isfinite(u).all():
        raise MethodError("expected a nominal place for every target, found NaN among them; leave such targets out")
    sigma = np.asarray(noise, dtype=float)
    if sigma.ndim == 1 and len(sigma) == n:
        sigma = sigma[:, None]
    if sigma.shape not in ((), (n, 1), (n, m)):
        raise MethodError(f"expected noise as one value, ({n},) or ({n}, {m}), found {sigma.shape}; say whose it is")
    known = np.isfinite(d)
    if not (np.broadcast_to(sigma, d.shape)[known] > 0).all():
        raise MethodError("expected a positive standard deviation for every reading; state the instrument's noise, m")
    weight = np.where(known, 1.0 / sigma, 0.0)
    # A target with fewer than three readings has no place.
    weight[:, np.count_nonzero(known, axis=0) < 3] = 0.0
    c = np.zeros((0, n, m)) if extra is None else np.nan_to_num(np.asarray(extra, dtype=float))
    if c.ndim != 3 or c.shape[1:] != d.shape:
        raise MethodError(f"expected further parameters as (k, {n}, {m}), found {c.shape}; give a value per reading")
    precision, prior = np.zeros((2, 4 * n + len(c)))
    if dead_path is not None:
        value, uncertainty = (np.broadcast_to(np.asarray(a, dtype=float), (n,)) for a in dead_path)
        with np.errstate(divide="ignore"):
            precision[3 : 4 * n : 4] = 1.0 / uncertainty**2
        prior[3 : 4 * n : 4] = np.where(np.isfinite(value), value, 0.0)
    if extra_prior is not None:
        precision[4 * n :] = 1.0 / np.broadcast_to(np.asarray(extra_prior, dtype=float), (len(c),)) ** 2
    reading = np.where(known, d, 0.0)
    return Problem(reading, weight, np.ascontiguousarray(c), precision, prior, u)


def descend(problem: Problem, stations: Stations, target: Array, tolerance: float) -> State:
    """Take steps until a further one would move no target by more than ``tolerance``; ``target`` is used up."""
    centre = problem.nominal.mean(axis=0)
    sums = problem.reduce(stations, target)
    mu, last, passes, converged = 0.0, np.inf, 1, False
    kept = target.copy()
    while passes < _PASSES:
        Z = problem.basis(stations, centre)
        step = _step(Z, sums, mu)
        trial = stations.stepped(step)
        found = problem.reduce(trial, target)
        passes += 1
        if not found.square <= sums.square * (1 + 1e-9) + 1e-6:
            target[:] = kept
            mu = max(10 * mu, _DAMPED)
            if mu > 1e8:
                break
            continue
        stations, sums, mu = trial, found, (0.1 * mu if mu > _UNDAMPED else 0.0)
        kept[:] = target
        # Steps shrink at least as fast as they have: the next one is this one times their ratio.
        ahead = found.moved * min(1.0, found.moved / last) if last < np.inf else np.inf
        last = found.moved
        # What no longer shrinks and is far below any noise is rounding.
        converged = mu == 0.0 and (ahead < tolerance or (passes > _LONG and found.moved < 1e-10))
        if converged:
            break
    return State(stations, kept, sums, passes, converged)


def _step(Z: Array, sums: Sums, mu: float) -> Array:
    """Return the step of the stations' parameters within the columns of Z, damped by mu."""
    A, b = Z.T @ sums.H @ Z, Z.T @ sums.h
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-30 * np.trace(A) + 1e-300))
    A = A * np.outer(scale, scale) + mu * np.eye(len(A))
    step: Array = Z @ (scale * np.linalg.lstsq(A, scale * b, rcond=1e-15)[0])
    return step


def _vector(stations: Stations) -> Array:
    """Return the parameters (4 n + k,) of the stations."""
    return np.concatenate([np.column_stack([stations.place, stations.dead_path]).ravel(), stations.value])


def _without(problem: Problem, original: Array, found: outliers.Found) -> Problem:
    """Return the problem without readings that were found wrong; ``original`` are the weights (n, m) of all."""
    weight = found.applied(original)
    # A target with fewer than three readings has no place.
    weight[:, np.count_nonzero(weight, axis=0) < 3] = 0.0
    determinacy.refuse_too_few(weight, int(np.count_nonzero(problem.precision == 0)))
    return replace(problem, weight=weight)


def _without_wrong(
    problem: Problem, original: Array, network: Network, found: outliers.Found, rough: Array, tolerance: float
) -> tuple[Network, outliers.Found]:
    """Leave wrong readings out, the grossest first, until none is left."""
    for _ in range(_ROUNDS):
        now = outliers.search(network, original, problem.nominal, found)
        if now == found:
            break
        found = now
        problem = _without(problem, original, found)
        target = np.where(np.isfinite(network.target), network.target, problem.nominal)
        state = descend(problem, network.stations, target, tolerance)
        network = conclude(problem, replace(state, passes=state.passes + network.iterations), rough)
    return network, found


def conclude(problem: Problem, state: State, rough: Array) -> Network:
    """Bring a solution into the datum and return it with its covariances; ``rough`` (n, 3) are rough stations."""
    used = np.count_nonzero(problem.weight, axis=0) >= 3
    stations, target, R = fitted(state.stations, state.target, problem.nominal, used)
    centre = target[used].mean(axis=0)
    Z = problem.basis(stations, centre)
    sums = state.sums.turned(R)
    GG, GDG, GF = datum_sums(problem.weight, stations.place, problem.extra, target, centre)
    determinacy.refuse_flat(round(GG[0, 0]), rough, target[used])
    H: Array = np.asarray(np.linalg.inv(GG), dtype=np.float64)
    T = stations.motions(centre)
    information = Z.T @ sums.H @ Z
    values = determinacy.refuse_loose(information, Z - T @ (H @ GF @ Z), stations, target[used], rough)
    W = Z @ np.linalg.inv(np.linalg.cholesky(information)).T
    datum = Datum(centre, W, H @ GF @ W, H, H @ GDG @ H)
    covariance, residual, redundancy = examine(
        problem.reading, problem.weight, stations.place, stations.dead_path, problem.extra, stations.value, target,
        datum.centre, W, datum.shift, datum.H, datum.K,
    )  # fmt: skip
    F = W - T @ datum.shift
    joint = F @ F.T + T @ datum.K @ T.T
    known = int(np.count_nonzero(problem.free & (problem.precision > 0)))
    freedom = int(np.count_nonzero(problem.weight)) + known - 3 * int(np.count_nonzero(used)) - W.shape[1]
    target[~np.isfinite(covariance[:, 0, 0])] = np.nan
    sigma0 = float(np.sqrt(sums.square / freedom)) if freedom > 0 else np.nan
    return Network(
        target, stations, covariance, joint, residual, redundancy, problem.weight, (), (), sigma0, freedom,
        state.passes, state.converged, float(values[-1] / values[0]), (), problem.extra, datum,
    )  # fmt: skip
