"""Gauss-Newton of warm blocks on the cold surface, with random effects of every line.

A warm block at P = M p has the residual r = Z - S(X, Y). For a small further twist at a centre c, (X, Y, Z) = P - c,

    dr = (-Sx, -Sy, 1, Y + Sy Z, -X - Sx Z, Sx Y - Sy X) . (EX, EY, EZ, EA, EB, EC) = J . twist .

Sx and Sy are the slopes of the warm block itself, turned by M. Slopes and mean of a block have independent noise, and
the cold scan's noise is in neither: J^T r then has no bias, which it has when both come from one noisy map.

A line sensor shakes from profile to profile: row i has r = J twist + a_i + b_i Sy + noise, a_i the jitter along z and
b_i that along y. Both columns (1 and Sy) are in J already, so a row's sums say all: with C = U^T W U, u = U^T W r,
T = diag(tau_a, tau_b) and k the variance of a residual in units of 1 / W,

    K = T (k 1 + T C T)^-1 T,   H = sum(A - B K B^T),   h = sum(g - B K u),   effects = K u,   their covariance k K .

Variances of the effects by expectation and maximisation: tau^2 = mean(effect^2 + k K).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from errormotion.kinematics import poses
from errormotion.methods.crossbeam_scan.registration import kernels
from errormotion.methods.crossbeam_scan.registration.blocks import BlockMap
from errormotion.methods.crossbeam_scan.registration.extra import Extra
from errormotion.methods.crossbeam_scan.registration.freedoms import scales

Array = NDArray[np.float64]

NONE = Extra.of(None)
LINE = [2, 1]
"""Columns of J that are the line effects: 1 and, but for its sign, Sy."""
LAGS = 2
_NEIGHBOURS = (2 * LAGS + 1) ** 2
_EM_STEPS = 25
_FEW = 10000
# What a cubic cardinal spline leaves of white noise is 1 - 1.27 t (1 - t) at t between two nodes, to 0.01.
_GAIN = 1.27


@dataclass(frozen=True)
class Problem:
    """Warm blocks, the cold surface, and the point about which poses are varied."""

    stack: Array
    x: Array
    y: Array
    cold: BlockMap
    centre: Array
    extra: Extra = NONE

    @classmethod
    def of(cls, cold: BlockMap, warm: BlockMap, step: int = 1, extra: Extra = NONE) -> Problem:
        """Return the problem with every ``step``-th warm block along both directions; its centre is the cold one's."""
        some = slice(step // 2, None, step)
        maps = (warm.height, warm.slope_x, warm.slope_y, warm.variance)
        x, y = warm.x[some].copy(), warm.y[some].copy()
        return cls(np.stack([z[some, some] for z in maps]), x, y, cold, cold.centre, extra)

    @property
    def rest(self) -> State:
        """No motion."""
        return State(RigidTransform.identity(), np.zeros(len(self.extra.names)))

    def evaluate(self, state: State | RigidTransform, gate: float = np.inf) -> Sums:
        """Return residuals and sums at a state; blocks further off than ``gate`` (m) are left out of the sums."""
        matrix, normal, bases = self.map(state)
        n = 6 + len(bases)
        residual = np.empty(self.stack.shape[1:])
        rows = np.empty((len(self.y), n * n + n + 3))
        surface = self.cold.surface
        kernels.accumulate(
            self.stack, self.x, self.y, matrix, normal, self.centre, bases, surface.coefficients, self.cold.variance,
            surface.grid, gate, residual, rows,
        )  # fmt: skip
        A, g = rows[:, : n * n].reshape(-1, n, n), rows[:, n * n : n * n + n]
        return Sums(residual, A, g, *rows[:, n * n + n :].T)

    def map(self, state: State | RigidTransform) -> tuple[Array, Array, Array]:
        """Return what takes warm points to the cold frame (3, 4), what takes normals (3, 3), and the extra bases."""
        if isinstance(state, RigidTransform):
            matrix = np.ascontiguousarray(np.asarray(state.as_matrix(), dtype=float)[:3])
            return matrix, matrix[:, :3].copy(), NONE.bases
        matrix, normal, _ = self.map(state.pose)
        if len(state.values):
            stretch = self.extra.stretch(state.values)
            matrix = stretch @ matrix
            matrix[:, 3] += self.centre - stretch @ self.centre
            normal = np.asarray(np.linalg.inv(matrix[:, :3]).T, dtype=float)
        return np.ascontiguousarray(matrix), np.ascontiguousarray(normal), self.extra.bases

    def moved(self, pose: RigidTransform, step: Array) -> RigidTransform:
        """Return the pose after a further twist (6,) at the centre."""
        return poses.displaced(step, self.centre) * pose

    def stepped(self, state: State, step: Array) -> State:
        """Return the state after a further twist at the centre and extra values, (6 + k,)."""
        return State(self.moved(state.pose, step[:6]), state.values + step[6:])

    def equations(self, sums: Sums, noise: Noise, state: State) -> tuple[Array, Array]:
        """Return information and gradient of twist and extra parameters, with their priors, in units of 1 / k."""
        H, h = normal_equations(sums, noise)
        if len(state.values):
            weight = noise.k / self.extra.prior**2
            H[range(6, len(H)), range(6, len(H))] += weight
            h[6:] += weight * state.values
        return H, h


@dataclass(frozen=True)
class State:
    """Where the warm scan is thought to be: a warm point p is at c + stretch (M p - c), c the problem's centre."""

    pose: RigidTransform
    values: Array


@dataclass(frozen=True)
class Sums:
    """Residuals at a pose, and for every row of blocks A = J^T W J, g = J^T W r, r^T W r, blocks, t (1 - t)."""

    residual: Array
    A: Array
    g: Array
    square: Array
    count: Array
    between: Array

    @property
    def used(self) -> int:
        """Blocks in the sums."""
        return int(self.count.sum())

    def scale(self) -> float:
        """Return the robust standard deviation of the residuals about zero, m; infinite where there are none."""
        flat = self.residual.reshape(-1)
        some = flat[:: max(1, flat.size // _FEW)]
        known = some[np.isfinite(some)]
        return float(1.4826 * np.median(np.abs(known))) if known.size else np.inf


@dataclass(frozen=True)
class Noise:
    """Stochastic part of the model: k, and the standard deviations of the line effects along z and y, m."""

    k: float = 1.0
    tau: tuple[float, float] = (0.0, 0.0)

    def gains(self, A: Array) -> Array:
        """Return K of every row, (row, 2, 2)."""
        T = np.diag(self.tau)
        C = A[:, LINE][:, :, LINE]
        K: Array = T @ np.linalg.solve(self.k * np.eye(2) + T @ C @ T, np.broadcast_to(T, C.shape))
        return K


def normal_equations(sums: Sums, noise: Noise) -> tuple[Array, Array]:
    """Return information H (n, n) and gradient h (n,), line effects eliminated, in units of 1 / k."""
    if not any(noise.tau):
        return sums.A.sum(axis=0), sums.g.sum(axis=0)
    K = noise.gains(sums.A)
    B = sums.A[:, :, LINE]
    BK = B @ K
    H = sums.A - BK @ B.transpose(0, 2, 1)
    h = sums.g - np.einsum("rij,rj->ri", BK, sums.g[:, LINE])
    return H.sum(axis=0), h.sum(axis=0)


def solve(H: Array, h: Array, motions: Array, radius: float) -> Array:
    """Return the step -H^-1 h (n,) that stays out of undetermined motions (6, k); ``radius`` scales what turns."""
    scale = scales(radius, len(h) - 6)
    step: Array = -scale * (inverse(H * np.outer(scale, scale), motions) @ (scale * h))
    return step


def inverse(H: Array, motions: Array) -> Array:
    """Return the inverse of a scaled information (n, n) within the motions (6, k) that are determined."""
    if motions.shape[1] == 0:
        return np.asarray(np.linalg.inv(H), dtype=float)
    basis = np.eye(len(H))[:, motions.shape[1] :]
    basis[:6, : 6 - motions.shape[1]] = np.linalg.svd(motions)[0][:, motions.shape[1] :]
    C: Array = basis @ np.linalg.inv(basis.T @ H @ basis) @ basis.T
    return C


def estimate_noise(problem: Problem, state: State, sums: Sums, gate: float, line_effects: bool = True) -> Noise:
    """Estimate k and the line effects from the residuals at the solution.

    The covariance needs the noise of slow patterns. Between two nodes the spline averages the cold noise, and
    neighbours share speckle: so k is the sum of the covariances of neighbouring residuals, up to two blocks apart, and
    the variances of the lines are raised by what the spline has averaged away.
    """
    weight, slope = _weights(problem, state, sums, gate)
    normalised = np.where(weight > 0, sums.residual, 0.0) * np.sqrt(weight)
    fitted = sums.A.shape[1]
    k = _long_run(normalised, weight > 0, fitted)
    tau = np.zeros(2)
    rows = sums.count >= 3
    C, u = sums.A[rows][:, LINE][:, :, LINE], sums.g[rows][:, LINE]
    if line_effects and np.count_nonzero(rows) >= 8:
        # Independent columns: the part of Sy that is no constant.
        ridge = C + 1e-9 * np.trace(C, axis1=1, axis2=2)[:, None, None] * np.eye(2)
        effects = np.linalg.solve(ridge, u[..., None])[..., 0]
        significant = _significant(effects, ridge, k, sums.used)
        if significant:
            white = np.sqrt(np.mean(np.linalg.inv(ridge).diagonal(axis1=1, axis2=2), axis=0))
            tau = np.maximum(np.sqrt(np.mean(effects**2, axis=0)), np.sqrt(k) * white)
            for _ in range(2):
                tau = _maximised(C, u, k, tau)
                noise = Noise(k, (float(tau[0]), float(tau[1])))
                effect = np.einsum("rij,rj->ri", noise.gains(sums.A), sums.g[:, LINE])
                rest = sums.residual - effect[:, :1] + effect[:, 1:] * slope
                k = _long_run(np.where(weight > 0, rest, 0.0) * np.sqrt(weight), weight > 0, fitted)
    # Half of the jitter is the cold scan's, of which the spline shows only a part.
    averaged = 1.0 - _GAIN * float(sums.between.sum() / max(sums.count.sum(), 1))
    tau = tau * np.sqrt(2.0 / (1.0 + averaged))
    return Noise(k, (float(tau[0]), float(tau[1])))


def _maximised(C: Array, u: Array, k: float, tau: Array) -> Array:
    """Return the standard deviations of the line effects after some steps of expectation and maximisation."""
    for _ in range(_EM_STEPS):
        T = np.diag(tau)
        K = T @ np.linalg.solve(k * np.eye(2) + T @ C @ T, np.broadcast_to(T, C.shape))
        effects = np.einsum("rij,rj->ri", K, u)
        tau = np.sqrt(np.mean(effects**2 + k * K.diagonal(axis1=1, axis2=2), axis=0))
    return tau


def _significant(effects: Array, C: Array, k: float, blocks: int) -> bool:
    """Return whether lines differ by more than the noise of their blocks: chi squared, four standard deviations."""
    chi2 = np.einsum("ri,rij,rj->", effects, C, effects) / k
    freedoms = effects.size
    of_k = freedoms**2 * 2 * _NEIGHBOURS / max(blocks, 1)
    return bool(chi2 > freedoms + 4 * np.sqrt(2 * freedoms + of_k))


def _weights(problem: Problem, state: State, sums: Sums, gate: float) -> tuple[Array, Array]:
    """Return the blocks' weights, 0 where a block is not in the sums, and Sy with the sign of J's second column."""
    known = np.isfinite(sums.residual) & (np.abs(sums.residual) < gate)
    variance = np.where(known, problem.stack[3], np.inf)
    cold = problem.cold.usual_variance
    _, R, _ = problem.map(state)
    normal = [-R[i, 0] * problem.stack[1] - R[i, 1] * problem.stack[2] + R[i, 2] for i in (1, 2)]
    return np.where(known, 1.0 / (variance + cold), 0.0), -normal[0] / normal[1]


def _long_run(r: Array, known: NDArray[np.bool_], fitted: int) -> float:
    """Return the sum of covariances of r with its neighbours up to LAGS blocks away; zeros stand where not known."""
    n, m = r.shape
    total = 0.0
    for i in range(LAGS + 1):
        for j in range(-LAGS, LAGS + 1):
            if i == 0 and j < 0:
                continue
            left, right = slice(max(0, -j), m - max(0, j)), slice(max(0, j), m - max(0, -j))
            pairs = max(int(np.count_nonzero(known[: n - i, left] & known[i:, right])), 1)
            covariance = float(np.sum(r[: n - i, left] * r[i:, right])) / pairs
            total += covariance if i == j == 0 else 2 * covariance
    count = max(int(np.count_nonzero(known)), 1)
    alone = float(np.sum(r * r)) / count
    # The fit has taken its parameters' share out of every block and each of its neighbours. Too few blocks make the sum
    # uncertain; it is never far below the variance itself.
    return max(total / max(1.0 - _NEIGHBOURS * fitted / count, 0.5), 0.5 * alone)
