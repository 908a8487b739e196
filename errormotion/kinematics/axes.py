"""One axis of a machine: its motion and its error motions.

An axis joins two bodies, one nearer to the workpiece and one nearer to the tool. Whichever body moves, a positive
command moves the tool side in the positive direction relative to the workpiece side, and the axis's error is the actual
pose of the tool side relative to the workpiece side minus the commanded one.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform

from errormotion.arrays import Array
from errormotion.kinematics.iso import ROTARY_AXES, direction_of
from errormotion.kinematics.poses import displaced

__all__ = ["Axis", "ErrorMotion"]


@dataclass(frozen=True, eq=False)
class ErrorMotion:
    """Six error motions of an axis, tabulated over its commanded position and linear in between.

    Attributes
    ----------
    positions : ndarray, (n,)
        Commanded positions, strictly increasing; m for a linear axis, rad for a rotary one.
    twists : ndarray, (n, 6)
        EX EY EZ in m and EA EB EC in rad; NaN where a freedom is not known.
    period : float, optional
        2 pi for a rotary axis without end stops: the table is continued with this period. Without it the errors
        outside of the table are unknown: NaN.

    Raises
    ------
    ValueError
        Wrong shapes, positions that do not increase, or a table longer than its period.
    """

    positions: Array
    twists: Array
    period: float | None = None

    def __post_init__(self) -> None:
        positions, twists = np.array(self.positions, dtype=float), np.array(self.twists, dtype=float)
        if positions.ndim != 1 or twists.shape != (positions.size, 6):
            raise ValueError(
                f"expected positions of shape (n,) and twists of shape (n, 6); "
                f"found {positions.shape} and {twists.shape}"
            )
        if positions.size == 0 or not np.all(np.diff(positions) > 0):
            raise ValueError("expected one or more strictly increasing positions; sort the table")
        if self.period is not None and not np.ptp(positions) < self.period:
            raise ValueError(
                f"expected positions within one period of {self.period:g}; found a range of {np.ptp(positions):g}"
            )
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "twists", twists)

    def __call__(self, commanded: ArrayLike) -> Array:
        """Return the error twist, (..., 6), at commanded positions (...)."""
        q = np.asarray(commanded, dtype=float)
        outside = None if self.period is not None else np.nan
        columns = [
            np.interp(q, self.positions, column, left=outside, right=outside, period=self.period)
            for column in self.twists.T
        ]
        return np.stack(columns, axis=-1)


@dataclass(frozen=True, eq=False)
class Axis:
    """A linear or rotary axis as a joint between its workpiece-side and its tool-side body.

    Attributes
    ----------
    name : str
        ``X Y Z U V W`` move along, ``A B C`` rotate about the coordinate that ISO 841 assigns to them.
    carries_tool : bool
        Whether the moving body is on the tool's side of the bed.
    reference : ndarray, (3,)
        Point at which the error motion is stated, m, in machine coordinates with all axes at zero. It moves with the
        body of a linear axis; for a rotary axis it is a point of the axis's line.
    """

    name: str
    carries_tool: bool
    reference: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        direction_of(self.name)
        reference = np.array(self.reference, dtype=float)
        if reference.shape != (3,):
            raise ValueError(
                f"expected the reference of axis {self.name} as three coordinates, found {reference.shape}"
            )
        object.__setattr__(self, "reference", reference)

    @property
    def rotary(self) -> bool:
        """Whether the axis rotates."""
        return self.name in ROTARY_AXES

    @property
    def direction(self) -> Array:
        """Unit vector, (3,), that the axis moves along or rotates about."""
        direction = np.zeros(3)
        direction[direction_of(self.name)] = 1.0
        return direction

    @property
    def error_follows_motion(self) -> bool:
        """Whether the error is stated in the frame of the tool-side body, else in that of the workpiece-side body.

        The reference of a linear axis moves with the moving body; the error motions of a rotary axis are stated in the
        body that does not rotate (ISO 230-7).
        """
        return self.carries_tool != self.rotary

    def motion(self, commanded: ArrayLike) -> RigidTransform:
        """Return the commanded poses of the tool-side body in the workpiece-side body.

        Parameters
        ----------
        commanded : array_like, (n,)
            m or rad.

        Returns
        -------
        RigidTransform
            n poses; at zero both bodies' frames coincide.
        """
        along = np.asarray(commanded, dtype=float)[:, None] * self.direction
        if not self.rotary:
            return RigidTransform.from_translation(along)
        return displaced(np.concatenate([np.zeros_like(along), along], axis=1), self.reference)

    def actual(self, commanded: ArrayLike, error: ArrayLike, location: ArrayLike) -> RigidTransform:
        """Return the actual poses of the tool-side body in the workpiece-side body, exactly.

        Parameters
        ----------
        commanded : array_like, (n,)
        error : array_like, (n, 6)
            Error motion at the reference.
        location : array_like, (n, 6)
            Error of position and orientation of the axis's line (squareness included), at the reference. It displaces
            the line and leaves the bodies unchanged at command zero.
        """
        M, D, L = self.motion(commanded), displaced(error, self.reference), displaced(location, self.reference)
        return L * (M * D if self.error_follows_motion else D * M) * L.inv()
