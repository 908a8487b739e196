"""The registration of two block maps, and the choice of what does it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import RigidTransform

from errormotion.datasets import DOF
from errormotion.errors import MethodError
from errormotion.kinematics.twists import adjoint, transform_covariance
from errormotion.methods.crossbeam_scan.registration.blocks import BlockMap
from errormotion.methods.crossbeam_scan.registration.freedoms import Freedoms, freedoms, refuse
from errormotion.methods.crossbeam_scan.registration.kernels import ROWS
from errormotion.methods.crossbeam_scan.registration.result import Registration
from errormotion.methods.crossbeam_scan.registration.solver import (
    Noise,
    Problem,
    Sums,
    estimate_noise,
    inverse,
    normal_equations,
    solve,
)
from errormotion.methods.crossbeam_scan.registration.start import Start, descend, search

Array = NDArray[np.float64]
Backend = Literal["height_map", "open3d_plane", "paper"]

THIN = 4
"""The start is found with every fourth block along both directions."""
GATE = 5.0
"""Blocks further off than this many robust standard deviations are dirt, and left out."""
LARGEST_SHIFT, LARGEST_TURN = 4e-3, 0.1
"""Beyond these, m and rad, a scan is off its place: twice what the start is made for."""
LEAST_OVERLAP = 0.5
"""Share of the warm blocks that must have cold surface beneath them."""
LARGEST_MISFIT = 0.02
"""Residuals may be this share of the surface's relief before the scans count as two artefacts."""
_STEPS = 12


def register(
    cold: BlockMap,
    warm: BlockMap,
    *,
    registration: Backend = "height_map",
    point: ArrayLike | None = None,
    line_effects: bool = True,
    loose: Literal["refuse", "report"] = "refuse",
) -> Registration:
    """Find how the profiler's frame has moved between two scans of one artefact.

    Parameters
    ----------
    cold, warm : BlockMap
        The scans, from `prepare`. The motion may be up to 2 mm and 0.05 rad.
    registration : {"height_map", "open3d_plane", "paper"}
        Gauss-Newton on the height map; point-to-plane ICP of Open3D; trimming, statistical outlier removal, NDT and
        point-to-point ICP as published. The latter two need the extra ``open3d`` and are there for comparison.
    point : array_like (3,), optional
        Functional point of the result in profiler coordinates, m; default: the middle of the cold surface.
    line_effects : bool
        Whether jitter from profile to profile is looked for, and taken out where it shows.
    loose : {"refuse", "report"}
        What to do with an artefact that leaves freedoms undetermined: raise, or find the others and name these.

    Returns
    -------
    Registration

    Raises
    ------
    MethodError
        The artefact leaves freedoms undetermined (they are named), the scans do not overlap or show two surfaces, an
        unknown backend is asked for, its extra is not installed, or the steps do not settle.
    """
    if registration not in ("height_map", "open3d_plane", "paper"):
        raise MethodError(
            f"expected registration 'height_map', 'open3d_plane' or 'paper', found {registration!r}; choose one of them"
        )
    free = _determined(cold, warm, loose)
    begun = _begin(cold, warm, free)
    problem = Problem.of(cold, warm)
    at = problem.centre if point is None else np.asarray(point, dtype=float)
    if registration == "height_map":
        found = _refined(problem, begun, free, line_effects)
        sums, rms, missed = found.sums, None, np.zeros(6)
    else:
        from errormotion.methods.crossbeam_scan.registration import clouds

        pose, rms, steps = clouds.BACKENDS[registration](cold.scan, warm.scan)
        gate = GATE * problem.evaluate(pose).scale()
        sums = problem.evaluate(pose, gate)
        found = _Found(pose, sums, Noise(), gate, steps)
        # What the height map still sees of this pose's error is the honest part of its covariance.
        missed = solve(*normal_equations(sums, found.noise), free.motions, free.radius)
    H, _ = normal_equations(sums, found.noise)
    scale = np.array([1.0, 1.0, 1.0, 1 / free.radius, 1 / free.radius, 1 / free.radius])
    C = found.noise.k * np.outer(scale, scale) * inverse(H * np.outer(scale, scale), free.motions)
    C = _unknown(C + np.outer(missed, missed), free)
    C = transform_covariance(C, adjoint(shift=at - problem.centre))
    used = np.abs(sums.residual) < found.gate
    if rms is None:
        rms = float(np.sqrt(np.mean(sums.residual[used] ** 2)))
    return Registration(
        backend=registration, pose=found.pose, point=at, covariance=C, residual=sums.residual, x=warm.x, y=warm.y,
        rms=rms, points=int(warm.points[used].sum()), noise=(cold.noise, warm.noise),
        line_jitter=(found.noise.tau[0] * ROWS**0.5, found.noise.tau[1] * ROWS**0.5),
        condition=free.condition, loose=free.loose, iterations=found.steps,
    )  # fmt: skip


