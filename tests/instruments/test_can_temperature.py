"""CANopen thermometers: nodes of the package canopen, the simulated node, and every fault."""

import math
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from canopen.objectdictionary import datatypes
from canopen.sdo.exceptions import SdoAbortedError
from canopen_nodes import F32, I16, I32, ONE, TWO, U8, U32, a_device, a_node, await_state, await_that, two_inputs
from coded import raises
from pydantic import ValidationError

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.simulators import world
from errormotion.instruments.thermometer.can_temperature import CanSettings, CanTemperature
from errormotion.instruments.thermometer.cia404 import CELSIUS, KELVIN
from errormotion.instruments.transports.can.bus import SdoRefusal

ADDRESS = "sim://cframe/can?seed=3&node=5"
# long enough for the pauses of a garbage collection (0.3 s on a slow computer), during which no simulator answers
QUICK = CanSettings(timeout=0.7, retry=0.05)
NAMES = ("frame", "ambient", "spindle_front", "spindle_rear", "column")


def test_inputs_are_one_for_each_channel() -> None:
    assert CanSettings(channels=("a", "b"), inputs=(4, 2)).subindices == (4, 2)
    assert CanSettings(channels=("a", "b")).subindices == (1, 2)
    with pytest.raises(ValidationError, match="one for each of the 5 channels; found 1"):
        CanSettings(inputs=(1,))
    with pytest.raises(ValidationError, match="subindices from 1 to 254; found 0"):
        CanSettings(channels=("a",), inputs=(0,))


# ---------------------------------------------------------------------- nodes of the package canopen


@pytest.mark.parametrize("status", [True, False])
def test_reads_a_node_in_its_own_units(status: bool) -> None:
    with a_node(two_inputs(status=status)) as (address, _), CanTemperature(address, TWO) as thermometer:
        identity = thermometer.identify()
        assert (identity.manufacturer, identity.model) == ("CiA vendor 0x00001234", "product 8")
        assert (identity.serial_number, identity.simulated) == ("4711", False)
        assert thermometer.read() == {"air": 20.25, "bed": pytest.approx(26.85, abs=1e-4)}
        assert thermometer.flags == {"air": "", "bed": ""}


def test_a_long_name_is_received_in_segments() -> None:
    name = "Thermometer with four inputs, CiA 404"
    entries = two_inputs() | {(0x1008, 0): (datatypes.VISIBLE_STRING, name)}
    with a_node(entries) as (address, _), CanTemperature(address, TWO) as thermometer:
        assert thermometer.identify().model == name


def test_a_device_with_the_vendor_alone_is_identified() -> None:
    entries = {key: value for key, value in two_inputs().items() if key not in ((0x1018, 2), (0x1018, 4))}
    with a_node(entries) as (address, _), CanTemperature(address, TWO) as thermometer:
        assert thermometer.identify().serial_number == "unknown"


def test_a_stated_unit_can_be_overruled() -> None:
    with a_node(two_inputs(unit=0)) as (address, _):
        with pytest.raises(InstrumentError, match="unit of the input is 0x00000000"):
            CanTemperature(address, TWO).open()
        with CanTemperature(address, TWO.model_copy(update={"unit": "degC"})) as thermometer:
            assert thermometer.read()["bed"] == 300.0


def test_a_node_without_units_opens_with_the_unit_of_the_settings() -> None:
    entries = {key: value for key, value in two_inputs().items() if key[0] != 0x6131}
    with a_node(entries) as (address, _):
        with raises("thermometer.unit.unknown"):
            CanTemperature(address, TWO).open()
        with CanTemperature(address, TWO.model_copy(update={"unit": "K"})) as thermometer:
            assert thermometer.read()["bed"] == pytest.approx(26.85, abs=1e-4)


@pytest.mark.parametrize(
    ("status", "flag"), [(0, ""), (1, "faulty"), (2, "out of range"), (3, "out of range"), (5, "out of range")]
)
def test_states_of_inputs_are_flags(status: int, flag: str) -> None:
    with a_node(two_inputs(second_status=status)) as (address, _), CanTemperature(address, TWO) as thermometer:
        reading = thermometer.read()
        assert thermometer.flags == {"air": "", "bed": flag}
        assert math.isnan(reading["bed"]) == bool(flag)


