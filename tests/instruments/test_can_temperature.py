"""CANopen thermometers: objects of CiA 404, a node on a bus, and every fault."""

import itertools
import math
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import can
import canopen
import pytest
from canopen.objectdictionary import ODRecord, ODVariable, datatypes
from canopen.sdo.exceptions import SdoAbortedError
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.simulators import world
from errormotion.instruments.thermometer.can_temperature import CanSettings, CanTemperature
from errormotion.instruments.thermometer.cia404 import (
    CELSIUS,
    KELVIN,
    decode_unsigned,
    decode_value,
    flag_of,
    to_celsius,
)
from errormotion.instruments.transports.can.bus import SdoRefusal

ADDRESS = "sim://cframe/can?seed=3&node=5"
# long enough for the pauses of a garbage collection (0.3 s on a slow computer), during which no simulator answers
QUICK = CanSettings(timeout=0.7, retry=0.05)
NAMES = ("frame", "ambient", "spindle_front", "spindle_rear", "column")


# ---------------------------------------------------------------------- objects


@given(st.floats(width=32, allow_nan=False))
def test_values_come_back(value: float) -> None:
    assert decode_value(struct.pack("<f", value)) == value


@given(st.binary(max_size=8).filter(lambda data: len(data) != 4))
def test_a_value_of_another_size_is_refused(data: bytes) -> None:
    with pytest.raises(ProtocolError, match="float of 4 bytes"):
        decode_value(data)


@given(st.integers(1, 4).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, 256**n - 1))))
def test_numbers_come_back(given_number: tuple[int, int]) -> None:
    size, number = given_number
    assert decode_unsigned(number.to_bytes(size, "little"), 0x1000) == number


def test_units_are_degrees_or_kelvins_with_a_prefix() -> None:
    assert to_celsius(CELSIUS) == (1.0, 0.0)
    assert to_celsius(0xFF2D0000) == (pytest.approx(0.1), 0.0)
    assert to_celsius(KELVIN) == (1.0, -273.15)
    assert to_celsius(0xFD050000) == (pytest.approx(1e-3), -273.15)
    with pytest.raises(InstrumentError, match="unit of the input is 0x00220000; expected degC"):
        to_celsius(0x00220000)  # pascal


def test_the_status_tells_open_from_shorted() -> None:
    assert [flag_of(status, 20.0) for status in (0, 1, 2, 3, 4, 5)] == [
        *("", "out of range", "open", "open", "shorted", "shorted")
    ]
    assert flag_of(0, math.nan) == "out of range"


def test_inputs_are_one_for_each_channel() -> None:
    assert CanSettings(channels=("a", "b"), inputs=(4, 2)).subindices == (4, 2)
    assert CanSettings(channels=("a", "b")).subindices == (1, 2)
    with pytest.raises(ValidationError, match="one for each of the 5 channels; found 1"):
        CanSettings(inputs=(1,))
    with pytest.raises(ValidationError, match="subindices from 1 to 254; found 0"):
        CanSettings(channels=("a",), inputs=(0,))


# ---------------------------------------------------------------------- a node of somebody else

_channels = itertools.count(1)


@contextmanager
def a_node(entries: dict[tuple[int, int], tuple[int, Any]], node: int = 9) -> Iterator[tuple[str, Any]]:
    """Put a node of canopen on a bus; give its address and the node. An entry that is an exception is raised."""
    dictionary = canopen.ObjectDictionary()
    for index in {index for index, _ in entries}:
        group = ODRecord(f"object {index:x}", index)
        for (at, subindex), (kind, _) in entries.items():
            if at == index:
                variable = ODVariable(f"{index:x} {subindex}", index, subindex)
                variable.data_type = kind
                group.add_member(variable)
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