@dataclass(frozen=True)
class _Found:
    pose: RigidTransform
    sums: Sums
    noise: Noise
    gate: float
    steps: int


def _determined(cold: BlockMap, warm: BlockMap, loose: str) -> Freedoms:
    """Return what both scans determine, from the surfaces alone: each laid on itself."""
    found = []
    for block_map, what in ((cold, "a cold scan"), (warm, "a warm scan")):
        sums = Problem.of(block_map, block_map, THIN).evaluate(RigidTransform.identity())
        weight = float(np.sum(sums.A[:, 2, 2]))
        free = freedoms(sums.A.sum(axis=0) * (sums.used / weight), sums.used, block_map.slope_noise)
        if loose == "refuse":
            refuse(free, what)
        found.append(free)
    return max(found, key=lambda free: (len(free.loose), free.condition))


def _begin(cold: BlockMap, warm: BlockMap, free: Freedoms) -> Start:
    """Return where to start, or refuse scans that show no common surface."""
    thin = Problem.of(cold, warm, THIN)
    noise = 30 * cold.usual_variance**0.5
    start = descend(thin, RigidTransform.identity(), free.motions, free.radius)
    if not start.scale < noise:
        found = search(thin, free.motions, free.radius)
        start = found if found.scale < start.scale else start
    if not start.scale < noise and not start.scale < LARGEST_MISFIT * (relief := _relief(cold)):
        raise MethodError(
            f"expected two scans of one artefact moved by at most 2 mm and 0.05 rad, found surfaces that stay "
            f"{start.scale * 1e6:.1f} um apart (relief {relief * 1e6:.0f} um) wherever one is laid on the other; "
            "check that both scans are of the same artefact, begin at the same place and have the same units"
        )
    shift, turn = start.pose.apply(cold.centre) - cold.centre, start.pose.rotation.magnitude()
    if np.hypot(*shift[:2]) > LARGEST_SHIFT or turn > LARGEST_TURN:
        raise MethodError(
            f"expected a motion of at most 2 mm and 0.05 rad, found {np.hypot(*shift[:2]) * 1e3:.2f} mm across and "
            f"{turn:.3f} rad; let both scans begin at the same place of the artefact"
        )
    share = np.isfinite(thin.evaluate(start.pose).residual).sum() / np.isfinite(thin.stack[3]).sum()
    if share < LEAST_OVERLAP:
        raise MethodError(
            f"expected at least {LEAST_OVERLAP:.0%} of the warm scan to lie on the cold one, found {share:.0%}; "
            "scan the same piece of the artefact"
        )
    return start


def _relief(block_map: BlockMap) -> float:
    """Return the robust deviation of a surface from its plane, m."""
    x, y = np.meshgrid(block_map.x - block_map.centre[0], block_map.y - block_map.centre[1])
    known = block_map.known
    rows = np.column_stack([np.ones(known.sum()), x[known], y[known]])
    rest = block_map.height[known] - rows @ np.linalg.lstsq(rows, block_map.height[known], rcond=None)[0]
    return float(1.4826 * np.median(np.abs(rest)))


def _refined(problem: Problem, start: Start, free: Freedoms, line_effects: bool) -> _Found:
    """Take Gauss-Newton steps with all blocks; the noise is estimated once the pose is near."""
    pose, noise, gate, near, steps = start.pose, Noise(), GATE * start.scale, False, start.steps
    for _ in range(_STEPS):
        steps += 1
        sums = problem.evaluate(pose, gate)
        if near:
            noise = estimate_noise(problem, pose, sums, gate, line_effects)
        H, h = normal_equations(sums, noise)
        move = solve(H, h, free.motions, free.radius)
        pose = problem.moved(pose, move)
        # Squared length in standard deviations: after one of 3, the next is far below a hundredth.
        length = float(move @ H @ move) / noise.k
        if near and length < 0.1:
            break
        near = near or length < 10.0
        gate = GATE * sums.scale()
    else:
        raise MethodError(
            f"expected the registration to settle within {_STEPS} steps, found it still {length**0.5:.1f} standard "
            "deviations from rest; look at both scans for a part that moved"
        )
    return _Found(pose, sums, noise, gate, steps)


def _unknown(covariance: Array, free: Freedoms) -> Array:
    """Return the covariance with NaN for the freedoms of which a hundredth or more is not determined."""
    if not free.loose:
        return covariance
    share = np.sum(free.motions**2, axis=1)
    spoilt = (share > 0.01) | np.array([name in free.loose for name in DOF])
    return np.where(spoilt[:, None] | spoilt[None, :], np.nan, covariance)