@pytest.mark.parametrize(("status", "flag"), [(0, ""), (1, "faulty")])
def test_a_status_without_subindices_is_that_of_all_inputs(status: int, flag: str) -> None:
    entries = two_inputs(status=False) | {(0x6150, 0): (U8, status)}
    with a_node(entries) as (address, _), CanTemperature(address, TWO) as thermometer:
        thermometer.read()
        assert thermometer.flags == {"air": flag, "bed": flag}


def test_the_number_of_states_is_not_a_status() -> None:
    entries = {key: value for key, value in two_inputs().items() if key != (0x6150, 2)} | {(0x6150, 0): (U8, 1)}
    with a_node(entries) as (address, _), CanTemperature(address, TWO) as thermometer:
        thermometer.read()
        assert thermometer.flags == {"air": "", "bed": ""}


@pytest.mark.parametrize(("index", "kind"), [(0x7130, I16), (0x9130, I32)])
def test_integers_have_their_decimal_digits(index: int, kind: int) -> None:
    entries = a_device() | {
        (0x6131, 1): (U32, CELSIUS),
        (0x6131, 2): (U32, CELSIUS),
        (index, 1): (kind, 2031),
        (index, 2): (kind, -57),
        (0x6132, 1): (U8, 2),
        (0x6132, 2): (U8, 1),
    }
    with a_node(entries) as (address, _), CanTemperature(address, TWO) as thermometer:
        assert thermometer.read() == {"air": 20.31, "bed": -5.7}


def test_integers_without_digits_need_them_in_the_settings() -> None:
    entries = a_device() | {(0x6131, 1): (U32, CELSIUS), (0x7130, 1): (I16, 2031)}
    with a_node(entries) as (address, _):
        with raises("thermometer.digits.unknown"):
            CanTemperature(address, ONE).open()
        with CanTemperature(address, ONE.model_copy(update={"digits": 2})) as thermometer:
            assert thermometer.read() == {"air": 20.31}


def test_objects_without_subindices_are_the_first_input() -> None:
    entries = a_device() | {
        (0x9130, 0): (I32, 2031),
        (0x6131, 0): (U32, CELSIUS),
        (0x6132, 0): (U8, 2),
        (0x6150, 0): (U8, 0),
    }
    with a_node(entries) as (address, _), CanTemperature(address, ONE) as thermometer:
        assert thermometer.read() == {"air": 20.31}


def test_the_form_of_the_values_can_be_set() -> None:
    entries = two_inputs() | {(0x9130, i): (I32, 200 + i) for i in (1, 2)} | {(0x6132, i): (U8, 1) for i in (1, 2)}
    with a_node(entries) as (address, _):
        with CanTemperature(address, TWO) as thermometer:
            assert thermometer.read()["air"] == 20.25
        with CanTemperature(address, TWO.model_copy(update={"number": "integer 32"})) as thermometer:
            assert thermometer.read()["air"] == 20.1
        with raises("thermometer.input.missing"):
            CanTemperature(address, TWO.model_copy(update={"number": "integer 16"})).open()


def test_an_input_without_a_value_is_nan_and_the_others_continue() -> None:
    with (
        a_node(two_inputs(second=SdoAbortedError(0x06060000))) as (address, _),
        CanTemperature(address, TWO) as thermometer,
    ):
        reading = thermometer.read()
        assert reading["air"] == 20.25
        assert math.isnan(reading["bed"])
        assert thermometer.flags == {"air": "", "bed": "no answer"}


def test_an_input_that_does_not_exist_is_an_error_when_the_node_is_opened() -> None:
    settings = TWO.model_copy(update={"inputs": (1, 7), "unit": "degC"})
    with (
        a_node(two_inputs()) as (address, _),
        raises("thermometer.input.missing"),
    ):
        CanTemperature(address, settings).open()


def test_a_refused_value_is_an_error_with_its_abort_code() -> None:
    entries = two_inputs()
    with a_node(entries) as (address, _), CanTemperature(address, TWO) as thermometer:
        entries[0x6130, 2] = (F32, SdoAbortedError(0x08000000))
        with raises("can.sdo.refused") as refusal:
            thermometer.read()
        assert refusal.value.number == 0x08000000