def two_inputs(**changed: Any) -> dict[tuple[int, int], tuple[int, Any]]:
    u8, u32, f32 = datatypes.UNSIGNED8, datatypes.UNSIGNED32, datatypes.REAL32
    entries: dict[tuple[int, int], tuple[int, Any]] = {
        (0x1000, 0): (u32, changed.get("device", 0x0002_0194)),
        (0x1018, 1): (u32, 0x1234),
        (0x1018, 2): (u32, 8),
        (0x1018, 4): (u32, 4711),
        (0x6131, 1): (u32, CELSIUS),
        (0x6131, 2): (u32, changed.get("unit", KELVIN)),
        (0x6130, 1): (f32, 20.25),
        (0x6130, 2): (f32, changed.get("second", 300.0)),
    }
    if changed.get("status", True):
        entries |= {(0x6150, i): (u8, changed.get("second_status", 0) if i == 2 else 0) for i in range(3)}
    return entries


TWO = CanSettings(channels=("air", "bed"), timeout=0.7)


@pytest.mark.parametrize("status", [True, False])
def test_reads_a_node_in_its_own_units(status: bool) -> None:
    with a_node(two_inputs(status=status)) as (address, _), CanTemperature(address, TWO) as thermometer:
        identity = thermometer.identify()
        assert (identity.manufacturer, identity.model) == ("CiA vendor 0x00001234", "product 8")
        assert (identity.serial_number, identity.simulated) == ("4711", False)
        assert thermometer.read() == {"air": 20.25, "bed": pytest.approx(26.85, abs=1e-4)}
        assert thermometer.flags == {"air": "", "bed": ""}


def test_a_stated_unit_can_be_overruled() -> None:
    with a_node(two_inputs(unit=0)) as (address, _):
        with pytest.raises(InstrumentError, match="unit of the input is 0x00000000"):
            CanTemperature(address, TWO).open()
        with CanTemperature(address, TWO.model_copy(update={"unit": "degC"})) as thermometer:
            assert thermometer.read()["bed"] == 300.0


def test_an_input_without_a_value_is_nan_and_the_others_go_on() -> None:
    with (
        a_node(two_inputs(second=SdoAbortedError(0x06060000))) as (address, _),
        CanTemperature(address, TWO) as thermometer,
    ):
        reading = thermometer.read()
        assert reading["air"] == 20.25
        assert math.isnan(reading["bed"])
        assert thermometer.flags == {"air": "", "bed": "no answer"}


def test_an_input_that_does_not_exist_is_an_error_with_its_abort_code() -> None:
    settings = TWO.model_copy(update={"inputs": (1, 7), "unit": "degC"})
    with (
        a_node(two_inputs()) as (address, _),
        CanTemperature(address, settings) as thermometer,
        pytest.raises(SdoRefusal, match=r"0x6130:7 is refused: Code 0x06090011, Subindex does not exist") as refusal,
    ):
        thermometer.read()
    assert refusal.value.code == 0x06090011


def test_a_node_of_another_profile_is_refused() -> None:
    with (
        a_node(two_inputs(device=401)) as (address, _),
        pytest.raises(InstrumentError, match="node 9 follows the profile CiA 401; expected CiA 404"),
    ):
        CanTemperature(address, TWO).open()


def test_a_missing_node_is_told_by_its_silence() -> None:
    with (
        a_node(two_inputs()) as (address, _),
        pytest.raises(InstrumentTimeoutError, match=r"node 8 did not answer .* no heartbeat was received"),
    ):
        CanTemperature(address.replace("node=9", "node=8"), TWO).open()


def test_heartbeats_tell_the_state_and_the_node_is_started_when_asked_to() -> None:
    with a_node(two_inputs()) as (address, local):
        with CanTemperature(address, TWO) as thermometer:
            assert thermometer.state == ""
            local.network.send_message(0x709, [127])
            await_state(thermometer, "PRE-OPERATIONAL")
        with CanTemperature(address, TWO.model_copy(update={"start": True})) as thermometer:
            thermometer.read()
            assert local.nmt.state == "OPERATIONAL"


