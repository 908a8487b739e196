"""The registration of two block maps: its result, where it starts, and the choice of its backend."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from errormotion.arrays import Array
from errormotion.datasets import DOF
from errormotion.errors import MethodError
from errormotion.estimation.robust import scale_about_zero
from errormotion.kinematics import poses
from errormotion.methods.crossbeam_scan.identification.registration.blocks import THIN, BlockMap
from errormotion.methods.crossbeam_scan.identification.registration.freedoms import (
    Extra,
    Freedoms,
    freedoms,
    refuse,
    scales,
)
from errormotion.methods.crossbeam_scan.identification.registration.kernels.planes import ROWS
from errormotion.methods.crossbeam_scan.identification.registration.solver import (
    Noise,
    Problem,
    State,
    Sums,
    estimate_noise,
    inverse,
    normal_equations,
    solve,
)


@dataclass(frozen=True)
class Registration:
    """Pose of the warm scan's frame in the cold scan's frame, with its covariance.

    Attributes
    ----------
    backend : str
        The backend that was used.
    pose : RigidTransform
        M: takes a point from the warm frame to the cold one. Extra parameters come after it and leave ``point``
        where it is: p of the warm frame is at ``point`` + (1 + sum e G) (M p - ``point``) of the cold one.
    point : ndarray (3,)
        Functional point of twist and covariance, in profiler coordinates, m.
    covariance : ndarray (6, 6)
        Of the twist at ``point``, m^2, m rad, rad^2; NaN for freedoms that the artefact does not determine, and all
        NaN where a backend gives none.
    residual : ndarray (block row, block column)
        Distance of the warm blocks from the cold surface along z, m; NaN where there is none. Empty for clouds.
    x, y : ndarray
        Centres of the blocks in the warm frame, m.
    rms : float
        Root mean square of the residuals of the backend, m. It gives no information about the accuracy of the pose.
    points : int
        Points used of the warm scan.
    noise : tuple of float
        Standard deviation of a point about the surface, cold and warm, m.
    line_jitter : tuple of float
        Standard deviation, both scans together, of a profile's shift along z and along y, m; 0 where none shows.
    condition : float
        Of the information, rotations scaled by the artefact's radius.
    loose : tuple of str
        Freedoms that the artefact does not determine.
    iterations : int
        Steps taken.
    extra_names : tuple of str
        Further parameters that were estimated.
    extra : ndarray (k,)
        Their values: each displaces a point P of the cold frame by its matrix times (P - ``point``).
    joint_covariance : ndarray (6 + k, 6 + k)
        Of the twist at ``point`` and the further parameters; ``covariance`` is its first block.
    cold_share : float
        Share of the covariance that comes from the noise of the cold scan, which all warm scans registered onto it have
        in common.
    """

    backend: str
    pose: RigidTransform
    point: Array
    covariance: Array
    residual: Array
    x: Array
    y: Array
    rms: float
    points: int
    noise: tuple[float, float]
    line_jitter: tuple[float, float]
    condition: float
    loose: tuple[str, ...]
    iterations: int
    extra_names: tuple[str, ...]
    extra: Array
    joint_covariance: Array
    cold_share: float
    variance_factor: float = 1.0

    @property
    def twist(self) -> Array:
        """How the profiler moved: (EX, EY, EZ, EA, EB, EC) at ``point``, m and rad."""
        return poses.displacement(self.pose, self.point)

    @property
    def sigma(self) -> Array:
        """Standard uncertainties of the twist, (6,), m and rad."""
        return np.sqrt(np.diag(self.covariance))

    def at(self, point: Array) -> tuple[Array, Array]:
        """Return twist (6,) and covariance (6, 6) at another point (3,) of the profiler's frame, m."""
        twist, _, covariance = self.joint_at(point)
        return twist, covariance[:6, :6]

    def joint_at(self, point: Array) -> tuple[Array, Array, Array]:
        """Return twist (6,), extra parameters (k,) and their covariance (6 + k, 6 + k) about another point (3,), m."""
        terms = Extra.of(dict.fromkeys(self.extra_names, np.inf))
        shift = np.asarray(point, dtype=float) - self.point
        pose = terms.pose_about(self.pose, self.extra, shift)
        return poses.displacement(pose, point), self.extra, terms.moved(self.joint_covariance, shift)


Backend = Literal["height_map", "open3d_plane", "paper"]

