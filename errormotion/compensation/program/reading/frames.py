"""Transformation between coordinates of a program and positions of the machine axes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Frame:
    """Machine = R (scale program + g92) + origin + tool, as in LinuxCNC; R rotates about Z.

    Attributes
    ----------
    scale : float
        Unit of the program, m.
    rotation : float
        Of the coordinate system about Z, degrees.
    g92, origin, tool : (x, y, z)
        Offset of G92, origin of the coordinate system, offset of the tool, m.
    known : bool
        Whether all offsets are known.
    """

    scale: float
    rotation: float
    g92: Triple
    origin: Triple
    tool: Triple
    known: bool = field(init=False, compare=False)

    def __post_init__(self) -> None:
        values = (*self.g92, *self.origin, *self.tool)
        object.__setattr__(self, "known", not any(map(math.isnan, values)))

    @property
    def turn(self) -> tuple[float, float]:
        """Cosine and sine of the rotation."""
        if not self.rotation:
            return 1.0, 0.0
        angle = math.radians(self.rotation)
        return math.cos(angle), math.sin(angle)

    def vector(self, v: Triple) -> Triple:
        """Return a difference of program coordinates in machine axes, m."""
        return self._turned((v[0] * self.scale, v[1] * self.scale, v[2] * self.scale), 1.0)

    def own(self, v: Triple) -> Triple:
        """Return a vector of machine axes, m, in program coordinates."""
        x, y, z = self._turned(v, -1.0)
        return x / self.scale, y / self.scale, z / self.scale

    def machine(self, p: Triple) -> Triple:
        """Return the position of the machine axes, m."""
        x, y, z = self._turned(tuple(a * self.scale + b for a, b in zip(p, self.g92, strict=True)), 1.0)  # type: ignore[arg-type]
        o, t = self.origin, self.tool
        return x + o[0] + t[0], y + o[1] + t[1], z + o[2] + t[2]

    def program(self, q: Triple) -> Triple:
        """Return program coordinates of a position of the machine axes, m."""
        o, t = self.origin, self.tool
        x, y, z = self._turned((q[0] - o[0] - t[0], q[1] - o[1] - t[1], q[2] - o[2] - t[2]), -1.0)
        return tuple((a - b) / self.scale for a, b in zip((x, y, z), self.g92, strict=True))  # type: ignore[return-value]

    def _turned(self, v: Triple, sense: float) -> Triple:
        if not self.rotation:
            return v
        c, s = self.turn
        s *= sense
        return c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]
