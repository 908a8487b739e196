"""Gauss-Newton of warm blocks on the cold surface, with random effects of every line.

A warm block at P = M p has the residual r = Z - S(X, Y). For a small further twist at a centre c, (X, Y, Z) = P - c,

    dr = (-Sx, -Sy, 1, Y + Sy Z, -X - Sx Z, Sx Y - Sy X) . (EX, EY, EZ, EA, EB, EC) = J . twist .

Sx and Sy are the slopes of the warm block itself, turned by M. Slopes and mean of a block have independent noise, and
the cold scan's noise is in neither: J^T r then has no bias, which it has when both come from one noisy map.

A line sensor shakes from profile to profile: row i has r = J twist + a_i + b_i Sy + noise, a_i the jitter along z and
b_i that along y. Both columns (1 and Sy) are in J already, so the sums of a row suffice: with C = U^T W U, u = U^T W r,
T = diag(tau_a, tau_b) and k the variance of a residual in units of 1 / W,

    K = T (k 1 + T C T)^-1 T,   H = sum(A - B K B^T),   h = sum(g - B K u),   effects = K u,   their covariance k K .

Variances of the effects by expectation and maximisation: tau^2 = mean(effect^2 + k K).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from errormotion.arrays import Array
from errormotion.estimation.robust import NORMAL_MAD
from errormotion.methods.crossbeam_scan.identification.registration.blocks import BlockMap, some_of, upper_median
from errormotion.methods.crossbeam_scan.identification.registration.comparison import compare, lag_sums
from errormotion.methods.crossbeam_scan.identification.registration.freedoms import Extra, scales

NONE = Extra.of(None)
LINE = [2, 1]
"""Columns of J that are the line effects: 1 and, but for its sign, Sy."""
LAGS = 2
_NEIGHBOURS = (2 * LAGS + 1) ** 2
_EM_STEPS = 25
_FEW = 4000
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

    def at(self, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> Problem:
        """Return the problem with the warm blocks of some rows and columns."""
        stack = np.ascontiguousarray(self.stack[:, rows[:, None], columns])
        return replace(self, stack=stack, x=self.x[columns], y=self.y[rows])

    @property
    def rest(self) -> State:
        """No motion."""
        return State(np.eye(3, 4), np.zeros(len(self.extra.names)))

    def evaluate(self, state: State, gate: float = np.inf) -> Sums:
        """Return residuals and sums at a state; blocks further off than ``gate`` (m) are left out of the sums."""
        matrix, normal = self.map(state)
        n = 6 + len(self.extra.bases)
        residual, weight, rows = compare(
            self.stack, self.x, self.y, matrix, normal, self.centre, self.extra.bases, self.cold.surface.coefficients,
            self.cold.variance, self.cold.surface.grid, gate, self.cold.compiled,
        )  # fmt: skip
        A, g = rows[:, : n * n].reshape(-1, n, n), rows[:, n * n : n * n + n]
        return Sums(residual, weight, A, g, *rows[:, n * n + n :].T)

    def after(self, state: State, sums: Sums, step: Array) -> Sums:
        """Return the sums at a state after a step (6 + k,) so short that residuals change in proportion."""
        matrix, normal = self.map(state)
        height, slope_x, slope_y = self.stack[:3].reshape(3, -1)
        x, y = (each.ravel() for each in np.meshgrid(self.x, self.y))
        points = matrix[:, :3] @ np.stack([x, y, height]) + (matrix[:, 3] - self.centre)[:, None]
        turned = normal @ np.stack([-slope_x, -slope_y, np.ones_like(x)])
        moved = np.tensordot(step, self.extra.motions[: len(step)], 1)
        shift = moved[:, 1:] @ points + moved[:, :1]
        change = np.sum(turned * shift, axis=0) / turned[2]
        sums.residual[:] += change.reshape(sums.residual.shape)
        along = sums.A @ step
        return replace(sums, g=sums.g + along, square=sums.square + (2 * sums.g + along) @ step)

    def map(self, state: State) -> tuple[Array, Array]:
        """Return what takes warm points to the cold frame (3, 4), and what takes normals (3, 3)."""
        if not state.values.any():
            return state.matrix, np.ascontiguousarray(state.matrix[:, :3])
        stretch = self.extra.stretch(state.values)
        matrix = stretch @ state.matrix
        matrix[:, 3] += self.centre - stretch @ self.centre
        return matrix, np.ascontiguousarray(np.linalg.inv(matrix[:, :3]).T, dtype=float)

    def stepped(self, state: State, step: Array) -> State:
        """Return the state after a further twist at the centre and extra values, (6 + k,), or after a twist (6,)."""
        turn = Rotation.from_rotvec(step[3:6]).as_matrix()
        matrix = turn @ state.matrix
        matrix[:, 3] += step[:3] + self.centre - turn @ self.centre
        return State(matrix, state.values + step[6:] if len(step) > 6 else state.values)

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
    """Estimated pose of the warm scan: a warm point p is at c + stretch (M p - c), c the problem's centre."""

    matrix: Array
    """M, (3, 4)."""
    values: Array

    @classmethod
    def of(cls, pose: RigidTransform, extra: int = 0) -> State:
        """Return the state of a pose, extra values 0."""
        return cls(np.array(pose.as_matrix()[:3], dtype=float, order="C"), np.zeros(extra))

    @property
    def pose(self) -> RigidTransform:
        """M."""
        return RigidTransform.from_matrix(np.vstack([self.matrix, [0.0, 0.0, 0.0, 1.0]]))

    @property
    def turn(self) -> float:
        """Angle of the rotation, rad."""
        return float(self.pose.rotation.magnitude())


