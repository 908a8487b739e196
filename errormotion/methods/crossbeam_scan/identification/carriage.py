"""From the registrations of a campaign to the errors of the carriage over time and position, with their correlation.

With fixed weights of the guide, the errors are linear in the registrations y: E = A(H, lever) K W(H) y. W converts maps
to the motion of the profiler, K applies the guide (identity without one) and A is the adjoint to the carriage. The
effects of pose and lever are central differences over plus and minus one standard uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from errormotion.arrays import Array
from errormotion.kinematics.twists import transform, transform_covariance
from errormotion.methods.crossbeam_scan.identification import chain, strain
from errormotion.methods.crossbeam_scan.identification.profiler_pose import calibration
from errormotion.methods.crossbeam_scan.identification.registrations import Registrations


@dataclass(frozen=True)
class Rig:
    """Pose of the profiler and lever, with their uncertainty.

    Attributes
    ----------
    pose : RigidTransform
        H, profiler to tool frame.
    lever : ndarray, (3,)
        Carriage to tool frame, m.
    pose_covariance : ndarray, (6, 6), or None
        Of (a, b, g, dx, dy, dz).
    lever_uncertainty : ndarray, (3,)
        m.
    """

    pose: RigidTransform
    lever: Array
    pose_covariance: Array | None
    lever_uncertainty: Array

    def changed(self) -> tuple[RigidTransform, Array]:
        """Return poses (18,) and levers (18, 3) changed by plus, then by minus one standard uncertainty of each source.

        The sources are `chain.SOURCES`; one without uncertainty changes nothing.
        """
        steps = np.zeros((len(chain.SOURCES), 9))
        steps[:6, :6], steps[6:, 6:] = chain.root(self.pose_covariance), np.diag(self.lever_uncertainty)
        steps = np.concatenate([steps, -steps])
        changed = calibration.pose(*(calibration.parameters(self.pose) + steps[:, :6]).T)
        poses = RigidTransform.concatenate([changed, self.pose])
        moved = steps[:, :6].any(axis=1)
        return poses[np.where(moved, np.arange(len(steps)), len(steps))], self.lever + steps[:, 6:]


@dataclass(frozen=True)
class Carriage:
    """Errors of the carriage at its origin over (cycle, artefact), relative to the cold scan.

    Attributes
    ----------
    profiler : ndarray, (cycle, artefact, 6)
        Motion of the profiler at its origin, in its frame, m and rad.
    profiler_covariance : ndarray, (cycle, artefact, 6, 6)
        From the registrations.
    values : ndarray, (cycle, artefact, 6)
        EX EY EZ (m), EA EB EC (rad); NaN where there is no registration.
    covariance : ndarray, (cycle, artefact, 6, 6)
        From the registrations alone.
    influence : ndarray, (source, cycle, artefact, 6)
        Of pose, lever and cold scans.
    sources, source_groups : list of str
    predicted : ndarray, (artefact, 6, 6)
        Covariance from surface and stated noise alone.
    drift : ndarray, (cycle, artefact, 3)
        g, change of the profiler's position per metre of feed, profiler frame.
    assumed : ndarray, (2 artefact, cycle, artefact, 6)
        Effect of one standard uncertainty of pitch and yaw relative to the guide, independent in each cycle; 0 without
        a guide.
    """

    profiler: Array
    profiler_covariance: Array
    values: Array
    covariance: Array
    influence: Array
    sources: list[str]
    source_groups: list[str]
    predicted: Array
    drift: Array
    assumed: Array


def carriage(found: Registrations, positions: ArrayLike, rig: Rig, *, guide: float | None) -> Carriage:
    """Return the errors of the carriage from all registrations.

    Parameters
    ----------
    found : Registrations
    positions : (artefact,)
        Positions of the axis, m, increasing.
    rig : Rig
    guide : float or None
        Standard uncertainty, rad, with which the carriage follows its guide, see `strain.guided`; None: not used.
    """
    y = np.asarray(positions, dtype=float)
    cycles, artefacts = found.cold_share.shape
    W, A = strain.from_maps(rig.pose), chain.carriage_adjoint(rig.pose, rig.lever)
    poses, levers = rig.changed()
    to_twist, to_carriage = strain.from_maps(poses)[:, :6], chain.carriage_adjoint(poses, levers)
    e = np.full((cycles, artefacts, 6), np.nan)
    C = np.full((cycles, artefacts, 6, 6), np.nan)
    drift = np.full((cycles, artefacts, 3), np.nan)
    influence = np.full((len(chain.SOURCES), cycles, artefacts, 6), np.nan)
    assumed = np.zeros((2, artefacts, cycles, artefacts, 6))
    for c in range(cycles):
        known = np.isfinite(found.twist[c, :, 0])
        own = known & (found.cold == c)
        e[c, own], C[c, own], drift[c, own], influence[:, c, own] = 0.0, 0.0, 0.0, 0.0
        used = np.flatnonzero(known & ~own)
        if used.size == 0:
            continue
        maps = found.twist[c, used]
        seen = np.einsum("kj,ij->ki", maps, W)  # the same bits for any number of artefacts
        noise = W[:6] @ found.covariance[c, used] @ W[:6].T
        guided = _guided(seen[:, :6], noise, y[used], A, guide)
        e[c, used], C[c, used], gain = guided.twist, guided.covariance, guided.gain
        assumed[:, used[:, None], c, used] = transform(guided.assumed.reshape(2, used.size, used.size, 6), A)
        drift[c, used] = seen[:, 6:]
        plus, minus = np.split(_errors(maps, gain, to_twist, to_carriage), 2)
        influence[:, c, used] = (plus - minus) / 2
    covariance = transform_covariance(C, A)
    cold = cold_influence(covariance, found)
    names = [f"cold scan {k + 1}, part {i + 1}" for k in range(artefacts) for i in range(6)]
    return Carriage(
        profiler=e,
        profiler_covariance=C,
        values=transform(e, A),
        covariance=covariance,
        influence=np.concatenate([influence, cold]),
        sources=[*chain.SOURCES, *names],
        source_groups=[*chain.SOURCE_GROUPS, *["cold scan"] * len(names)],
        predicted=_predicted(found, y, W, A, guide),
        drift=drift,
        assumed=assumed.reshape(2 * artefacts, cycles, artefacts, 6),
    )


def _guided(
    twist: Array, covariance: Array, positions: Array, to_carriage: Array, guide: float | None
) -> strain.Guided:
    """Return the twists of one cycle, with the guide taken into account where its uncertainty is given."""
    if guide is None:
        none = np.zeros((2 * len(twist), twist.size))
        return strain.Guided(twist, covariance, np.eye(twist.size), none, np.zeros(2))
    return strain.guided(twist, covariance, positions, to_carriage, guide)


def _errors(maps: Array, gain: Array, to_twist: Array, to_carriage: Array) -> Array:
    """Return the errors (m, n, 6) of registrations (n, 9) for m other poses and levers, with the same gain.

    ``to_twist`` (m, 6, 9) are the matrices from registrations to twists, ``to_carriage`` (m, 6, 6) those from twists to
    errors of the carriage.
    """
    twists = maps @ to_twist.mT
    guided = (gain @ twists.reshape(len(twists), -1, 1)).reshape(twists.shape)
    return np.asarray(guided @ to_carriage.mT)


_REGULAR = 1e-9
"""What is added to the diagonal of correlations, above their rounding and below that of the check of results."""


def cold_influence(covariance: Array, found: Registrations) -> Array:
    """Return the influence (6 per artefact, cycle, artefact, 6) of the cold scans' noise: one draw for all cycles."""
    cycles, artefacts = found.cold_share.shape
    out = np.where(np.isfinite(covariance[..., 0])[None], 0.0, np.nan) * np.ones((6 * artefacts, 1, 1, 1))
    for c, k in np.ndindex(cycles, artefacts):
        unit = np.sqrt(np.diag(covariance[c, k]))
        if np.isfinite(unit).all() and unit.all():
            # Of the correlations, whose diagonal stays 1: a freedom that is a million times more certain than others
            # would otherwise get more than its variance.
            near = covariance[c, k] / np.outer(unit, unit) + _REGULAR * np.eye(6)
            factor = np.linalg.cholesky(near / (1.0 + _REGULAR))
            out[6 * k : 6 * k + 6, c, k] = np.sqrt(found.cold_share[c, k]) * unit * factor.T
    return out


def _predicted(found: Registrations, y: Array, W: Array, A: Array, guide: float | None) -> Array:
    """Return the covariance of the errors that follows from the bounds of the registrations, (artefact, 6, 6)."""
    out = np.full((y.size, 6, 6), np.nan)
    known = np.flatnonzero(np.isfinite(found.bound[:, 0, 0]))
    if known.size:
        C = W[:6] @ found.bound[known] @ W[:6].T
        out[known] = transform_covariance(_guided(np.zeros((known.size, 6)), C, y[known], A, guide).covariance, A)
    return out
