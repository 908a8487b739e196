"""The fault menu: what can go wrong at a device, chosen by parameters of its address.

``fault=`` one of

* ``silence``: it sends nothing any more
* ``split``: everything comes in pieces of a few bytes
* ``garbage``: stray bytes between the right ones
* ``checksum``: wrong checksums, where the protocol has one
* ``out_of_range``: nothing to measure
* ``drop``: samples, or answers, are missing
* ``disconnect``: the connection breaks; it can be opened again

``fault_at`` is the sample (of a stream) or answer (of others) from which on; default 0. A silence without ``fault_at``
starts before the first answer. ``fault_every`` is the period of ``garbage`` and ``drop``, ``fault_for`` how many
samples ``out_of_range`` lasts (default: without end).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.transports import Address

FAULTS = ("silence", "split", "garbage", "checksum", "out_of_range", "drop", "disconnect")


@dataclass
class Fault:
    """One entry of the menu, and where it starts.

    Attributes
    ----------
    kind : str
        Empty: none.
    at : int
        Sample or answer from which on.
    every : int
        Period.
    length : int
        Samples; 0 = without end.
    from_the_start : bool
        Whether ``fault_at`` was left out.
    """

    kind: str = ""
    at: int = 0
    every: int = 1
    length: int = 0
    from_the_start: bool = False

    def hits(self, kind: str, number: int) -> bool:
        """Whether a sample or answer of this number has this fault."""
        if kind != self.kind or number < self.at:
            return False
        return (number - self.at) % self.every == 0

    def pieces(self, data: bytes) -> Iterator[bytes]:
        """Yield what goes out at once: all, or with ``split`` 1 to 7 bytes at first, then a good many, but never whole.

        A thousand and nine is a prime: no frame's length divides it.
        """
        if self.kind != "split":
            yield data
            return
        place = count = 0
        while place < len(data):
            size = count % 7 + 1 if count < 50 else 1009
            yield data[place : place + size]
            place, count = place + size, count + 1


def parse_fault(address: Address, offered: tuple[str, ...], *, every: int = 1) -> Fault:
    """Return the fault that an address requests.

    Raises
    ------
    InstrumentError
        Not on the menu, or not for this device.
    """
    kind = address.params.get("fault", "")
    if not kind:
        return Fault()
    if kind not in offered:
        why = "this device has no such thing" if kind in FAULTS else "there is no such fault"
        raise InstrumentError(f"'fault={kind}' in '{address.url}': {why}; choose from {', '.join(offered)}")
    return Fault(
        kind,
        at=int(address.number("fault_at", 0)),
        every=max(1, int(address.number("fault_every", every))),
        length=int(address.number("fault_for", 0)),
        from_the_start="fault_at" not in address.params,
    )


def stray_bytes(rng: np.random.Generator, most: int = 5) -> bytes:
    """Return one to ``most`` random bytes."""
    return rng.integers(0, 256, rng.integers(1, most + 1), dtype=np.uint8).tobytes()