def await_state(thermometer: CanTemperature, state: str) -> None:
    end = time.monotonic() + 10
    while thermometer.state != state:
        assert time.monotonic() < end, thermometer.state
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("tcp://127.0.0.1:9", "Expected an address on a CAN bus"),
        ("can://virtual", "Expected can://INTERFACE/CHANNEL"),
        ("can://virtual/x?node=0", "expected 1 to 127; found 0"),
        ("can://virtual/x?node=128", "from 0 to 127; found 128"),
        ("can://no_such_interface/x?node=1", "cannot be opened"),
        ("can://socketcan/no_such_channel?node=1", "cannot be opened"),
        (f"{ADDRESS}&bus=lin", "expected 'virtual' or 'udp_multicast'; found 'lin'"),
        (f"{ADDRESS}&sensors=coffee", "found coffee"),
    ],
)
def test_a_wrong_address_says_what_is_expected(address: str, message: str) -> None:
    with pytest.raises(InstrumentError, match=message):
        CanTemperature(address, QUICK).open()


# ---------------------------------------------------------------------- the simulator


@pytest.mark.parametrize("unit", [CELSIUS, KELVIN, 0xFF2D0000])
def test_temperatures_are_the_twins(unit: int) -> None:
    with CanTemperature(f"{ADDRESS}&noise=0&unit={unit:#x}") as thermometer:
        reading = thermometer.read()
        twin = world("cframe", 3).machine
        truth = dict(zip(twin.temperature_sensors, twin.temperatures([0.0])[0], strict=True))
        assert thermometer.identify().simulated
    assert tuple(reading) == NAMES
    for name, value in reading.items():
        assert value == pytest.approx(truth[name], abs=2e-5)  # 24 bits of a float near 300 K


def test_open_and_shorted_sensors_are_nan_with_a_flag() -> None:
    with CanTemperature(f"{ADDRESS}&open=1&shorted=3") as thermometer:
        assert set(thermometer.flags.values()) == {"not read"}
        reading = thermometer.read()
        assert [name for name, value in reading.items() if math.isnan(value)] == ["ambient", "spindle_rear"]
        assert list(thermometer.flags.values()) == ["", "open", "", "shorted", ""]


SERVER = """
import sys
from errormotion.instruments.transports.can.serving import CanopenServer, Entry
entries = [Entry(0x1000, "type", "u32"), Entry(0x1018, "identity", "u32", 4), Entry(0x6130, "value", "f32", 2),
           Entry(0x6131, "unit", "u32", 2), Entry(0x6150, "status", "u8", 2)]
known = {(0x1000, 0): 404, (0x6130, 1): 20.25, (0x6130, 2): -3.5, (0x6150, 2): 2}
bus = {"interface": "udp_multicast", "channel": "239.74.163.2", "port": int(sys.argv[1]), "hop_limit": 0}
value = lambda index, subindex: known.get((index, subindex), 0x2D0000 if index == 0x6131 else 0)
node = CanopenServer(5, entries, value, lambda data: data, bus=bus, heartbeat=0.05)
print(node.url, flush=True)
sys.stdin.read()
node.close()
"""


