"""Which freedoms balls on the table show, and which they cannot.

The tip always sits at the same place of the spindle: a machine that commands it to p brings it to p + e(p),

    e(p) = E + (R - 1) M (p - f)

with E the displacement at the functional point f, R the turn of the frame of axes relative to the table, and M = 1 for
the axes that carry the tool, 0 for those that carry the workpiece: their way is no lever of the tool's side.
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

FEWEST = 3
"""Balls that are asked for."""
FLAT = 1e-3
"""Balls count as in one line, or at one height, when they leave it by less than this share of their spread."""


@dataclass(frozen=True)
class Motion:
    """What can move, and where it is stated.

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
        """Freedoms that balls can show at all: a turn shows where the tool's way has a lever to its axis."""
        lever = self.carries
        return (0, 1, 2, *(3 + k for k in range(3) if lever[[j for j in range(3) if j != k]].any()))

    def lever(self, place: Array) -> Array:
        """Return M (p - f) of places (..., 3), m."""
        return (place - self.point) * self.carries

    def error(self, twist: Array, lever: Array) -> Array:
        """Return e of twists (..., 6) at levers (..., 3); the rotation is exact, a rotation vector."""
        return twist[..., :3] + turned(twist[..., 3:], lever) - lever

    def design(self, lever: Array, normal: Array) -> Array:
        """Return how the error along unit vectors (..., 3) at turned levers (..., 3) follows the seen freedoms."""
        full = np.concatenate([normal, np.cross(lever, normal)], axis=-1)
        return np.asarray(full[..., list(self.seen)])


def turned(rotation: Array, vector: Array) -> Array:
    """Return vectors (..., 3) turned by rotation vectors (..., 3), by Rodrigues' formula."""
    square = np.sum(rotation**2, axis=-1, keepdims=True)
    angle = np.sqrt(square)
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    across = np.cross(rotation, vector)
    return np.asarray(vector + first * across + second * np.cross(rotation, across))


def spread(centres: Array) -> float:
    """Return the root mean square distance of centres (ball, 3) from their mean, m."""
    return float(np.sqrt(np.mean(np.sum((centres - centres.mean(axis=0)) ** 2, axis=1))))


def check_layout(centres: Array, names: Sequence[str], tool_axes: str) -> None:
    """Raise MethodError where balls at centres (ball, 3), m, leave open what they could show."""
    if len(centres) < FEWEST:
        raise MethodError(
            f"Expected {FEWEST} balls or more on the table, better four; found {len(centres)} "
            f"({', '.join(names) or 'none'}). Set up more: the balls are what the machine's turns are seen by."
        )
    motion = Motion(tool_axes, centres.mean(axis=0))
    loose = undetermined(centres, motion)
    if not loose:
        return
    if spread(centres) == 0:
        raise MethodError(f"Balls {', '.join(names)} all lie at one place; expected places far apart.")
    away = centres - centres.mean(axis=0)
    size = np.linalg.svd(away, compute_uv=False)
    turns = ", ".join(DOF[k] for k in loose)
    if tool_axes == "XYZ":
        off = size[1] / np.sqrt(len(centres))
        raise MethodError(
            f"Balls {', '.join(names)} lie in one line, to {off * 1e3:.3g} mm: turns about it do not show ({turns}). "
            "Set up one ball away from the line, as far as the table allows."
        )
    axes_of_tool = " and ".join(tool_axes)
    heights = ", ".join(f"{value * 1e3:.4g}" for value in centres[:, "XYZ".index(tool_axes[0])])
    raise MethodError(
        f"Where {axes_of_tool} alone carries the tool, turns show only by balls at different places along "
        f"{axes_of_tool}; these lie at {tool_axes[0]} = {heights} mm, so that {turns} cannot be told from "
        "displacements. Put some balls on posts. (Is tool_axes right for this machine?)"
    )


def undetermined(centres: Array, motion: Motion) -> list[int]:
    """Return the freedoms, of those that balls can show, that balls at centres (ball, 3), m, leave open."""
    design = np.stack([motion.design(motion.lever(centres), np.tile(axis, (len(centres), 1))) for axis in np.eye(3)])
    A = design.reshape(-1, len(motion.seen))
    A = A / np.where(np.array(motion.seen) < 3, 1.0, spread(centres) or 1.0)
    _, size, directions = np.linalg.svd(A)
    weak = directions[np.concatenate([size, np.zeros(len(directions) - len(size))]) < FLAT * size[0]]
    return [k for k, part in zip(motion.seen, np.abs(weak).max(axis=0, initial=0.0), strict=True) if part > 1e-3]
