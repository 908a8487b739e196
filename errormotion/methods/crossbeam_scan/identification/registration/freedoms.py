"""Which of the six freedoms an artefact determines.

The information of a scan about the twist is N = J^T J over its blocks. With rotations multiplied by the artefact's
radius every unit is a length, and an eigenvalue of N per block is the squared slope with which the surface meets a
motion of that kind. A plane meets three motions with none at all, a sphere three, a cylinder two, a surface of
revolution or one with straight parallel rulings one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array
from errormotion.datasets import DOF
from errormotion.errors import MethodError

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


def refuse(found: Freedoms, what: str) -> None:
    """Raise MethodError where an artefact leaves freedoms undetermined; ``what`` names the scan."""
    if found.loose:
        names = ", ".join(found.loose)
        k = len(found.loose)
        raise MethodError(
            f"expected an artefact whose surface determines all six freedoms, found {what} that leaves {k} of them "
            f"undetermined: {names} (condition {found.condition:.2g}; it looks like {_SHAPES.get(k, 'no surface')}); "
            "use a free-form artefact, or ask for the determined freedoms only",
            code="registration.freedoms.undetermined",
        )
