"""The measurement model of a campaign: registered maps that see the motion of the profiler.

A registration y of a warm scan onto the cold one of its artefact sees the twist x of the profiler when the axis is over
the artefact. With W of `chain.from_maps` for the pose p of the profiler,

    y = W(p)^-1 x + noise of the warm scan + noise c of the cold scan + D (strains s) .

The cold scan of an artefact is one draw for all cycles. The strains between cold and warm are scales of the profiler
along x and z and the expansion of its mount, the same for all artefacts in a cycle, and the expansion of each artefact.
For scales and artefact, D follows from the registration, which takes them as 0 within their priors. Besides, the
artefact raises its surface along z by its height, and the mount displaces the profiler by its place in the tool frame.
The errors of the carriage are E = A(p, l) x with the lever l.

Where the carriage follows a guide, pitch and yaw of the carriage are the slopes of the guide, EA = dEZ/dY and
EC = -dEX/dY. These are two further readings of 0 at each artefact, with the stated uncertainty and that of the slopes,
which are those of a spline through the artefacts of a cycle. They couple the artefacts, so that cold scans and strains
are estimated with the twists.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.estimation.blocks import Block, Constant, Noise
from errormotion.estimation.problem import READINGS, Problem
from errormotion.estimation.sources import Errors, Places, errors_of
from errormotion.kinematics.twists import transform, transform_covariance
from errormotion.measurement.identification import solve
from errormotion.measurement.observed import Observed, Solved
from errormotion.methods.crossbeam_scan.identification import chain
from errormotion.methods.crossbeam_scan.identification.chain import Rig
from errormotion.methods.crossbeam_scan.identification.profiler_pose import calibration
from errormotion.methods.crossbeam_scan.identification.registrations import Registrations

T = TypeVar("T")
POSE, LEVER, COLD = "profiler pose", "lever", "cold scan"
SCALE, EXPANSION, MOUNT = "scale of the profiler", "expansion of the artefacts", "expansion of the mount"
SHARED = "registrations"
"""Groups of the budget; the last is what a guide makes of the noise of all registrations together."""
_REGULAR = 1e-9
"""What is added to the diagonal of correlations, above their rounding and below that of the check of results."""
# (rotation, displacement, sign): EA = dEZ/dY, EC = -dEX/dY
_GUIDE = ((3, 2, 1.0), (5, 0, -1.0))


class Unknowns(NamedTuple, Generic[T]):
    """Twist of the profiler at its origin and in its frame at each artefact in each cycle, m and rad."""

    twist: T


class Known(NamedTuple, Generic[T]):
    """What is taken from elsewhere.

    Pose (a, b, g, dx, dy, dz) and lever of the rig; noise of the cold scan in each registration, m and rad; scales of
    the profiler along x and z and expansion of its mount in each cycle, expansion of each artefact in each cycle, m/m.
    """

    pose: T
    lever: T
    cold: T
    scale: T
    mount: T
    expansion: T


@dataclass(frozen=True, eq=False)
class Campaign:
    """Registrations of the cycles of a result; the first is the cold reference.

    Attributes
    ----------
    registrations : Registrations
        Of these cycles; of the first, only which artefacts have a reference is used.
    positions : ndarray, (artefact,)
        Of the axis, m, increasing.
    rig : Rig
    guide : float, optional
        Standard uncertainty of EA - dEZ/dY and of EC + dEX/dY, rad; None: the carriage follows no guide.
    strains : ndarray, (4,)
        Standard uncertainty of the scale along x and z, which is the same, of the artefacts' expansion, and of the
        mount's, m/m.
    height : float
        Of the surfaces above the plane on which the artefacts stand, m.
    """

    registrations: Registrations
    positions: Array
    rig: Rig
    guide: float | None
    strains: Array
    height: float

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of cycles and artefacts."""
        cycles, artefacts = self.registrations.cold_share.shape
        return cycles, artefacts

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """Which registrations are known, (cycle, artefact), the cold ones excluded."""
        known = np.asarray(np.isfinite(self.registrations.twist[..., 0]))
        known[0] = False
        return known

    @cached_property
    def determined(self) -> NDArray[np.bool_]:
        """Which errors are known, (cycle, artefact)."""
        known = self.known.copy()
        known[0] = self.registrations.cold >= 0
        return known

    def observed(self, **attributes: Any) -> Observed:
        """Return the model, with further arguments of `Observed`."""
        cycles, artefacts = self.shape
        return Observed(
            problem=self.problem,
            places=Places(self._errors, cycles * artefacts, only=("twist", "pose", "lever")),
            dims=("time", "position"),
            component="Y",
            frame="carriage, machine directions",
            functional_point=(0.0, 0.0, 0.0),
            shared=SHARED,
            what="the registrations",
            noise_cause="Does the carriage follow its guide (guide_uncertainty)? strain = 'free' does not assume it.",
            noise_increases=False,
            robust=False,
            resolution=0.0,
            **attributes,
        )

    # the problem

    @cached_property
    def problem(self) -> Problem:
        """Return the registrations as a problem of least squares."""
        cycles, artefacts = self.shape
        n = cycles * artefacts
        at, known = np.arange(n), self.known.ravel()
        rows = at if self.guide is None else at[:, None] // artefacts * artefacts + np.arange(artefacts)
        C = self.registrations.covariance.reshape(n, 9, 9)[:, :6, :6].copy()
        C[~known] = C[np.argmax(known)] if known.any() else np.eye(6)  # has no effect
        share = np.where(known, self.registrations.cold_share.ravel(), 0.0)
        readings = np.where(known[:, None], self.registrations.twist.reshape(n, 9)[:, :6], np.nan)
        root = _root(C)
        noise = np.sqrt(1.0 - share)[:, None, None] * root
        if self.guide is not None:
            both = known & (self.known.sum(axis=1)[at // artefacts] > 1)
            readings = np.concatenate([readings, np.where(both, 0.0, np.nan)[:, None].repeat(2, axis=1)], axis=1)
            whole = np.zeros((n, 8, 8))
            whole[:, :6, :6] = noise
            whole[:, [6, 7], [6, 7]] = self.slopes[1][at // artefacts]
            noise = whole
        return Problem(
            equation=self._residuals,
            readings=readings,
            unknowns=Unknowns(Block(start=np.zeros((n, 6)), index=rows, scale=1.0, free=known)),
            constants=self._constants(np.sqrt(share)[:, None, None] * root),
            noise=Noise(root=noise),
            derivatives=self._derivatives,
            constant_derivatives=self._derivatives,
        )

    def _constants(self, cold: Array) -> Known[Constant]:
        """Return pose, lever, cold scans and strains with their uncertainty; ``cold`` (n, 6, 6) are roots of theirs."""
        (cycles, artefacts), rig, adjust = self.shape, self.rig, self.guide is not None
        n, one = cycles * artefacts, np.zeros(cycles * artefacts, dtype=np.intp)
        at = np.arange(n)
        identities = chain.pose_identities(rig.pose, rig.pose_covariance)
        factor = np.zeros((n, 6, artefacts, 6))
        factor[at, :, at % artefacts] = cold
        warm = at[artefacts:]
        passes, numbers = np.arange(1, cycles), np.arange(1, artefacts + 1)
        of_pass = np.zeros((cycles, 1, cycles - 1))
        of_pass[passes, 0, passes - 1] = 1.0
        of_scan = np.zeros((n, 1, len(warm)))
        of_scan[warm, 0, warm - artefacts] = 1.0
        scales = np.concatenate([of_pass, of_pass], axis=2) * np.eye(2).repeat(cycles - 1, axis=1)
        along, _, expansion, mount = self.strains
        return Known(
            pose=Constant(
                value=calibration.parameters(rig.pose)[None], factor=chain.root(rig.pose_covariance).T[None], index=one,
                scale=1.0, group=POSE, names=chain.SOURCES[:6],
                identity=[identities.get(name, "") for name in chain.SOURCES[:6]],
            ),
            lever=Constant(
                value=rig.lever[None], factor=np.diag(rig.lever_uncertainty)[None], index=one, scale=1.0, group=LEVER,
                names=chain.SOURCES[6:],
            ),
            cold=Constant(
                value=np.zeros((n, 6)), factor=factor.reshape(n, 6, -1), index=at, scale=1.0, group=COLD,
                names=self.cold_names, adjust=adjust,
            ),
            scale=Constant(
                value=np.zeros((cycles, 2)), factor=_drawn(scales, along), index=at // artefacts, scale=1.0,
                group=SCALE, names=[f"scale {x} of the profiler, pass {c}" for x in "xz" for c in passes if along],
                adjust=adjust,
            ),
            mount=Constant(
                value=np.zeros((cycles, 1)), factor=_drawn(of_pass, mount), index=at // artefacts, scale=1.0,
                group=MOUNT, names=[f"expansion of the mount, pass {c}" for c in passes if mount], adjust=adjust,
            ),
            expansion=Constant(
                value=np.zeros((n, 1)), factor=_drawn(of_scan, expansion), index=at, scale=1.0, group=EXPANSION,
                names=[f"expansion of artefact {k}, pass {c}" for c in passes for k in numbers if expansion],
                adjust=adjust,
            ),
        )  # fmt: skip

    @property
    def cold_names(self) -> list[str]:
        """Names of the sources of the cold scans, which are the uncertainty of the reference state."""
        return [f"cold scan {k + 1}, part {i + 1}" for k in range(self.shape[1]) for i in range(6)]

    # the equation

    def _residuals(self, y: Array, x: Unknowns[Array], c: Known[Array]) -> Array:
        of_twist = self._of_twist(c)
        rows = x.twist.reshape(len(y), -1, 6)
        strain = np.concatenate([c.scale, c.expansion, c.mount], axis=1)
        residuals: Array = y - np.einsum("nmwi,nwi->nm", of_twist, rows)
        residuals[:, :6] -= c.cold + np.einsum("nij,nj->ni", self.effect.reshape(-1, 6, 4), strain)
        return residuals

    def _of_twist(self, c: Known[Array]) -> Array:
        """Return the derivatives of the readings by the twists that they see, (n, m, w, 6)."""
        artefacts = self.shape[1]
        at = np.arange(self.known.size)
        pose = calibration.pose(*c.pose[0])
        to_map = np.linalg.inv(chain.from_maps(pose)[:6, :6])
        if self.guide is None:
            return np.broadcast_to(to_map[:, None], (at.size, 6, 1, 6))
        A = chain.carriage_adjoint(pose, c.lever[0])
        fine = self.slopes[0][at // artefacts, at % artefacts]
        derivatives = np.zeros((at.size, 8, artefacts, 6))
        derivatives[at, :6, at % artefacts] = to_map
        for k, (turn, shift, sign) in enumerate(_GUIDE):
            derivatives[:, 6 + k] = -sign * fine[..., None] * A[shift]
            derivatives[at, 6 + k, at % artefacts] += A[turn]
        return derivatives

    def _derivatives(self, y: Array, x: Unknowns[Array], c: Known[Array]) -> dict[str, Array]:  # noqa: ARG002 - linear
        """Return the derivatives of the residuals, which are linear, by all but pose and lever."""
        m = y.shape[1]
        D = np.zeros((*y.shape, 10))
        D[:, :6, :6], D[:, :6, 6:] = np.eye(6), self.effect.reshape(-1, 6, 4)
        by_twist = -self._of_twist(c)
        return {
            "twist": by_twist[:, :, 0] if self.guide is None else by_twist,
            READINGS: np.broadcast_to(np.eye(m), (*y.shape, m)),
            "cold": -D[..., :6],
            "scale": -D[..., 6:8],
            "expansion": -D[..., 8:9],
            "mount": -D[..., 9:],
        }

    @cached_property
    def effect(self) -> Array:
        """Error of each registration by a unit of each of the ``strains``, (cycle, artefact, 6, 4)."""
        R, place = self.rig.pose.rotation.inv(), self.rig.pose.translation
        to_map = np.linalg.inv(chain.from_maps(self.rig.pose)[:3, :3])
        effect = np.zeros((*self.shape, 6, 4))
        effect[..., :3] = self.registrations.effect[..., :6, :]
        # The strain of a larger warm artefact is negative: it makes the warm map as small as the cold one.
        effect[..., :3, 2] += self.height * to_map[:, 2]
        effect[..., :3, 3] = to_map @ R.apply(place)
        return effect

    def _errors(self, x: Unknowns[Array], c: Known[Array]) -> Array:
        A = chain.carriage_adjoint(calibration.pose(*c.pose[0]), c.lever[0])
        return np.where(self.determined.reshape(-1, 1), x.twist @ A.T, np.nan)

    @cached_property
    def slopes(self) -> tuple[Array, Array]:
        """Matrices (cycle, a, a) from values at artefacts to their slopes, and the noise of the guide (cycle, 2), rad.

        The noise is the stated uncertainty together with the error of the spline's slopes of EZ and EX. Its difference
        from a slope by two neighbours is a measure of it, without what the noise of the registrations makes of it.
        """
        cycles, artefacts = self.shape
        fine, size = np.zeros((cycles, artefacts, artefacts)), np.ones((cycles, 2))
        E, C = self.carriage()
        for c in range(1, cycles):
            used = np.flatnonzero(self.known[c])
            if used.size < 2:
                continue
            spline, coarse = slopes(self.positions[used])
            fine[c][np.ix_(used, used)] = spline
            off = spline - coarse
            for i, (_, shift, _) in enumerate(_GUIDE):
                by_noise = np.mean(off**2 @ C[c, used, shift, shift])
                error = np.mean((off @ E[c, used, shift]) ** 2) - by_noise
                size[c, i] = np.sqrt((self.guide or 0.0) ** 2 + max(error, 0.0))
        return fine, size

    def recorded(self, raw: xr.Dataset, y: Array, generator: np.random.Generator) -> xr.Dataset:
        """Return raw data with registrations y (n, 6) and their noise."""
        root = np.asarray(self.problem.noise.root)[:, :6, :6]
        noisy = y[:, :6] + (root @ generator.standard_normal((len(y), 6, 1)))[..., 0]
        values, dims = noisy.reshape(*self.shape, 6), ("cycle", "artefact", "direction")
        values[0] = 0.0
        units = {"displacement": (values[..., :3], "m"), "rotation": (values[..., 3:], "rad")}
        return raw.assign({name: (dims, each, {"units": unit}) for name, (each, unit) in units.items()})

    # the registrations alone, without the guide

    def profiler(self) -> tuple[Array, Array, Array]:
        """Return the twists of the profiler, their covariance, and what of it the cold scans cause."""
        W = chain.from_maps(self.rig.pose)[:6, :6]
        effect, noise = self.effect, self.registrations.covariance[..., :6, :6]
        C = noise + effect * np.square(self.strains) @ np.swapaxes(effect, -1, -2)
        cold = self.registrations.cold_share[..., None, None] * noise
        # the same bits for any number of artefacts
        return np.einsum("...j,ij->...i", self.registrations.twist[..., :6], W), W @ C @ W.T, W @ cold @ W.T

    def carriage(self) -> tuple[Array, Array]:
        """Return the errors of the carriage, and their covariance without that of pose and lever."""
        x, C, _ = self.profiler()
        A = chain.carriage_adjoint(self.rig.pose, self.rig.lever)
        return transform(x, A), transform_covariance(C, A)

    # what follows from a solution

    def solved_profiler(self, solved: Solved) -> tuple[Array, Array, Array]:
        """Return the same as `profiler` from a solution."""
        if self.guide is None:
            return self.profiler()
        of = errors_of(solved.fit, Places(lambda x, _: x.twist, self.known.size, only=("twist",)))
        x = np.where(self.known[..., None], of.value.reshape(*self.shape, 6), np.nan)
        cold = self._covariance(of, {COLD})
        return x, self._covariance(of, {SHARED, SCALE, MOUNT, EXPANSION}, own=True) + cold, cold

    def of_registrations(self, solved: Solved) -> Array:
        """Return the covariance of the errors by the noise of the registrations, (cycle, artefact, 6, 6)."""
        C = self._covariance(solved.relative.errors, {SHARED, COLD}, own=True)
        return np.where(self.determined[..., None, None], C, np.nan)

    def predicted(self) -> Array:
        """Return the covariance that follows from surfaces and stated noise alone, (artefact, 6, 6)."""
        bound = self.registrations.bound
        ideal = Registrations.empty(2, len(bound), cold=self.registrations.cold)
        known = np.isfinite(bound[:, 0, 0])
        ideal.twist[1, known], ideal.covariance[1], ideal.cold_share[1] = 0.0, bound, 0.0
        alone = replace(self, registrations=ideal, strains=np.zeros(4))
        if self.guide is None or not known.any():
            twists: Array = alone.carriage()[1][1].copy()
            return twists
        covariance: Array = alone.of_registrations(solve(alone.observed(coords={}, reference="")))[1]
        return covariance

    def _covariance(self, errors: Errors, groups: Collection[str], *, own: bool = False) -> Array:
        F = np.reshape([s.effect for s in errors.sources if s.group in groups], (-1, *self.shape, 6))
        C: Array = np.einsum("s...i,s...j->...ij", F, F)
        return C + errors.own.reshape(C.shape) if own else C


def slopes(positions: ArrayLike) -> tuple[Array, Array]:
    """Return two matrices (n, n) from values at positions to their slopes: by a cubic spline, and by differences.

    The second uses one neighbour on each side; for two positions it is 0. Its difference from the first is a measure of
    the error of the first.
    """
    from scipy.interpolate import CubicSpline

    y = np.asarray(positions, dtype=float)
    n = y.size
    if n < 2:
        return np.zeros((n, n)), np.zeros((n, n))
    fine = np.asarray(CubicSpline(y, np.eye(n), bc_type="not-a-knot")(y, 1))
    if n == 2:
        return fine, np.zeros((2, 2))
    return fine, np.asarray(np.gradient(np.eye(n), y, axis=0, edge_order=1 if n == 3 else 2))


def _drawn(factor: Array, uncertainty: float) -> Array:
    """Return the factor of sources of one standard uncertainty; without sources where it is 0."""
    return uncertainty * factor[..., : factor.shape[2] if uncertainty else 0]


def _root(C: Array) -> Array:
    """Return square roots of covariances (n, 6, 6).

    Of the correlations, whose diagonal stays 1: a freedom that is a million times more certain than others would
    otherwise get more than its variance.
    """
    unit = np.sqrt(np.diagonal(C, axis1=-2, axis2=-1))
    near = C / (unit[..., :, None] * unit[..., None, :]) + _REGULAR * np.eye(6)
    return np.asarray(unit[..., :, None] * np.linalg.cholesky(near / (1.0 + _REGULAR)))
