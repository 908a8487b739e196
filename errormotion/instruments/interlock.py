"""The last check of what is sent to a machine: the driver is armed, the numbers are finite and within the limits."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

from pydantic import Field

from errormotion.errors import InstrumentError
from errormotion.plugins import MachineLimits, PluginSettings

_ROUNDING = 1e-9
"""Tolerance of positions, m, and relative tolerance of feeds and speeds."""

ROUNDING = 1e-9
"""Fraction of the limit by which an offset may exceed it."""

log = logging.getLogger(__name__)


class ArmedSettings(PluginSettings):
    """Settings of an instrument that can move or change a machine."""

    arm: bool = Field(
        default=False, description="whether the driver may move and change the machine; if not, it only reads"
    )


class Interlock:
    """Checks each command of a driver.

    Parameters
    ----------
    name, address : str
        The driver and its device, for messages.

    Attributes
    ----------
    limits : MachineLimits
        The limits of the bench; initially none.
    """

    def __init__(self, name: str, address: str) -> None:
        self._where = f"{name} at {address}"
        self._announced = False
        self.limits = MachineLimits()

    def require_armed(self, arm: bool, what: str) -> None:
        """Refuse a command unless the driver is armed; log the first one.

        Raises
        ------
        InstrumentError
            The driver is not armed, or the bench forbids motion.
        """
        what = " ".join(what.split())[:200]
        if not arm:
            raise InstrumentError(
                f"{self._where} only reads, and this command changes the machine: {what}. Nothing was sent. To permit "
                "it, set arm = true for the instrument in the bench file (arm=True in its settings)",
                code="instrument.not_armed",
            )
        if self.limits.forbidden:
            raise InstrumentError(
                f"{self._where}: {what}: refused, since {self.limits.forbidden}. Nothing was sent",
                code="motion.forbidden",
            )
        if not self._announced:
            self._announced = True
            log.info("%s is armed (%s); its first command: %s", self._where, self.limits, what)

    def position(self, point: Sequence[float], what: str = "position") -> list[float]:
        """Return X, Y, Z, m; InstrumentError unless they are finite and within the limits."""
        try:
            coordinates = [float(x) for x in point]
        except (TypeError, ValueError, OverflowError):
            coordinates = []
        if len(coordinates) != 3 or not all(map(math.isfinite, coordinates)):
            raise InstrumentError(
                f"{self._where}: expected a {what} of three finite numbers X, Y, Z; found {point!r}",
                code="position.form",
            )
        for axis, x in zip("XYZ", coordinates, strict=True):
            self.coordinate(axis, x)
        return coordinates

    def extent(self, displacement: Sequence[float], what: str) -> None:
        """Raise InstrumentError unless a displacement, (3,) m, is finite and fits between the limits of each axis."""
        if len(displacement) != 3 or not all(map(math.isfinite, displacement)):
            raise InstrumentError(
                f"{self._where}: expected {what} of three finite numbers X, Y, Z; found {displacement!r}",
                code="position.form",
            )
        for axis, x in zip("XYZ", displacement, strict=True):
            span = self.limits.spans.get(axis)
            if span is not None and abs(x) > span[1] - span[0] + _ROUNDING:
                raise InstrumentError(
                    f"{self._where}: {axis} would move by {1e3 * abs(x):.6g} mm; the limits of the bench are "
                    f"{1e3 * (span[1] - span[0]):.6g} mm apart. Nothing was sent",
                    code="motion.limit.position",
                )

    def coordinate(self, axis: str, x: float) -> None:
        """Raise InstrumentError if the coordinate of an axis, m, is outside the limits."""
        span = self.limits.spans.get(axis)
        if not math.isfinite(x) or (span is not None and not span[0] - _ROUNDING <= x <= span[1] + _ROUNDING):
            low, high = (1e3 * each for each in span or (-math.inf, math.inf))
            raise InstrumentError(
                f"{self._where}: {axis} would move to {1e3 * x:.6g} mm; the limits of the bench are {low:.6g} and "
                f"{high:.6g} mm. Nothing was sent",
                code="motion.limit.position",
            )

    def feed(self, feed: float) -> float:
        """Return a feed, m/s; InstrumentError unless it is finite, above 0 and within the limits."""
        return self._bounded(feed, "feed", self.limits.feed, 6e4, "mm/min", positive=True)

    def speed(self, speed: float) -> float:
        """Return a spindle speed, 1/min; InstrumentError unless it is finite and within the limits."""
        return self._bounded(speed, "spindle speed", self.limits.spindle_speed, 1.0, "/min")

    def duration(self, seconds: float) -> float:
        """Return a time, s; InstrumentError unless it is finite."""
        return self._bounded(seconds, "time", None, 1.0, "s")

    def _bounded(
        self, value: float, what: str, limit: float | None, scale: float, unit: str, positive: bool = False
    ) -> float:
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if not math.isfinite(number * scale) or (positive and number <= 0):
            above = " above 0" if positive else ""
            raise InstrumentError(
                f"{self._where}: expected a finite {what}{above}; found {str(value)[:60]}. Nothing was sent",
                code="motion.value.form",
            )
        if limit is not None and abs(number) > limit * (1 + _ROUNDING):
            raise InstrumentError(
                f"{self._where}: the {what} would be {number * scale:.6g} {unit}; the limit of the bench is "
                f"{limit * scale:.6g} {unit}. Nothing was sent",
                code="motion.limit.value",
            )
        return number


class OffsetInterlock:
    """Checks offsets; refuses all of them while it is not armed.

    Parameters
    ----------
    where : str
        Compensator and address, for messages.

    Attributes
    ----------
    limit : float
        Largest offset of each axis, m; 0: not armed.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self.limit = 0.0

    def arm(self, limit: float) -> None:
        """Permit offsets up to a limit for each axis, m.

        Raises
        ------
        InstrumentError
            The limit is not above 0, or not finite.
        """
        if not (math.isfinite(limit) and limit > 0):
            raise InstrumentError(
                f"{self._where}: expected a limit of the offsets above 0; found {limit!r}",
                code="offset.limit.not_positive",
            )
        self.limit = float(limit)

    def disarm(self) -> None:
        """Refuse all offsets from now on."""
        self.limit = 0.0

    def offset(self, values: Sequence[float]) -> tuple[float, float, float]:
        """Return the offset of X, Y, Z, m.

        Raises
        ------
        InstrumentError
            The driver is not armed, or the values are not three finite numbers within the limit.
        """
        if not self.limit:
            raise InstrumentError(
                f"{self._where} is not armed; it only reads. Nothing was sent", code="instrument.not_armed"
            )
        try:
            numbers = [float(value) for value in values]
        except (TypeError, ValueError, OverflowError):
            numbers = []
        if len(numbers) != 3 or not all(map(math.isfinite, numbers)):
            raise InstrumentError(
                f"{self._where}: expected offsets of three finite numbers X, Y, Z; found {str(values)[:80]}. Nothing "
                "was sent",
                code="offset.form",
            )
        if max(map(abs, numbers)) > self.limit * (1 + ROUNDING):
            texts = ", ".join(f"{value * 1e6:.6g}" for value in numbers)
            raise InstrumentError(
                f"{self._where}: an offset of {texts} um is beyond the limit of {self.limit * 1e6:g} um. Nothing was "
                "sent",
                code="offset.beyond_limit",
            )
        return numbers[0], numbers[1], numbers[2]
