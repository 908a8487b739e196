"""The right to write offsets, held by a number in the machine, so that programs on other computers see it."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from contextlib import suppress

from errormotion.errors import InstrumentError

FREE = 0
LARGEST = (1 << 15) - 1
"""Largest number of an owner; it fits into 16 bits with sign."""
SETTLING = 0.3
"""Time after which the own number must still be there, s: two programs that found no owner have both written theirs."""

NO_OWNER = (
    "The machine states no owner of its offsets (setting 'owner' of the compensator): a compensation on another "
    "computer is not refused."
)


class Owner:
    """The right to write offsets; a number of the machine is the number of its owner, or 0.

    The number is compared before each write. The program of the machine sets it to 0 when its watchdog ends a
    compensation, so that the right of a killed program ends.

    Parameters
    ----------
    where : str
        Compensator and address, for messages.
    read : callable
        Returns the number in the machine.
    write : callable
        Writes it.
    """

    def __init__(self, where: str, read: Callable[[], int], write: Callable[[int], None]) -> None:
        self._where, self._read, self._write = where, read, write
        self.number = 1 + secrets.randbelow(LARGEST)
        self._held = False

    def take(self) -> None:
        """Become the owner.

        Raises
        ------
        InstrumentError
            Another program is the owner, or the number cannot be read or written.
        """
        self._refuse_other(self._read())
        self._write(self.number)
        time.sleep(SETTLING)
        self._refuse_other(self._read(), free=False)
        self._held = True

    def require(self) -> None:
        """Compare the owner before a write; if the watchdog of the machine has ended the right, take it again.

        Raises
        ------
        InstrumentError
            Another program is the owner now; or as for `take`.
        """
        number = self._read()
        if number == FREE:
            self.take()
        self._refuse_other(number)

    def release(self) -> None:
        """Give the right back; a lost connection is ignored, since the watchdog of the machine then ends it."""
        held, self._held = self._held, False
        if held:
            with suppress(InstrumentError):
                if self._read() == self.number:
                    self._write(FREE)

    def _refuse_other(self, number: int, *, free: bool = True) -> None:
        if number == self.number or (free and number == FREE):
            return
        raise InstrumentError(
            f"{self._where}: another program writes the offsets of this machine, maybe on another computer: their "
            f"owner is {number}, this program is {self.number}. No offset was sent. Stop the other one; if it was "
            "killed, the program of the machine sets the owner to 0 as its watchdog ends the compensation",
            code="offset.owner.other",
        )
