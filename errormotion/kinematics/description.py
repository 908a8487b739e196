"""The description of one machine tool: its chain, the travel of its axes, its spindle axis and its rotary axes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.kinematics.chains import parse_chain
from errormotion.kinematics.iso import LINEAR_AXES, ROTARY_AXES

if TYPE_CHECKING:
    from errormotion.kinematics.machines import Machine

__all__ = ["DescriptionError", "MachineDescription"]

Range = tuple[float, float]

_ROUNDING = 1e-9
"""Tolerance of comparisons with the travel, m and rad."""


class DescriptionError(ValueError):
    """An inconsistent description; ``mistakes`` maps each wrong key to a text on its error."""

    def __init__(self, mistakes: Mapping[str, str]) -> None:
        self.mistakes = dict(mistakes)
        super().__init__("; ".join(f"{key}: {text}" for key, text in mistakes.items()))


@dataclass(frozen=True)
class MachineDescription:
    """Description of one machine tool by its user.

    Attributes
    ----------
    name : str
        For reports and for the attribute ``machine`` of datasets.
    chain : str
        Bodies and axes from workpiece to tool, see `errormotion.kinematics.chains.parse_chain`.
    travel : mapping of str to (float, float)
        Lowest and highest position of each axis, m or rad; not needed for a fixed axis.
    spindle_axis : str
        ``X``, ``Y`` or ``Z``: the direction of the spindle's axis of rotation.
    positions : mapping of str to (3,) sequence of float
        A point on the line of each rotary axis, m, in machine coordinates with all axes at zero.
    fixed : mapping of str to float
        Angle of each rotary axis that does not move, rad.

    Raises
    ------
    DescriptionError
        The description is inconsistent; all mistakes are reported together, by key.
    """

    name: str
    chain: str
    travel: Mapping[str, Range]
    spindle_axis: str = "Z"
    positions: Mapping[str, Sequence[float]] = field(default_factory=dict)
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if mistakes := dict(self._mistakes()):
            raise DescriptionError(mistakes)

    @cached_property
    def axes(self) -> tuple[str, ...]:
        """All axes in the order of commanded coordinates: X Y Z U V W A B C, as far as the chain has them."""
        return tuple(axis for axis in (*LINEAR_AXES, *ROTARY_AXES) if axis in self._sides)

    @cached_property
    def moving_axes(self) -> tuple[str, ...]:
        """The axes that are not fixed, in the same order."""
        return tuple(axis for axis in self.axes if axis not in self.fixed)

    @cached_property
    def tool_axes(self) -> str:
        """The linear axes X, Y, Z that carry the tool, such as ``"XYZ"`` or ``"Z"``."""
        return "".join(axis for axis in "XYZ" if self._sides.get(axis, False))

    @cached_property
    def moving_chain(self) -> str:
        """The chain without the fixed axes."""
        return "-".join(word for word in self._words if word not in self.fixed)

    def machine(self) -> Machine:
        """Return the kinematic model; error motions of linear axes are stated at the origin."""
        from errormotion.kinematics.machines import Machine

        return Machine(self.chain, self.positions)

    def commands(self, moving: ArrayLike) -> Array:
        """Return the commands (..., axis) of all axes for commands (..., moving axis) of the moving axes, m and rad.

        Raises
        ------
        ValueError
            The number of coordinates is not that of the moving axes.
        """
        q = np.asarray(moving, dtype=float)
        if q.ndim == 0 or q.shape[-1] != len(self.moving_axes):
            raise ValueError(
                f"expected commands of shape (..., {len(self.moving_axes)}) for {' '.join(self.moving_axes)}; "
                f"found {q.shape}"
            )
        full = np.empty((*q.shape[:-1], len(self.axes)))
        for column, axis in enumerate(self.axes):
            full[..., column] = self.fixed[axis] if axis in self.fixed else q[..., self.moving_axes.index(axis)]
        return full

    @property
    def _words(self) -> list[str]:
        return [word.strip() for word in self.chain.split("-")]

    @cached_property
    def _sides(self) -> dict[str, bool]:
        return parse_chain(self.chain)

    def _mistakes(self) -> Iterator[tuple[str, str]]:
        if not self.name.strip():
            yield "name", "expected the name of the machine; found none"
        if self.spindle_axis not in ("X", "Y", "Z"):
            yield "spindle_axis", f"expected a linear direction, X, Y or Z; found '{self.spindle_axis}'"
        try:
            sides = self._sides
        except ValueError as error:
            yield "chain", str(error)
            return
        yield from self._travel_mistakes(sides)
        for axis in dict.fromkeys((*self.positions, *self.fixed)):
            if axis not in sides:
                yield f"rotary.{axis}", f"the chain '{self.chain}' has no axis {axis}; remove one or add the other"
            elif axis not in ROTARY_AXES:
                yield f"rotary.{axis}", f"expected a rotary axis, {', '.join(ROTARY_AXES)}; {axis} is a linear axis"
            elif axis in self.fixed:
                yield from self._fixed_mistakes(axis, sides)
        for axis in (axis for axis in sides if axis in ROTARY_AXES):
            point = self.positions.get(axis)
            if point is None:
                yield f"rotary.{axis}.position", f"missing; expected a point on the line of {axis}, as three lengths"
            elif len(point) != 3 or not all(map(math.isfinite, point)):
                yield f"rotary.{axis}.position", f"expected three finite coordinates, m; found {point}"

    def _travel_mistakes(self, sides: Mapping[str, bool]) -> Iterator[tuple[str, str]]:
        for axis in sides:
            if axis not in self.travel and axis not in self.fixed:
                yield f"travel.{axis}", f"missing; expected the lowest and the highest position of {axis}"
        for axis, (low, high) in self.travel.items():
            unit = "rad" if axis in ROTARY_AXES else "m"
            if axis not in sides:
                yield f"travel.{axis}", f"the chain '{self.chain}' has no axis {axis}; remove one or add the other"
            elif not -math.inf < low < high < math.inf:
                yield (
                    f"travel.{axis}",
                    f"expected the lowest position before the highest; found {low:g} {unit}, {high:g} {unit}",
                )

    def _fixed_mistakes(self, axis: str, sides: Mapping[str, bool]) -> Iterator[tuple[str, str]]:
        angle, order = self.fixed[axis], list(sides)
        low, high = self.travel.get(axis, (-math.inf, math.inf))
        if not math.isfinite(angle) or not low - _ROUNDING <= angle <= high + _ROUNDING:
            span = f" within the travel, {low:g} rad to {high:g} rad" if axis in self.travel else ""
            yield f"rotary.{axis}.fixed", f"expected an angle{span}; found {angle:g} rad"
        before, after = order[: order.index(axis)], order[order.index(axis) + 1 :]
        between = all(any(each in LINEAR_AXES for each in part) for part in (before, after))
        if angle != 0 and between:
            yield (
                f"rotary.{axis}.fixed",
                f"expected 0 rad, because there are linear axes on both sides of {axis} in '{self.chain}', which would "
                f"not move along X, Y and Z at another angle; found {angle:g} rad",
            )