def test_a_node_of_another_profile_is_refused() -> None:
    with (
        a_node(two_inputs(device=401)) as (address, _),
        raises("can.profile.other"),
    ):
        CanTemperature(address, TWO).open()


def test_a_missing_node_is_reported_as_silent() -> None:
    with (
        a_node(two_inputs()) as (address, _),
        pytest.raises(InstrumentTimeoutError, match=r"node 8 did not answer .* no heartbeat was received"),
    ):
        CanTemperature(address.replace("node=9", "node=8"), TWO).open()


def test_heartbeats_report_the_state_and_the_node_is_started_where_that_is_set() -> None:
    with a_node(two_inputs()) as (address, local):
        with CanTemperature(address, TWO) as thermometer:
            assert thermometer.state == ""
            local.network.send_message(0x709, [127])
            await_state(thermometer, "PRE-OPERATIONAL")
        with CanTemperature(address, TWO.model_copy(update={"start": True})) as thermometer:
            thermometer.read()
            assert local.nmt.state == "OPERATIONAL"


def test_an_emergency_message_is_kept_until_it_is_over() -> None:
    with a_node(two_inputs()) as (address, local), CanTemperature(address, TWO) as thermometer:
        local.emcy.send(0x5030, 1, bytes((1, 1)))
        await_that(lambda: thermometer.emergency == 0x5030)
        local.emcy.reset()
        await_that(lambda: thermometer.emergency == 0)


def test_a_node_that_boots_is_read_and_started_again() -> None:
    entries = two_inputs()
    settings = TWO.model_copy(update={"start": True})
    with a_node(entries) as (address, local), CanTemperature(address, settings) as thermometer:
        assert thermometer.read()["air"] == 20.25
        entries[0x6131, 1] = (U32, KELVIN)
        entries[0x6130, 1] = (F32, 293.5)
        local.nmt.state = "PRE-OPERATIONAL"
        local.network.send_message(0x709, [0])
        await_that(lambda: thermometer.node.boots == 1)
        assert thermometer.read()["air"] == pytest.approx(20.35, abs=1e-4)
        assert local.nmt.state == "OPERATIONAL"


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("tcp://127.0.0.1:9", "Expected an address on a CAN bus"),
        ("can://virtual", "Expected can://INTERFACE/CHANNEL"),
        ("can://virtual/x?node=0", "expected 1 to 127; found 0"),
        ("can://virtual/x?node=128", "from 0 to 127; found 128"),
        ("can://no_such_interface/x?node=1", "cannot be opened"),
        ("can://socketcan/no_such_channel?node=1", "cannot be opened"),
        (f"{ADDRESS}&sensors=coffee", "found coffee"),
    ],
)
def test_the_message_for_a_wrong_address_states_the_expected_form(address: str, message: str) -> None:
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


def test_broken_sensors_are_nan_with_a_flag() -> None:
    with CanTemperature(f"{ADDRESS}&open=1&shorted=3") as thermometer:
        assert set(thermometer.flags.values()) == {"not read"}
        reading = thermometer.read()
        assert [name for name, value in reading.items() if math.isnan(value)] == ["ambient", "spindle_rear"]
        assert list(thermometer.flags.values()) == ["", "faulty", "", "out of range", ""]