@dataclass(frozen=True)
class Sums:
    """Residuals at a pose, their weights W, and of every row A = J^T W J, g = J^T W r, r^T W r, blocks, t (1 - t)."""

    residual: Array
    weight: Array
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
        scale = NORMAL_MAD * upper_median(np.abs(some_of(self.residual, _FEW)))
        return scale if scale == scale else np.inf


@dataclass(frozen=True)
class Noise:
    """Stochastic part of the model: k, and the standard deviations of the line effects along z and y, m."""

    k: float = 1.0
    tau: tuple[float, float] = (0.0, 0.0)

    def gains(self, A: Array) -> Array:
        """Return K of every row, (row, 2, 2)."""
        (first, last), mixed = line_gain(*_parts(A[:, LINE][:, :, LINE]), self.k, np.array(self.tau))
        return np.stack([np.stack([first, mixed], axis=-1), np.stack([mixed, last], axis=-1)], axis=-1)


def line_gain(own: Array, mixed: Array, k: float, tau: Array) -> tuple[Array, Array]:
    """Return K00 and K11 (2, line), and K01 (line,), of lines with C00 and C11 ``own`` and C01 ``mixed``.

    K takes the sums of a line to its effects; T = diag(tau).
    """
    squares = (tau * tau)[:, None]
    increased, between = k + squares * own, tau[0] * tau[1] * mixed
    determinant = increased[0] * increased[1] - between * between
    return squares * increased[::-1] / determinant, -tau[0] * tau[1] * between / determinant


def _parts(C: Array) -> tuple[Array, Array]:
    """Return the diagonals (2, line) and the other elements (line,) of symmetrical matrices (line, 2, 2)."""
    return np.ascontiguousarray(C[:, [0, 1], [0, 1]].T), C[:, 0, 1].copy()


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


