"""Statement of the problem: readings, their weights, and prior knowledge of the stations' parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.multilateration.network import target_sums
from errormotion.methods.multilateration.network.model import Stations


@dataclass(frozen=True)
class Problem:
    """Readings, their weights, and prior knowledge of the stations' parameters.

    Attributes
    ----------
    reading, weight : ndarray (n, m)
        m, NaN where there is none, and 1 / standard deviation, 1/m, 0 for readings that are not used.
    extra : ndarray (k, n, m)
        Derivatives of the readings by further parameters.
    precision : ndarray (4 n + k,)
        1 / variance of the prior value of each parameter; infinite for a fixed parameter, 0 for an unknown one.
    prior : ndarray (4 n + k,)
        Prior values; used only where the precision is not 0.
    nominal : ndarray (m, 3)
        Nominal targets, m: the datum.
    centre : ndarray (3,)
        Their mean, m.
    by_target, by_station : ndarray (m,), (n,)
        Number of readings used.
    """

    reading: Array
    weight: Array
    extra: Array
    precision: Array
    prior: Array
    nominal: Array
    centre: Array
    by_target: NDArray[np.int64]
    by_station: NDArray[np.int64]

    @cached_property
    def free(self) -> NDArray[np.bool_]:
        """Parameters that are estimated."""
        return np.isfinite(self.precision)

    @cached_property
    def known(self) -> bool:
        """Whether an estimated parameter has a prior value."""
        return bool((self.free & (self.precision > 0)).any())

    @property
    def unknown(self) -> int:
        """Number of parameters without prior value."""
        return int(np.count_nonzero(self.precision == 0))

    def weighted(self, weight: Array) -> Problem:
        """Return the problem with other weights (n, m); a target with fewer than three readings has no position."""
        weight[:, target_sums.count(weight)[0] < 3] = 0.0
        by_target, by_station = target_sums.count(weight)
        return replace(self, weight=weight, by_target=by_target, by_station=by_station)

    def sample(self, every: int) -> Problem:
        """Return the problem of every ``every``-th target."""
        part = slice(every // 2, None, every)
        reading, weight = (np.ascontiguousarray(a[:, part]) for a in (self.reading, self.weight))
        extra = np.ascontiguousarray(self.extra[:, :, part])
        by_target, by_station = target_sums.count(weight)
        return replace(
            self, reading=reading, weight=weight, extra=extra, nominal=self.nominal[part].copy(),
            by_target=by_target, by_station=by_station,
        )  # fmt: skip

    def basis(self, stations: Stations, centre: Array) -> Array:
        """Return orthonormal columns (4 n + k, p) that span the free parameters without the rigid motions."""
        return stations.complement(centre, self.free)

    def reduce(self, stations: Stations, position: Array) -> Sums:
        """Move the targets (3, m) in place and return their sums for the stations."""
        sums, moved = target_sums.reduce_targets(
            self.reading, self.weight, stations.position, stations.dead_path, self.extra, stations.value, position
        )
        H, h, square = sums[:-1, :-1].copy(), sums[:-1, -1].copy(), float(sums[-1, -1])
        if self.known:
            known = self.free & (self.precision > 0)
            off = np.where(known, self.prior - stations.vector, 0.0)
            weight = np.where(known, self.precision, 0.0)
            H += np.diag(weight)
            h += weight * off
            square += float(weight @ off**2)
        return Sums(H, h, square, moved)


@dataclass(frozen=True)
class Sums:
    """Information H, gradient h, sum of squares, and the largest displacement of a target, m."""

    H: Array
    h: Array
    square: float
    moved: float


def state_problem(
    displacement: ArrayLike,
    target: ArrayLike,
    noise: ArrayLike,
    dead_path: tuple[ArrayLike, ArrayLike] | None = None,
    extra: ArrayLike | None = None,
    extra_prior: ArrayLike | None = None,
) -> Problem:
    """Return the problem stated by arguments of `solver.solve`; raise MethodError for wrong shapes or values."""
    d, u = np.asarray(displacement, dtype=float), np.asarray(target, dtype=float)
    if d.ndim != 2 or u.shape != (d.shape[1], 3):
        raise MethodError(
            f"Expected displacements (station, target) and targets (target, 3); found {d.shape} and {u.shape}. "
            "State a row of displacements for every station and a position for every target."
        )
    n, m = d.shape
    u, centre = target_sums.copied(np.ascontiguousarray(u))
    if not np.isfinite(centre).all():
        raise MethodError("Expected a nominal position for every target; found NaN. Remove such targets.")
    sigma = np.asarray(noise, dtype=float)
    if sigma.ndim == 1 and len(sigma) == n:
        sigma = sigma[:, None]
    if sigma.shape not in ((), (n, 1), (n, m)):
        raise MethodError(
            f"Expected the noise as one value, ({n},) or ({n}, {m}); found {sigma.shape}. State it for all readings, "
            "each station, or each reading."
        )
    sigma = np.ascontiguousarray(np.broadcast_to(sigma, (n, 1)) if sigma.ndim == 0 else sigma)
    reading, weight, positive = target_sums.weigh(np.ascontiguousarray(d), sigma)
    by_target, by_station = target_sums.count(weight)
    if not positive:
        raise MethodError("Expected a positive standard deviation of every reading. State the instrument's noise, m.")
    c = np.zeros((0, n, m)) if extra is None else np.nan_to_num(np.asarray(extra, dtype=float))
    if c.ndim != 3 or c.shape[1:] != d.shape:
        raise MethodError(f"Expected further parameters as (k, {n}, {m}); found {c.shape}. State a value per reading.")
    precision, prior = np.zeros((2, 4 * n + len(c)))
    if dead_path is not None:
        value, uncertainty = (np.broadcast_to(np.asarray(a, dtype=float), (n,)) for a in dead_path)
        with np.errstate(divide="ignore"):
            precision[3 : 4 * n : 4] = 1.0 / uncertainty**2
        prior[3 : 4 * n : 4] = np.where(np.isfinite(value), value, 0.0)
    if extra_prior is not None:
        precision[4 * n :] = 1.0 / np.broadcast_to(np.asarray(extra_prior, dtype=float), (len(c),)) ** 2
    return Problem(reading, weight, np.ascontiguousarray(c), precision, prior, u, centre, by_target, by_station)