GATE = 5.0
"""Blocks with residuals beyond this many robust standard deviations are excluded as outliers."""
MAX_SHIFT, MAX_TURN = 4e-3, 0.1
"""Largest motion, m and rad: twice the range of the start."""
MIN_OVERLAP = 0.5
"""Share of the warm blocks that must overlap the cold surface."""
MAX_MISFIT = 0.02
"""Residuals beyond this share of the relief indicate two different artefacts."""
NOISY = 10.0
"""Information is used beyond this many times the expected contribution of noise of the slopes."""
NEAR = 0.01
"""The noise is estimated when a step changes its variance by at most this share."""
STRAIGHT = 400.0
"""Steps up to this squared length, in standard deviations, are linear: an error of 0.01 remains."""
_STEPS = 20
SHIFTS = np.linspace(-2e-3, 2e-3, 5)
SETTLED = 1e-7
"""Steps that move the surface by less than this, m, end the descent: the next would be a thousandth of it."""
YAWS = np.linspace(-0.05, 0.05, 5)
_WHITE = Noise()
_LEVEL = [2, 3, 4]
_KEPT = 6
_DESCENT = 25


def register(
    cold: BlockMap,
    warm: BlockMap,
    *,
    registration: Backend = "height_map",
    point: ArrayLike | None = None,
    line_effects: bool = True,
    loose: Literal["refuse", "report"] = "refuse",
    extra: Mapping[str, float] | None = None,
) -> Registration:
    """Find how the profiler's frame has moved between two scans of one artefact.

    Parameters
    ----------
    cold, warm : BlockMap
        The scans, from `prepare`. The motion may be up to 2 mm and 0.05 rad.
    registration : {"height_map", "open3d_plane", "paper"}
        Gauss-Newton on the height map; point-to-plane ICP of Open3D; trimming, statistical outlier removal, NDT and
        point-to-point ICP as published. The latter two need the extra ``open3d`` and serve for comparison.
    point : array_like (3,), optional
        Functional point of the result in profiler coordinates, m; default: the middle of the cold surface.
    line_effects : bool
        Whether jitter from profile to profile is estimated and, where significant, eliminated.
    loose : {"refuse", "report"}
        For an artefact that leaves freedoms undetermined: raise, or determine the others and name these.
    extra : mapping of str to float, optional
        Further parameters to be estimated with the motion, out of `extra.BASES`: name and standard deviation of the
        prior about 0, in m per m; inf for a free one.

    Returns
    -------
    Registration

    Raises
    ------
    MethodError
        The artefact leaves freedoms or extra parameters undetermined (they are named), the scans do not overlap or show
        two surfaces, an unknown backend or parameter is requested, the backend is not installed, or the steps do not
        settle.
    """
    if registration not in ("height_map", "open3d_plane", "paper"):
        raise MethodError(
            f"expected registration 'height_map', 'open3d_plane' or 'paper', found {registration!r}; choose "
            "one of them",
            code="registration.unknown",
        )
    terms = Extra.of(extra)
    if terms.names and registration != "height_map":
        raise MethodError(
            f"expected registration 'height_map' for the extra parameters {', '.join(terms.names)}, found "
            f"{registration!r}, which determines only the rigid motion; choose one or the other",
            code="registration.parameters.not_allowed",
        )
    free = _determined(cold, warm, loose, terms)
    started = _start(cold, warm, free)
    problem = Problem.of(cold, warm, extra=terms)
    at = problem.centre if point is None else np.asarray(point, dtype=float)
    if registration == "height_map":
        minimum = _refined(problem, started, free, line_effects)
        rms, missed = None, np.zeros(6 + len(terms.names))
    else:
        from errormotion.methods.crossbeam_scan.identification.registration import clouds

        pose, rms, steps = clouds.BACKENDS[registration](cold.scan, warm.scan)
        state = State.of(pose)
        gate = GATE * problem.evaluate(state).scale()
        sums = problem.evaluate(state, gate)
        minimum = _Found(state, sums, Noise(), gate, steps)
        # The remaining step of the height map is the error of this pose; it is added to its covariance.
        missed = solve(*normal_equations(sums, minimum.noise), free.motions, free.radius)
    sums, state = minimum.sums, minimum.state
    C = _covariance(problem, minimum, minimum.noise, free)
    share = _cold_share(problem, warm, minimum, free, C)
    C = terms.moved(_unknown(C + np.outer(missed, missed), free), at - problem.centre)
    used = np.abs(sums.residual) < minimum.gate
    if rms is None:
        rms = float(np.sqrt(np.mean(sums.residual[used] ** 2)))
    return Registration(
        backend=registration, pose=terms.pose_about(state.pose, state.values, at - problem.centre), point=at,
        covariance=C[:6, :6], residual=sums.residual, x=warm.x, y=warm.y,
        rms=rms, points=int(warm.points[used].sum()), noise=(cold.noise, warm.noise),
        line_jitter=(minimum.noise.tau[0] * ROWS**0.5, minimum.noise.tau[1] * ROWS**0.5),
        condition=free.condition, loose=free.loose, iterations=minimum.steps,
        extra_names=terms.names, extra=state.values, joint_covariance=C, cold_share=share,
        variance_factor=minimum.noise.k,
    )  # fmt: skip