def estimate_noise(problem: Problem, state: State, sums: Sums, line_effects: bool, before: Noise) -> Noise:
    """Estimate k and the line effects from the residuals at the solution.

    ``before`` is the noise by which this solution was found. If it has line effects, they are in the residuals but not
    in its k, by which they are compared with the noise of the blocks: the k of all residuals would contain them.

    The covariance needs the noise of slow patterns. Between two nodes the spline averages the cold noise, and
    neighbours share speckle: so k is the sum of the covariances of neighbouring residuals, up to two blocks apart, and
    the variances of the lines are raised by what the spline has averaged away.
    """
    fitted = sums.A.shape[1]
    k = _long_run(sums.residual, sums.weight, fitted)
    rows = sums.count >= 3
    if not line_effects or np.count_nonzero(rows) < 8:
        return Noise(k)
    C, u = sums.A[rows][:, LINE][:, :, LINE], sums.g[rows][:, LINE]
    # Independent columns: the part of Sy that is no constant.
    ridge = C + 1e-9 * np.trace(C, axis1=1, axis2=2)[:, None, None] * np.eye(2)
    effects = np.linalg.solve(ridge, u[..., None])[..., 0]
    if not _significant(effects, ridge, before.k if any(before.tau) else k, sums.used):
        return Noise(k)
    white = np.sqrt(np.mean(np.linalg.inv(ridge).diagonal(axis1=1, axis2=2), axis=0))
    tau = np.maximum(np.sqrt(np.mean(effects**2, axis=0)), np.sqrt(k) * white)
    slope = _slope(problem, state)
    for _ in range(2):
        tau = _maximised(C, u, k, tau)
        noise = Noise(k, (float(tau[0]), float(tau[1])))
        gains = noise.gains(sums.A)
        effect = np.einsum("rij,rj->ri", gains, sums.g[:, LINE])
        taken = float(np.mean(np.einsum("rij,rji->r", gains[rows], C) / sums.count[rows]))
        k = _long_run(sums.residual - effect[:, :1] + effect[:, 1:] * slope, sums.weight, fitted, taken)
    # Half of the jitter is the cold scan's, of which the spline shows only a part.
    averaged = 1.0 - _GAIN * float(sums.between.sum() / max(sums.count.sum(), 1))
    tau = tau * np.sqrt(2.0 / (1.0 + averaged))
    return Noise(k, (float(tau[0]), float(tau[1])))


def _maximised(C: Array, u: Array, k: float, tau: Array) -> Array:
    """Return the standard deviations of the line effects after some steps of expectation and maximisation."""
    own, mixed = _parts(C)
    sums = np.ascontiguousarray(u.T)
    for _ in range(_EM_STEPS):
        gain, cross = line_gain(own, mixed, k, tau)
        effects = gain * sums + cross * sums[::-1]
        tau = np.sqrt((effects**2 + k * gain).sum(axis=1) / len(u))
    return tau


def _significant(effects: Array, C: Array, k: float, blocks: int) -> bool:
    """Return whether lines differ by more than the noise of their blocks: chi squared, four standard deviations."""
    chi2 = np.einsum("ri,rij,rj->", effects, C, effects) / k
    freedoms = effects.size
    of_k = freedoms**2 * 2 * _NEIGHBOURS / max(blocks, 1)
    return bool(chi2 > freedoms + 4 * np.sqrt(2 * freedoms + of_k))


def _slope(problem: Problem, state: State) -> Array:
    """Return Sy of the blocks with the sign of J's second column."""
    _, R = problem.map(state)
    y, z = (-R[i, 0] * problem.stack[1] - R[i, 1] * problem.stack[2] + R[i, 2] for i in (1, 2))
    slope: Array = -y / z
    return slope


def _long_run(residual: Array, weight: Array, fitted: int, of_line: float = 0.0) -> float:
    """Return the sum of covariances of the normalised residuals with their neighbours up to LAGS blocks away.

    ``fitted`` parameters have been taken out of all blocks, and line effects the share ``of_line`` out of each line.
    """
    sums, pairs = lag_sums(residual, weight, LAGS)
    covariance = sums / np.maximum(pairs, 1.0)
    count, alone = float(pairs[0, LAGS]), float(covariance[0, LAGS])
    total = float(2 * covariance[1:].sum() + covariance[0].sum())
    # The fit has taken its parameters' share out of every block and each of its neighbours, the line effects theirs out
    # of the neighbours in line. Too few blocks make the sum uncertain; it is never far below the variance itself.
    left = 1.0 - _NEIGHBOURS * fitted / max(count, 1.0) - (2 * LAGS + 1) * of_line
    return max(total / max(left, 0.5), 0.5 * alone)
