"""The device end of a CAN bus: a local node of `canopen`, unchanged, on a python-can bus."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import can
import canopen
from canopen.nmt import NMT_STATES
from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes
from canopen.sdo.exceptions import SdoAbortedError

from errormotion.instruments.transports.can.bus import BUS_OFF

TYPES = {"u8": datatypes.UNSIGNED8, "u16": datatypes.UNSIGNED16, "u32": datatypes.UNSIGNED32}
TYPES |= {"f32": datatypes.REAL32, "text": datatypes.VISIBLE_STRING}
_channels = itertools.count(1)


@dataclass(frozen=True)
class Entry:
    """One object of the dictionary: a variable (``size`` 0), or an array with ``size`` entries from subindex 1 on."""

    index: int
    name: str
    kind: str
    size: int = 0


class CanopenServer:
    """A CANopen node on a bus, read by SDO.

    Parameters
    ----------
    node : int
    entries : sequence of Entry
        Its object dictionary.
    value : callable
        ``value(index, subindex)`` returns the present value of an entry, or None where unknown; it raises
        `Refused` to abort.
    outgoing : callable
        ``outgoing(data)`` returns the SDO answer as it is sent, or None for no answer.
    bus : mapping, optional
        Arguments of `can.Bus`; default: a bus of its own inside this process.
    heartbeat : float
        Period, s; 0: none.

    Attributes
    ----------
    url : str
        Address of the node for the driver.
    """

    def __init__(
        self,
        node: int,
        entries: Sequence[Entry],
        value: Callable[[int, int], Any],
        outgoing: Callable[[bytes], bytes | None],
        *,
        bus: Mapping[str, Any] | None = None,
        heartbeat: float = 0.0,
    ) -> None:
        bus = bus or {"interface": "virtual", "channel": f"sim-{next(_channels)}"}
        further = "".join(f"&{key}={each}" for key, each in bus.items() if key not in ("interface", "channel"))
        self.url = f"can://{bus['interface']}/{bus['channel']}?node={node}{further}"
        self._network = _FaultyNetwork(0x580 + node, outgoing)
        self._bus = self._network.bus = can.Bus(**bus, ignore_config=True)
        self._network.connect()
        library: Any = canopen  # partly without types
        self._node = library.LocalNode(node, _dictionary(entries))
        self._value = value
        self._node.add_read_callback(self._read)
        self._network.add_node(self._node)
        self._heartbeat = heartbeat
        self._quiet = False
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._beat, name=f"sim-can-{node}", daemon=True)
        self.boot()
        if heartbeat > 0:
            self._thread.start()

    def boot(self) -> None:
        """Announce the node on the bus, and go to the state OPERATIONAL."""
        self._node.nmt.send_command(129)
        self._node.nmt.send_command(1)
        self._quiet = False

    def stop(self) -> None:
        """Go to the state STOPPED."""
        self._node.nmt.send_command(2)

    def stop_heartbeat(self) -> None:
        """Send no heartbeat until the next boot."""
        self._quiet = True

    def send_bus_off(self) -> None:
        """Have every controller on the bus report that it is bus-off."""
        message = can.Message(arbitration_id=BUS_OFF, is_error_frame=True, is_extended_id=False, data=bytes(8))
        with suppress(can.CanError):
            self._bus.send(message)

    def close(self) -> None:
        """Leave the bus; idempotent."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()
        self._network.disconnect()

    def _beat(self) -> None:
        """Send heartbeats; the library's own thread for it cannot be waited for."""
        codes = {name: code for code, name in NMT_STATES.items()}
        while not self._ended.wait(self._heartbeat):
            if not self._quiet:
                with suppress(can.CanError):
                    self._network.send_message(0x700 + self._node.id, bytes((codes[self._node.nmt.state],)))

    def _read(self, index: int, subindex: int, od: Any) -> Any:  # noqa: ARG002 - the library's signature
        return self._value(index, subindex)


class Refused(SdoAbortedError):  # noqa: N818 - that is what it is
    """The node answers with an SDO abort code."""


class _FaultyNetwork(canopen.Network):
    """A network whose SDO answers pass through a function of the simulator."""

    NOTIFIER_CYCLE = 0.05

    def __init__(self, cob_id: int, outgoing: Callable[[bytes], bytes | None]) -> None:
        super().__init__()
        self._cob_id, self._outgoing = cob_id, outgoing

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        if can_id == self._cob_id:
            changed = self._outgoing(bytes(data))
            if changed is None:
                return
            data = changed
        super().send_message(can_id, data, remote)


def _dictionary(entries: Sequence[Entry]) -> Any:
    library: Any = canopen
    dictionary = library.ObjectDictionary()
    for entry in entries:
        if not entry.size:
            dictionary.add_object(_variable(entry, 0, entry.kind))
            continue
        group = ODArray(entry.name, entry.index) if entry.index >= 0x2000 else ODRecord(entry.name, entry.index)
        for subindex in range(entry.size + 1):
            group.add_member(_variable(entry, subindex, entry.kind if subindex else "u8"))
        dictionary.add_object(group)
    return dictionary


def _variable(entry: Entry, subindex: int, kind: str) -> ODVariable:
    variable = ODVariable(f"{entry.name} {subindex}", entry.index, subindex)
    variable.data_type = TYPES[kind]
    return variable