@dataclass(frozen=True)
class _Found:
    state: State
    sums: Sums
    noise: Noise
    gate: float
    steps: int


def _determined(cold: BlockMap, warm: BlockMap, loose: str, extra: Extra) -> Freedoms:
    """Return what both scans determine, from the surfaces alone: each registered onto itself."""
    names = []
    for block_map, what in ((cold, "a cold scan"), (warm, "a warm scan")):
        of_slopes, of_noise = block_map.moments.information(extra.motions)
        of_noise *= NOISY * block_map.slope_noise**2
        blocks = block_map.moments.blocks
        free = freedoms(of_slopes[:6, :6], blocks, of_noise[:6, :6])
        if loose == "refuse":
            refuse(free, what)
        extra.refuse_undetermined(of_slopes - of_noise, blocks, free)
        names.append(free)
    return max(names, key=lambda free: (len(free.loose), free.condition))


def _covariance(problem: Problem, minimum: _Found, noise: Noise, free: Freedoms) -> Array:
    """Return the covariance (n, n) of twist and extra parameters at the problem's centre."""
    H, _ = problem.equations(minimum.sums, noise, minimum.state)
    scale = scales(free.radius, len(H) - 6)
    C: Array = noise.k * np.outer(scale, scale) * inverse(H * np.outer(scale, scale), free.motions)
    return C


def _cold_share(problem: Problem, warm: BlockMap, minimum: _Found, free: Freedoms, covariance: Array) -> float:
    """Return the share of the covariance that comes from the cold scan: that of its noise, and half of the jitter."""
    white = problem.cold.usual_variance / (problem.cold.usual_variance + warm.usual_variance)
    if not any(minimum.noise.tau):
        return white
    alone = _covariance(problem, minimum, Noise(minimum.noise.k), free)
    known = np.diag(covariance) > 0
    part = float(np.mean(np.diag(alone)[known] / np.diag(covariance)[known]))
    return part * white + (1.0 - part) * 0.5


def _start(cold: BlockMap, warm: BlockMap, free: Freedoms) -> Start:
    """Return the start; raise MethodError for scans without a common surface."""
    thin = Problem.of(cold, warm, THIN)
    noise = 30 * cold.usual_variance**0.5
    start = descend(thin, thin.rest, free.motions, free.radius)
    if not start.scale < noise:
        candidate = search(thin, free.motions, free.radius)
        start = candidate if candidate.scale < start.scale else start
    if np.isinf(start.scale):
        raise MethodError(
            f"expected two scans of one position, found the cold one at {_extent(cold)} and the warm one at "
            f"{_extent(warm)}; start both at the same position, and count positions from the same zero",
            code="registration.scans.apart",
        )
    if not start.scale < noise and not start.scale < MAX_MISFIT * (relief := _relief(cold)):
        raise MethodError(
            f"expected two scans of one artefact moved by at most 2 mm and 0.05 rad, found surfaces that stay "
            f"{start.scale * 1e6:.1f} um apart (relief {relief * 1e6:.0f} um) after registration; "
            "check that both scans are of the same artefact, start at the same position and have the same units",
            code="registration.scans.other_surface",
        )
    pose = start.state.pose
    shift, turn = np.hypot(*(pose.apply(cold.centre) - cold.centre)[:2]), start.state.turn
    if shift > MAX_SHIFT or turn > MAX_TURN:
        raise MethodError(
            f"expected a motion of at most 2 mm and 0.05 rad, found {shift * 1e3:.2f} mm across and "
            f"{turn:.3f} rad; start both scans at the same position of the artefact",
            code="registration.motion.too_large",
        )
    if start.overlap < MIN_OVERLAP:
        raise MethodError(
            f"expected at least {MIN_OVERLAP:.0%} of the warm scan to lie on the cold one, found {start.overlap:.0%}"
            "; scan the same piece of the artefact",
            code="registration.overlap.too_small",
        )
    return start


def _extent(block_map: BlockMap) -> str:
    """Return the extent of a scan as text."""
    return " and ".join(
        f"{name} from {positions[0] * 1e3:.1f} to {positions[-1] * 1e3:.1f} mm"
        for name, positions in (("x", block_map.x), ("y", block_map.y))
    )


