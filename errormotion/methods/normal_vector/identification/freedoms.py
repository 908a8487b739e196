"""Errors that balls on the table determine.

The position of the tip in the spindle is constant. The machine commands p, and the tip is at p + e(p),

    e(p) = E + (R - 1) M (p - f)

with E the displacement at the functional point f, R the rotation of the frame of axes relative to the table, and M = 1
for the axes that carry the tool, 0 for those that carry the workpiece: their travel is no lever of the tool side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF

if TYPE_CHECKING:
    from collections.abc import Sequence

MIN_BALLS = 3
FLAT = 1e-3
"""Largest deviation of balls that count as lying in one line or at one height, relative to their spread."""


@dataclass(frozen=True)
class Motion:
    """The errors of a machine, and their functional point.

    Attributes
    ----------
    tool_axes : str
        Axes that carry the tool.
    point : ndarray (3,)
        Functional point, m.
    """

    tool_axes: str
    point: Array

    @property
    def carries(self) -> Array:
        """Diagonal of M, (3,)."""
        return np.array([axis in self.tool_axes for axis in "XYZ"], dtype=float)

    @property
    def seen(self) -> tuple[int, ...]:
        """Errors that balls can determine: a rotation if the travel of the tool has a lever to its axis."""
        lever = self.carries
        return (0, 1, 2, *(3 + k for k in range(3) if lever[[j for j in range(3) if j != k]].any()))

    def full(self, values: Array) -> Array:
        """Return twists (..., 6) from the errors that are determined, (..., p); 0 for the others."""
        if values.shape[-1] == 6:
            return values
        twist = np.zeros((*values.shape[:-1], 6))
        twist[..., list(self.seen)] = values
        return twist

    def error(self, values: Array, position: Array) -> Array:
        """Return e at positions (..., 3), m, for the errors that are determined, (..., p)."""
        twist, lever = self.full(values), self._lever(position)
        return twist[..., :3] + rotated(twist[..., 3:], lever) - lever

    def design(self, position: Array, normal: Array, values: Array | None = None) -> Array:
        """Return the derivatives (..., p) of e along unit vectors (..., 3), at errors (..., p); at 0 by default."""
        lever = self._lever(position)
        if values is not None:
            lever = rotated(self.full(values)[..., 3:], lever)
        full = np.concatenate([normal, np.cross(lever, normal)], axis=-1)
        return full if len(self.seen) == 6 else np.asarray(full[..., list(self.seen)])

    def _lever(self, position: Array) -> Array:
        """Return M (p - f) of positions (..., 3), m."""
        return (position - self.point) * self.carries


def rotated(rotation: Array, vector: Array) -> Array:
    """Return vectors (..., 3) rotated by rotation vectors (..., 3), by Rodrigues' formula."""
    (a, b, c), (x, y, z) = np.moveaxis(rotation, -1, 0), np.moveaxis(vector, -1, 0)
    square = a * a + b * b + c * c
    half = np.sqrt(square) / 2
    sinc = np.sinc(half / np.pi)
    # v (1 - g r^2) + f r x v + g r (r v) with f = sin(|r|) / |r| and g = (1 - cos(|r|)) / |r|^2
    f, g = sinc * np.cos(half), 0.5 * sinc**2
    along, rest = g * (a * x + b * y + c * z), 1 - g * square
    return np.stack(
        [
            rest * x + f * (b * z - c * y) + along * a,
            rest * y + f * (c * x - a * z) + along * b,
            rest * z + f * (a * y - b * x) + along * c,
        ],
        axis=-1,
    )


def spread(centres: Array) -> float:
    """Return the root mean square distance of centres (ball, 3) from their mean, m."""
    return float(np.sqrt(np.mean(np.sum((centres - centres.mean(axis=0)) ** 2, axis=1))))


def check_layout(centres: Array, names: Sequence[str], tool_axes: str) -> None:
    """Raise MethodError if balls at centres (ball, 3), m, leave errors undetermined that balls can determine."""
    if len(centres) < MIN_BALLS:
        raise MethodError(
            f"Expected {MIN_BALLS} balls or more on the table, preferably four; found {len(centres)} "
            f"({', '.join(names) or 'none'}). Set up more balls: they are needed to determine the rotations.",
            code="probing.balls.too_few",
        )
    motion = Motion(tool_axes, centres.mean(axis=0))
    unknown = undetermined(centres, motion)
    if not unknown:
        return
    if spread(centres) == 0:
        raise MethodError(
            f"Balls {', '.join(names)} have the same position; expected positions far apart.",
            code="probing.balls.same_position",
        )
    away = centres - centres.mean(axis=0)
    size = np.linalg.svd(away, compute_uv=False)
    missing = ", ".join(DOF[k] for k in unknown)
    if tool_axes == "XYZ":
        off = size[1] / np.sqrt(len(centres))
        raise MethodError(
            f"Balls {', '.join(names)} lie in one line, within {off * 1e3:.3g} mm: rotations about it are not "
            f"determined ({missing}). Set up one ball as far from this line as the table allows.",
            code="probing.balls.on_line",
        )
    axes_of_tool = " and ".join(tool_axes)
    heights = ", ".join(f"{value * 1e3:.4g}" for value in centres[:, "XYZ".index(tool_axes[0])])
    raise MethodError(
        f"If {axes_of_tool} alone carries the tool, rotations are determined only by balls at different positions "
        f"along {axes_of_tool}; these lie at {tool_axes[0]} = {heights} mm, so that {missing} cannot be distinguished "
        "from displacements. Put some balls on posts, and check tool_axes.",
        code="probing.balls.one_height",
    )


def undetermined(centres: Array, motion: Motion) -> list[int]:
    """Return the errors in ``motion.seen`` that balls at centres (ball, 3), m, leave undetermined."""
    design = np.stack([motion.design(centres, np.tile(axis, (len(centres), 1))) for axis in np.eye(3)])
    A = design.reshape(-1, len(motion.seen))
    A = A / np.where(np.array(motion.seen) < 3, 1.0, spread(centres) or 1.0)
    _, size, directions = np.linalg.svd(A)
    weak = directions[np.concatenate([size, np.zeros(len(directions) - len(size))]) < FLAT * size[0]]
    return [k for k, part in zip(motion.seen, np.abs(weak).max(axis=0, initial=0.0), strict=True) if part > 1e-3]
