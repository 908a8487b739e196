"""Which of the six freedoms an artefact determines, and further parameters besides.

The information of a scan about the twist is N = J^T J over its blocks. With rotations multiplied by the artefact's
radius every unit is a length, and an eigenvalue of N per block is the squared slope with which the surface meets a
motion of that kind. A plane meets three motions with none at all, a sphere three, a cylinder two, a surface of
revolution or one with straight parallel rulings one.

Further parameters are linear displacements of the surface in addition to the rigid motion. A carriage that turns while
it feeds carries a picture of the artefact that is sheared or stretched, and a warm artefact one that is larger. Every
such parameter e displaces a point P of the cold frame by e G (P - c), with G a 3 x 3 matrix and c the point of the
twist. Its units are those of a slope (m per m).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from errormotion.arrays import Array
from errormotion.datasets import DOF
from errormotion.errors import MethodError
from errormotion.kinematics.twists import adjoint, known_product

MOTIONS = np.zeros((6, 3, 4))
"""Displacement (3,) of a point by a unit of twist, affine in its position (1, X, Y, Z): (6, 3, 4)."""
MOTIONS[[0, 1, 2], [0, 1, 2], 0] = 1.0
MOTIONS[[3, 4, 5], [2, 0, 1], [2, 3, 1]] = 1.0
MOTIONS[[3, 4, 5], [1, 2, 0], [3, 1, 2]] = -1.0

MIN_SLOPE = 2e-3
"""A motion that changes the heights by less than this share of its size (root mean square) is not determined."""
_SHAPES = {1: "a surface of revolution or of straight rulings", 2: "a cylinder", 3: "a plane or a sphere"}


@dataclass(frozen=True)
class Freedoms:
    """What an artefact determines.

    Attributes
    ----------
    condition : float
        Largest over smallest eigenvalue of the scaled information.
    loose : tuple of str
        Freedoms (EX to EC at the artefact's centre) that nearly lie in undetermined motions, one for each of them.
    motions : ndarray (6, k)
        Undetermined motions: orthonormal twists, rotations times the radius.
    radius : float
        Root mean square distance of the blocks from the centre, m.
    """

    condition: float
    loose: tuple[str, ...]
    motions: Array
    radius: float


@dataclass(frozen=True)
class Moments:
    """Sums over the blocks of a map, from which its information about any motion follows.

    Attributes
    ----------
    slopes : ndarray (12, 12)
        Sum of q q^T, q the products of the normal (-Sx, -Sy, 1) with (1, X, Y, Z) about the centre.
    positions : ndarray (4, 4)
        Sum of p p^T, p = (1, X, Y, Z).
    blocks : int
        Number of blocks.
    """

    slopes: Array
    positions: Array
    blocks: int

    def information(self, motions: Array) -> tuple[Array, Array]:
        """Return J^T J of motions (n, 3, 4), and what of it slopes with a noise of 1 add, (n, n).

        The noise of a block's slopes meets a motion with what it moves the block across: a translation along x looks
        determined where a plane is noisy.
        """
        flat, x, y = motions.reshape(-1, 12), motions[:, 0], motions[:, 1]
        return flat @ self.slopes @ flat.T, x @ self.positions @ x.T + y @ self.positions @ y.T


def undetermined(information: Array, scale: Array, blocks: int) -> tuple[Array, Array]:
    """Return eigenvalues and scaled vectors (columns) of the motions that an information leaves undetermined."""
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale) / blocks)
    return values, vectors[:, values < MIN_SLOPE**2]


def freedoms(information: Array, blocks: int, noise: Array | None = None, radius: float | None = None) -> Freedoms:
    """Return what an artefact determines.

    Parameters
    ----------
    information : ndarray (6, 6)
        Sum of J^T J over the blocks, at the artefact's centre.
    blocks : int
        Number of blocks in the sum.
    noise : ndarray (6, 6), optional
        As much of the information as may come from noise alone.
    radius : float, optional
        Root mean square distance of the points from the centre, m; default: that of a height map.
    """
    if radius is None:  # J's columns for a and b are about y and -x: their squares give it
        radius = float(np.sqrt((information[3, 3] + information[4, 4]) / information[2, 2]))
    scale = scales(radius, 0)
    values = np.linalg.eigvalsh(information * np.outer(scale, scale) / blocks)
    _, motions = undetermined(information - (0.0 if noise is None else noise), scale, blocks)
    share = np.sum(motions**2, axis=1)
    # Equal shares: the later freedom, so that a sphere's rotations are named before its translations.
    order = np.lexsort((-np.arange(6), -np.round(share, 3)))[: motions.shape[1]]
    loose = tuple(DOF[i] for i in sorted(order))
    return Freedoms(float(values[-1] / max(values[0], np.finfo(float).tiny)), loose, motions, radius)


def scales(radius: float, extra: int) -> Array:
    """Return what makes every unit a length: rotations and extra parameters are multiplied by the radius (m)."""
    return np.array([1.0, 1.0, 1.0, *[1 / radius] * (3 + extra)])


def refuse(result: Freedoms, what: str) -> None:
    """Raise MethodError where an artefact leaves freedoms undetermined; ``what`` names the scan."""
    if result.loose:
        names = ", ".join(result.loose)
        k = len(result.loose)
        raise MethodError(
            f"expected an artefact whose surface determines all six freedoms, found {what} that leaves {k} of them "
            f"undetermined: {names} (condition {result.condition:.2g}; it looks like {_SHAPES.get(k, 'no surface')}); "
            "use a free-form artefact, or ask for the determined freedoms only",
            code="registration.freedoms.undetermined",
        )


def _entry(i: int, j: int) -> Array:
    G = np.zeros((3, 3))
    G[i, j] = 1.0
    return G


BASES: dict[str, Array] = {
    "feed_x": _entry(0, 1),
    "feed_y": _entry(1, 1),
    "feed_z": _entry(2, 1),
    "scale_x": _entry(0, 0),
    "scale_z": _entry(2, 2),
    "expansion": np.eye(3),
}
"""Drift along x, y, z per metre of feed (that along y: its scale), scales of the sensor, expansion of the artefact."""

WIDE = 0.05
"""A parameter with a prior wider than this counts as free."""
_SHARE = 0.1


@dataclass(frozen=True)
class Extra:
    """The requested parameters.

    Attributes
    ----------
    names : tuple of str
        Keys of `BASES`.
    bases : ndarray (k, 3, 3)
        Their matrices G.
    prior : ndarray (k,)
        Standard deviations of their priors about 0; infinite where they are free.
    """

    names: tuple[str, ...]
    bases: Array
    prior: Array

    @classmethod
    def of(cls, requested: Mapping[str, float] | None) -> Extra:
        """Return the parameters of a mapping from name to standard deviation.

        Raises
        ------
        MethodError
            A name is unknown, or a standard deviation is not a positive number.
        """
        requested = dict(requested or {})
        if unknown := sorted(set(requested) - set(BASES)):
            raise MethodError(
                f"expected extra parameters out of {', '.join(BASES)}, found {', '.join(map(repr, unknown))}; "
                "leave out or rename what is not in the list",
                code="registration.parameters.unknown",
            )
        if wrong := {name: sigma for name, sigma in requested.items() if not sigma > 0}:
            raise MethodError(
                f"expected the standard deviation of the prior of every extra parameter as a positive number, found "
                f"{', '.join(f'{name} = {sigma}' for name, sigma in wrong.items())}; "
                "give inf for a free one, and leave out what is to be 0",
                code="registration.parameters.prior",
            )
        bases = np.array([BASES[name] for name in requested]).reshape(-1, 3, 3)
        return cls(tuple(requested), bases, np.array([float(sigma) for sigma in requested.values()]))

    @property
    def motions(self) -> Array:
        """Displacement of a point by a unit of twist or parameter, affine in its position: (6 + k, 3, 4)."""
        own = np.zeros((len(self.names), 3, 4))
        own[:, :, 1:] = self.bases
        return np.concatenate([MOTIONS, own])

    def stretch(self, values: Array) -> Array:
        """Return 1 + sum of e G, (3, 3)."""
        total: Array = np.eye(3) + np.tensordot(values, self.bases, 1)
        return total

    def about(self, shift: Array) -> Array:
        """Return what takes twist and parameters to a point that is ``shift`` (3,) further, (6 + k, 6 + k)."""
        A = np.eye(6 + len(self.names))
        A[:6, :6] = adjoint(shift=shift)
        A[:3, 6:] = (self.bases @ shift).T
        return A

    def moved(self, covariance: Array, shift: Array) -> Array:
        """Return the covariance of twist and parameters (6 + k, 6 + k) about a point that is ``shift`` (3,) further."""
        A = self.about(shift)
        moved = known_product(A, known_product(A, covariance).T)
        return 0.5 * (moved + moved.T)

    def pose_about(self, pose: RigidTransform, values: Array, shift: Array) -> RigidTransform:
        """Return the pose that, with the same values about a point ``shift`` (3,) further, moves everything alike."""
        if not len(values):
            return pose
        stretch = self.stretch(values)
        return RigidTransform.from_translation(np.linalg.solve(stretch, (stretch - np.eye(3)) @ shift)) * pose

    def refuse_undetermined(self, information: Array, blocks: int, free: Freedoms) -> None:
        """Raise MethodError where free parameters are not separable from the motion or from one another.

        Parameters
        ----------
        information : ndarray (6 + k, 6 + k)
            Sum of J^T J over the blocks, without what may come from noise alone.
        blocks : int
            Number of blocks in the sum.
        free : Freedoms
            What the artefact determines of the motion alone.
        """
        loose = np.flatnonzero(self.prior > WIDE)
        if not len(loose):
            return
        kept = np.concatenate([np.arange(6), 6 + loose])
        scale = scales(free.radius, len(loose))
        scaled = information[np.ix_(kept, kept)] * np.outer(scale, scale)
        motions = np.vstack([free.motions, np.zeros((len(loose), free.motions.shape[1]))])
        basis = np.linalg.svd(motions)[0][:, motions.shape[1] :] if motions.shape[1] else np.eye(len(scale))
        _, vectors = undetermined(basis.T @ scaled @ basis, np.ones(basis.shape[1]), blocks)
        open_ = (basis @ vectors)[6:]
        share = np.max(np.abs(open_), axis=1, initial=0.0)
        names = [self.names[loose[i]] for i in np.flatnonzero(share > _SHARE * share.max(initial=0.0))]
        if names:
            raise MethodError(
                f"expected extra parameters that the artefact's surface separates from its motion and from "
                f"one another, found undetermined: {', '.join(names)}; omit some of them, or give the standard "
                f"deviation of their prior, of at most {WIDE:g}",
                code="registration.parameters.undetermined",
            )