def test_a_node_in_another_process_is_read_over_multicast() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        port = free.getsockname()[1]
    with subprocess.Popen(
        [sys.executable, "-c", SERVER, str(port)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        assert url.startswith("can://udp_multicast/239.74.163.2?node=5")
        with CanTemperature(url, TWO.model_copy(update={"timeout": 5.0})) as thermometer:
            reading = thermometer.read()
            assert reading["air"] == 20.25
            assert thermometer.flags == {"air": "", "bed": "open"}
            await_state(thermometer, "OPERATIONAL")
        process.communicate()
    assert process.returncode == 0


# ---------------------------------------------------------------------- faults

BEFORE = 25  # answers until a first reading is over: 9 for the identity, 5 units, 1 state; 10 for the reading


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        (
            "silence",
            InstrumentTimeoutError,
            "node 5 did not answer within 0.7 s; its last heartbeat stated OPERATIONAL",
        ),
        ("drop", InstrumentTimeoutError, "node 5 did not answer"),
        ("unplugged", InstrumentTimeoutError, "node 5 did not answer"),
        ("stopped", InstrumentTimeoutError, "its last heartbeat stated"),
        ("garbage", ProtocolError, "node 5, 0x6130:1"),
        ("bus_off", InstrumentError, "the controller is bus-off"),
        ("abort&code=0x08000000", SdoRefusal, "0x6130:1 is refused: Code 0x08000000, General error"),
    ],
)
def test_each_fault_is_a_state_of_its_own(fault: str, error: type[InstrumentError], message: str) -> None:
    at = f"&fault={fault}&fault_at={BEFORE}&heartbeat=0.02"
    with CanTemperature(ADDRESS + at, QUICK) as thermometer:
        await_state(thermometer, "OPERATIONAL")
        assert all(math.isfinite(value) for value in thermometer.read().values())
        with pytest.raises(error, match=message) as raised:
            thermometer.read()
        assert type(raised.value) is error
        assert set(thermometer.flags.values()) == {"no answer"}


def test_a_stopped_node_says_so_in_its_heartbeat() -> None:
    at = f"&fault=stopped&fault_at={BEFORE}&heartbeat=0.02"
    with CanTemperature(ADDRESS + at, QUICK) as thermometer:
        thermometer.read()
        with pytest.raises(InstrumentTimeoutError):
            thermometer.read()
        await_state(thermometer, "STOPPED")
        with pytest.raises(InstrumentTimeoutError, match="its last heartbeat stated STOPPED"):
            thermometer.read()


@pytest.mark.parametrize("fault", ["unplugged", "bus_off"])
def test_a_node_that_was_away_is_heard_again_by_itself(fault: str) -> None:
    at = f"&fault={fault}&fault_at={BEFORE}&unplugged_for=1.6"
    with CanTemperature(ADDRESS + at, QUICK) as thermometer:
        before = thermometer.read()
        gaps, end = 0, time.monotonic() + 20
        while time.monotonic() < end:
            try:
                after = thermometer.read()
                break
            except InstrumentError:
                gaps += 1
                time.sleep(0.02)
        assert gaps >= 2
        assert after == pytest.approx(before, abs=0.2)  # ten sigma of 0.02 K
        assert set(thermometer.flags.values()) == {""}


def test_a_controller_that_is_bus_off_is_tried_again_at_a_limited_rate() -> None:
    settings = QUICK.model_copy(update={"retry": 60.0})
    with CanTemperature(f"{ADDRESS}&fault=bus_off&fault_at={BEFORE}", settings) as thermometer:
        thermometer.read()
        with pytest.raises(InstrumentError, match="bus-off"):
            thermometer.read()
        with pytest.raises(InstrumentError, match=r"bus-off; the next attempt is in (60|5\d)\.\d s"):
            thermometer.read()


# ---------------------------------------------------------------------- recordings


def test_a_recorded_session_plays_back(tmp_path: Path) -> None:
    path = tmp_path / "can.rec"
    with CanTemperature(f"{ADDRESS}&open=1&heartbeat=0.01", QUICK, record=path) as thermometer:
        identity = thermometer.identify()
        readings = [thermometer.read() for _ in range(3)]
    assert any(line.startswith("R") and " 00000705" in line for line in path.read_text().splitlines())  # a heartbeat
    with CanTemperature(f"replay://{path}", QUICK) as thermometer:
        assert thermometer.identify().serial_number == identity.serial_number
        assert str([thermometer.read() for _ in range(3)]) == str(readings)
        assert thermometer.flags["ambient"] == "open"
        assert thermometer.node.node == 5


def test_a_recorded_session_that_goes_on_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "can.rec"
    with CanTemperature(ADDRESS, QUICK, record=path) as thermometer:
        thermometer.read()
    with pytest.raises(InstrumentError, match="before the end of"), CanTemperature(f"replay://{path}", QUICK):
        pass
