"""Which of the six freedoms an artefact determines.

The information of a scan about the twist is N = J^T J over its blocks. With rotations multiplied by the artefact's
radius every unit is a length, and an eigenvalue of N per block is the squared slope with which the surface meets a
motion of that kind. A plane meets three motions with none at all, a sphere three, a cylinder two, a surface of
revolution or one with straight parallel rulings one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from errormotion.datasets import DOF
from errormotion.errors import MethodError

Array = NDArray[np.float64]

LEAST_SLOPE = 2e-3
"""A motion that changes the heights by less than this share of itself (root mean square) is not determined."""
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


def freedoms(information: Array, blocks: int, slope_noise: float = 0.0) -> Freedoms:
    """Return what an artefact determines.

    Parameters
    ----------
    information : ndarray (6, 6)
        Sum of J^T J over the blocks, at the artefact's centre.
    blocks : int
        Number of blocks in the sum.
    slope_noise : float
        Standard deviation of the slopes' noise, which alone makes an eigenvalue of its square.
    """
    # J's columns for a and b are about y and -x: their squares give the radius.
    radius = float(np.sqrt((information[3, 3] + information[4, 4]) / information[2, 2]))
    scale = np.array([1.0, 1.0, 1.0, 1 / radius, 1 / radius, 1 / radius])
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale) / blocks)
    least = max(LEAST_SLOPE**2, 10 * slope_noise**2)
    k = int(np.count_nonzero(values < least))
    motions = vectors[:, :k]
    share = np.sum(motions**2, axis=1)
    # Equal shares: the later freedom, so that a sphere's rotations are named before its translations.
    order = np.lexsort((-np.arange(6), -np.round(share, 3)))[:k]
    loose = tuple(DOF[i] for i in sorted(order))
    return Freedoms(float(values[-1] / max(values[0], np.finfo(float).tiny)), loose, motions, radius)


def refuse(found: Freedoms, what: str) -> None:
    """Raise MethodError where an artefact leaves freedoms undetermined; ``what`` says which scan."""
    if found.loose:
        names = ", ".join(found.loose)
        k = len(found.loose)
        raise MethodError(
            f"expected an artefact whose surface determines all six freedoms, found {what} that leaves {k} of them "
            f"undetermined: {names} (condition {found.condition:.2g}; it looks like {_SHAPES.get(k, 'no surface')}); "
            "use a free-form artefact, or ask for the determined freedoms only"
        )
