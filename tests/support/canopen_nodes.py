"""CANopen nodes of the package canopen for tests: an implementation that shares nothing with the driver."""

import itertools
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import can
import canopen
from canopen.objectdictionary import ODRecord, ODVariable, datatypes

from errormotion.instruments.thermometer.can_temperature import CanSettings, CanTemperature
from errormotion.instruments.thermometer.cia404 import CELSIUS, KELVIN

_channels = itertools.count(1)
U8, U16, U32 = datatypes.UNSIGNED8, datatypes.UNSIGNED16, datatypes.UNSIGNED32
I16, I32, F32 = datatypes.INTEGER16, datatypes.INTEGER32, datatypes.REAL32
Entries = dict[tuple[int, int], tuple[int, Any]]

TWO = CanSettings(channels=("air", "bed"), timeout=0.7)
ONE = CanSettings(channels=("air",), timeout=0.7)

CONSTANTS = {
    (0x1000, 0): 0x20194,
    (0x1001, 0): 0,
    (0x1018, 1): 1,
    (0x1018, 2): 2,
    (0x1018, 4): 3,
    (0x6131, 1): CELSIUS,
}


@contextmanager
def a_node(entries: Entries, node: int = 9) -> Iterator[tuple[str, Any]]:
    """Put a node of canopen on a bus; yield its address and the node. An entry that is an exception is raised.

    An object with subindex 0 only is a variable.
    """
    dictionary = canopen.ObjectDictionary()
    for index in sorted({index for index, _ in entries}):
        own = {subindex: kind for (at, subindex), (kind, _) in entries.items() if at == index}
        members = []
        for subindex, kind in own.items():
            member = ODVariable(f"{index:x} {subindex}", index, subindex)
            member.data_type = kind
            member.default = entries[index, subindex][1]
            members.append(member)
        if list(own) == [0]:
            dictionary.add_object(members[0])
            continue
        group = ODRecord(f"object {index:x}", index)
        for member in members:
            group.add_member(member)
        dictionary.add_object(group)

    def value(index: int, subindex: int, od: Any) -> Any:
        found = entries[index, subindex][1]
        if isinstance(found, Exception):
            raise found
        return found

    channel = f"test-{next(_channels)}"
    network = canopen.Network(can.Bus(interface="virtual", channel=channel, ignore_config=True))
    network.NOTIFIER_CYCLE = 0.05
    network.connect()
    try:
        local = canopen.LocalNode(node, dictionary)
        local.add_read_callback(value)
        network.add_node(local)
        yield f"can://virtual/{channel}?node={node}", local
    finally:
        network.disconnect()


def a_device(device: int = 0x0002_0194) -> Entries:
    return {
        (0x1000, 0): (U32, device),
        (0x1001, 0): (U8, 0),
        (0x1018, 0): (U8, 4),
        (0x1018, 1): (U32, 0x1234),
        (0x1018, 2): (U32, 8),
        (0x1018, 4): (U32, 4711),
    }


def two_inputs(**changed: Any) -> Entries:
    entries = a_device(changed.get("device", 0x0002_0194)) | {
        (0x6131, 1): (U32, CELSIUS),
        (0x6131, 2): (U32, changed.get("unit", KELVIN)),
        (0x6130, 1): (F32, 20.25),
        (0x6130, 2): (F32, changed.get("second", 300.0)),
    }
    if changed.get("status", True):
        entries |= {(0x6150, i): (U8, changed.get("second_status", 0) if i == 2 else 0) for i in range(3)}
    return entries


def await_state(thermometer: CanTemperature, state: str) -> None:
    await_that(lambda: thermometer.state == state)


def await_that(holds: Any) -> None:
    end = time.monotonic() + 10
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.005)


def sent(entries: Entries, number: int, mapped: list[int], *, transmission: int, timer: int = 0, node: int = 9) -> None:
    """Add a PDO to the entries of a node; ``timer`` in ms."""
    communication, mapping = 0x1800 + number, 0x1A00 + number
    entries[communication, 0] = (U8, 5)
    entries[communication, 1] = (U32, 0x180 + 0x100 * number + node)
    entries[communication, 2] = (U8, transmission)
    entries[communication, 3] = (U16, 0)
    entries[communication, 5] = (U16, timer)
    entries[mapping, 0] = (U8, len(mapped))
    for i, entry in enumerate(mapped):
        entries[mapping, 1 + i] = (U32, entry)


@contextmanager
def sending(local: Any, *, at_sync: bool) -> Iterator[list[int]]:
    """Have a node of canopen send the PDOs that its dictionary describes; yield a list that counts SYNC."""
    local.tpdo.read(from_od=True)
    syncs = [0]

    ended = threading.Event()

    def transmit(pdos: Any) -> None:
        for pdo in pdos:
            fill(local, pdo)
            pdo.transmit()

    def on_sync(can_id: int, data: bytes, timestamp: float) -> None:
        syncs[0] += 1
        if at_sync:
            transmit(pdo for pdo in local.tpdo.values() if syncs[0] % pdo.trans_type == 0)

    def send_at_an_interval() -> None:
        while not (at_sync or ended.wait(0.02)):
            transmit(local.tpdo.values())

    local.network.subscribe(0x80, on_sync)
    thread = threading.Thread(target=send_at_an_interval, name="test-pdo", daemon=True)
    thread.start()
    try:
        yield syncs
    finally:
        ended.set()
        thread.join()
        local.network.unsubscribe(0x80)


def fill(local: Any, pdo: Any) -> None:
    for variable in pdo:
        variable.set_data(local.get_data(variable.index, variable.subindex))


def count_reads(local: Any) -> list[tuple[int, int]]:
    """Return a list to which every entry that is read by SDO from now on is added."""
    asked: list[tuple[int, int]] = []
    network, before = local.network, local.sdo.on_request

    def note(can_id: int, data: bytearray, timestamp: float) -> None:
        if data[0] == 0x40:
            asked.append(struct.unpack_from("<HB", data, 1))
        before(can_id, data, timestamp)

    network.unsubscribe(local.sdo.rx_cobid, before)
    network.subscribe(local.sdo.rx_cobid, note)
    return asked


@contextmanager
def a_server(answers: Any, node: int = 9) -> Iterator[str]:
    """Put a server on a bus that answers one request after another.

    ``answers(number, index, subindex)`` yields delay (s) and frame of each answer.
    """
    channel = f"test-{next(_channels)}"
    bus = can.Bus(interface="virtual", channel=channel, ignore_config=True)
    ended = threading.Event()

    def serve() -> None:
        number = 0
        while not ended.is_set():
            message = bus.recv(0.02)
            if message is None or message.arbitration_id != 0x600 + node or message.data[0] != 0x40:
                continue
            for delay, frame in answers(number, *struct.unpack_from("<HB", message.data, 1)):
                ended.wait(delay)
                bus.send(can.Message(arbitration_id=0x580 + node, data=frame, is_extended_id=False))
            number += 1

    thread = threading.Thread(target=serve, name="test-server", daemon=True)
    thread.start()
    try:
        yield f"can://virtual/{channel}?node={node}"
    finally:
        ended.set()
        thread.join()
        bus.shutdown()


def reply(index: int, subindex: int, value: float | None) -> bytes:
    """Return an answer; of an entry that is not there an abort."""
    if value is None:
        return struct.pack("<BHBI", 0x80, index, subindex, 0x06020000)
    kind = "<f" if index == 0x6130 else "<I"
    return struct.pack("<BHB", 0x43, index, subindex) + struct.pack(kind, value)