SERVER = """
import sys
import can, canopen
from canopen.objectdictionary import ODRecord, ODVariable, datatypes
kinds = {0x1000: datatypes.UNSIGNED32, 0x1018: datatypes.UNSIGNED32, 0x6130: datatypes.REAL32,
         0x6131: datatypes.UNSIGNED32, 0x6150: datatypes.UNSIGNED8}
values = {(0x1000, 0): 404, (0x1018, 1): 1, (0x6130, 1): 20.25, (0x6130, 2): -3.5, (0x6131, 1): 0x2D0000,
          (0x6131, 2): 0x2D0000, (0x6150, 1): 0, (0x6150, 2): 1}
dictionary = canopen.ObjectDictionary()
for (index, subindex), value in values.items():
    variable = ODVariable(f"{index:x} {subindex}", index, subindex)
    variable.data_type, variable.default = kinds[index], value
    if subindex:
        if index not in dictionary:
            dictionary.add_object(ODRecord(f"{index:x}", index))
        dictionary[index].add_member(variable)
    else:
        dictionary.add_object(variable)
bus = {"interface": "udp_multicast", "channel": "239.74.163.2", "port": int(sys.argv[1]), "hop_limit": 0}
network = canopen.Network(can.Bus(**bus, ignore_config=True))
network.connect()
node = canopen.LocalNode(5, dictionary)
network.add_node(node)
node.nmt.start_heartbeat(50)
node.nmt.state = "OPERATIONAL"
print("can://udp_multicast/239.74.163.2?node=5&port=" + sys.argv[1] + "&hop_limit=0", flush=True)
sys.stdin.read()
node.nmt.stop_heartbeat()
network.disconnect()
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
            assert thermometer.flags == {"air": "", "bed": "faulty"}
            await_state(thermometer, "OPERATIONAL")
        process.communicate()
    assert process.returncode == 0


# ---------------------------------------------------------------------- faults

PLAIN = f"{ADDRESS}&pdo=none"


@pytest.fixture(scope="module")
def before(tmp_path_factory: pytest.TempPathFactory) -> int:
    """Return the number of SDO answers up to the end of the first reading."""
    path = tmp_path_factory.mktemp("can") / "first.rec"
    with CanTemperature(f"{PLAIN}&heartbeat=0", QUICK, record=path) as thermometer:
        thermometer.read()
    return sum(line.startswith("R") and " 00000585" in line for line in path.read_text().splitlines())


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
def test_each_fault_has_its_own_state(fault: str, error: type[InstrumentError], message: str, before: int) -> None:
    at = f"&fault={fault}&fault_at={before}&heartbeat=0.02"
    with CanTemperature(PLAIN + at, QUICK) as thermometer:
        await_state(thermometer, "OPERATIONAL")
        assert all(math.isfinite(value) for value in thermometer.read().values())
        with pytest.raises(error, match=message) as raised:
            thermometer.read()
        assert type(raised.value) is error
        assert set(thermometer.flags.values()) == {"no answer"}


def test_a_stopped_node_reports_it_in_its_heartbeat(before: int) -> None:
    at = f"&fault=stopped&fault_at={before}&heartbeat=0.02"
    with CanTemperature(PLAIN + at, QUICK) as thermometer:
        thermometer.read()
        with pytest.raises(InstrumentTimeoutError):
            thermometer.read()
        await_state(thermometer, "STOPPED")
        with pytest.raises(InstrumentTimeoutError, match="its last heartbeat stated STOPPED"):
            thermometer.read()


@pytest.mark.parametrize("fault", ["unplugged", "bus_off"])
def test_an_absent_node_is_read_again_automatically(fault: str, before: int) -> None:
    at = f"&fault={fault}&fault_at={before}&unplugged_for=1.6"
    with CanTemperature(PLAIN + at, QUICK) as thermometer:
        first = thermometer.read()
        gaps, end = 0, time.monotonic() + 20
        while time.monotonic() < end:
            try:
                after = thermometer.read()
                break
            except InstrumentError:
                gaps += 1
                time.sleep(0.02)
        assert gaps >= 2
        assert after == pytest.approx(first, abs=0.2)  # ten sigma of 0.02 K
        assert set(thermometer.flags.values()) == {""}


def test_a_controller_that_is_bus_off_is_retried_at_a_limited_rate(before: int) -> None:
    settings = QUICK.model_copy(update={"retry": 60.0})
    with CanTemperature(f"{PLAIN}&fault=bus_off&fault_at={before}", settings) as thermometer:
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
        assert thermometer.flags["ambient"] == "faulty"
        assert thermometer.node.node == 5


def test_a_recorded_session_with_excess_data_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "can.rec"
    with CanTemperature(ADDRESS, QUICK, record=path) as thermometer:
        thermometer.read()
    with raises("replay.incomplete"), CanTemperature(f"replay://{path}", QUICK):
        pass