def _relief(block_map: BlockMap) -> float:
    """Return the robust deviation of a surface from its plane, m."""
    x, y = np.meshgrid(block_map.x - block_map.centre[0], block_map.y - block_map.centre[1])
    known = block_map.known
    rows = np.column_stack([np.ones(known.sum()), x[known], y[known]])
    rest = block_map.height[known] - rows @ np.linalg.lstsq(rows, block_map.height[known], rcond=None)[0]
    return scale_about_zero(rest)


def _refined(problem: Problem, start: Start, free: Freedoms, line_effects: bool) -> _Found:
    """Take Gauss-Newton steps with all blocks; the noise is estimated when the pose has nearly converged."""
    state, noise, gate = State(start.state.matrix, problem.rest.values), Noise(), GATE * start.scale
    near, steps = False, start.steps
    for _ in range(_STEPS):
        steps += 1
        sums = problem.evaluate(state, gate)
        for _ in range(2):
            if near:
                noise = estimate_noise(problem, state, sums, line_effects, noise)
            H, h = problem.equations(sums, noise, state)
            move = solve(H, h, free.motions, free.radius)
            before, state = state, problem.stepped(state, move)
            # Squared length in standard deviations: after one of 3, the next is far below a hundredth.
            length = float(move @ H @ move) / noise.k
            if near or not length < min(NEAR * sums.used, STRAIGHT):
                break
            near, sums = True, problem.after(before, sums, move)
        if near and length < 0.1:
            break
        near = near or length < NEAR * sums.used
        gate = GATE * sums.scale()
    else:
        raise MethodError(
            f"expected the registration to settle within {_STEPS} steps, found it still {length**0.5:.1f} standard "
            "deviations from convergence; check both scans for a part that moved",
            code="registration.not_converged",
        )
    return _Found(state, sums, noise, gate, steps)


def _unknown(covariance: Array, free: Freedoms) -> Array:
    """Return the covariance with NaN for the freedoms of which a hundredth or more is not determined."""
    if not free.loose:
        return covariance
    share = np.sum(free.motions**2, axis=1)
    undetermined_here = (share > 0.01) | np.array([name in free.loose for name in DOF])
    return np.where(undetermined_here[:, None] | undetermined_here[None, :], np.nan, covariance)


# where Gauss-Newton starts: at rest where that fits, else at the best of a coarse grid of shifts and yaws


@dataclass(frozen=True)
class Start:
    """A state, the robust scale of the residuals there (m), and the steps it took."""

    state: State
    scale: float
    steps: int
    overlap: float = 0.0
    """Share of the known warm blocks that have cold surface beneath them."""


def descend(problem: Problem, state: State, motions: Array, radius: float, steps: int = _DESCENT) -> Start:
    """Take Gauss-Newton steps with the blocks that fit until they no longer move the surface by the noise."""
    gate, done, known = np.inf, 0, np.count_nonzero(np.isfinite(problem.stack[3]))
    for done in range(1, steps + 1):
        sums = problem.evaluate(state, gate)
        if 4 * sums.used < known:
            if gate < np.inf:
                gate = np.inf
                continue
            return Start(state, np.inf, done)
        step = solve(*normal_equations(sums, _WHITE), motions, radius)
        size = float(np.max(np.abs(step * [1, 1, 1, radius, radius, radius])))
        # A step beyond the surface's features leads nowhere.
        state = problem.stepped(state, step * min(1.0, 2e-3 / max(size, 1e-12)))
        gate = max(6 * sums.scale(), 1e-9)
        if size < SETTLED:
            break
    sums = problem.evaluate(state)
    return Start(state, sums.scale(), done, np.count_nonzero(np.isfinite(sums.residual)) / known)


def search(problem: Problem, motions: Array, radius: float) -> Start:
    """Return the best descent from a grid of shifts and yaws about the centre."""
    tried = []
    for x in SHIFTS:
        for y in SHIFTS:
            for yaw in YAWS:
                state = problem.stepped(problem.rest, np.array([x, y, 0.0, 0.0, 0.0, yaw]))
                for _ in range(2):
                    sums = problem.evaluate(state)
                    if sums.used < 16:
                        break
                    H, h = normal_equations(sums, _WHITE)
                    level = np.zeros(6)
                    level[_LEVEL] = -np.linalg.solve(H[np.ix_(_LEVEL, _LEVEL)], h[_LEVEL])
                    state = problem.stepped(state, level)
                else:
                    tried.append(Start(state, problem.evaluate(state).scale(), 3))
    tried.sort(key=lambda start: start.scale)
    ends = [descend(problem, start.state, motions, radius) for start in tried[:_KEPT]]
    return min(ends, key=lambda start: start.scale, default=Start(problem.rest, np.inf, 0))
