"""The last check of an offset before it is sent: the driver is armed, three finite numbers, within the limit."""

from __future__ import annotations

import math
from collections.abc import Sequence

from errormotion.errors import InstrumentError

ROUNDING = 1e-9
"""Fraction of the limit by which an offset may exceed it."""


class OffsetDoor:
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
            found = [float(value) for value in values]
        except (TypeError, ValueError, OverflowError):
            found = []
        if len(found) != 3 or not all(map(math.isfinite, found)):
            raise InstrumentError(
                f"{self._where}: expected offsets of three finite numbers X, Y, Z; found {str(values)[:80]}. Nothing "
                "was sent",
                code="offset.form",
            )
        if max(map(abs, found)) > self.limit * (1 + ROUNDING):
            texts = ", ".join(f"{value * 1e6:.6g}" for value in found)
            raise InstrumentError(
                f"{self._where}: an offset of {texts} um is beyond the limit of {self.limit * 1e6:g} um. Nothing was "
                "sent",
                code="offset.beyond_limit",
            )
        return found[0], found[1], found[2]
