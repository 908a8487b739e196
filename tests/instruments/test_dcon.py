"""DCON thermometers: codec, driver, line."""

import math
import time
from pathlib import Path

import pytest
from coded import raises
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.simulators import world
from errormotion.instruments.thermometer.dcon import (
    DconSettings,
    DconTemperature,
    check_configuration,
    checksum,
    decode,
    encode,
    parse_temperatures,
)
from errormotion.instruments.transports.loopback.serving import TcpServer

ADDRESS = "sim://cframe/thermometer?seed=3"
QUICK = DconSettings(timeout=0.3)


def read_often(thermometer: DconTemperature, times: int) -> None:
    for _ in range(times):
        thermometer.read()


def test_vectors() -> None:
    assert encode("#01") == b"#01\r"
    assert parse_temperatures(decode(b">+025.12+026.00\r")) == [25.12, 26.0]


@pytest.mark.parametrize("vector", vectors("dcon_temperature", "reading"), ids=str)
def test_readings_in_makers_documents(vector: Vector) -> None:
    found = parse_temperatures(decode(vector.data))
    assert found == pytest.approx(vector.expected["values"], abs=1e-12, nan_ok=True)


@pytest.mark.parametrize("vector", vectors("dcon_temperature", "checked line"), ids=str)
def test_lines_with_checksum_in_makers_documents(vector: Vector) -> None:
    assert decode(vector.data, with_checksum=True) == vector.expected["text"]
    assert encode(vector.expected["text"], with_checksum=True) == vector.data


@pytest.mark.parametrize("vector", vectors("dcon_temperature", "line"), ids=str)
def test_lines_in_makers_documents(vector: Vector) -> None:
    assert decode(vector.data) == vector.expected["text"]
    assert encode(vector.expected["text"]) == vector.data


def test_checksum_is_the_sum_of_the_characters() -> None:
    assert checksum("$012") == "B7"  # 24 + 30 + 31 + 32, hexadecimal
    assert encode("$012", with_checksum=True) == b"$012B7\r"
    assert decode(b"$012B7\r", with_checksum=True) == "$012"
    with raises("protocol.checksum"):
        decode(b"$012B8\r", with_checksum=True)


@given(st.lists(st.floats(-200, 1370).map(lambda t: round(t, 2)), min_size=1, max_size=10))
def test_temperatures_round_trip(temperatures: list[float]) -> None:
    answer = ">" + "".join(f"{t:+07.2f}" for t in temperatures)
    assert parse_temperatures(answer) == pytest.approx(temperatures, abs=1e-9)


@pytest.mark.parametrize("value", ["+9999.9", "-9999.9", "+9999", "-0000", "+888888"])
def test_an_open_sensor_is_nan(value: str) -> None:
    readings = parse_temperatures(f">+025.12{value}+026.00")
    assert readings[1] is not None
    assert math.isnan(readings[1])
    assert readings[::2] == [25.12, 26.0]


def test_a_disabled_channel_is_none() -> None:
    assert parse_temperatures(">+025.12       +026.00" + " " * 7) == [25.12, None, 26.0, None]


@pytest.mark.parametrize(
    ("configuration", "message"),
    [
        ("100601", "reports per cent of the range"),
        ("0F0682", r"reports hexadecimal \(data format 82\)"),
        ("200603", "reports ohms"),
        ("050600", "input range 05, a voltage or current"),
    ],
)
def test_a_module_that_states_no_degrees_is_refused(configuration: str, message: str) -> None:
    with pytest.raises(InstrumentError, match=message):
        check_configuration(configuration)


@pytest.mark.parametrize("configuration", ["100600", "0F0A80", "200640"])
def test_engineering_units_of_thermocouples_and_resistors_are_read(configuration: str) -> None:
    check_configuration(configuration)


@pytest.mark.parametrize("configuration", ["", "10060", "1006000", "1g0600"])
def test_another_answer_is_not_a_configuration(configuration: str) -> None:
    with raises("protocol.reply.form"):
        check_configuration(configuration)


@pytest.mark.parametrize(
    ("settings", "code"), [("format=percent", "thermometer.format.other"), ("type=5", "thermometer.range.other")]
)
def test_no_session_starts_with_such_a_module(settings: str, code: str) -> None:
    with raises(code):
        DconTemperature(f"{ADDRESS}&{settings}").open()


@pytest.mark.parametrize("model", ["7018", "4018"])
@pytest.mark.parametrize("type_code", [0x0E, 0x0F, 0x10])
def test_modules_of_both_makers_are_read(model: str, type_code: int) -> None:
    with DconTemperature(f"{ADDRESS}&model={model}&type={type_code}&open=2") as thermometer:
        reading = thermometer.read()
        assert thermometer.identify().model == model
        assert thermometer.open_sensors == ("spindle_front",)
    assert reading["frame"] == pytest.approx(20.0, abs=1.0)


def test_zero_degrees_is_not_an_open_sensor() -> None:
    assert parse_temperatures(">+000.00-000.00") == [0.0, 0.0]


@pytest.mark.parametrize(
    "text", ["", ">", "+025.12", ">025.12", ">+025.12x", ">+025.12 +026.00", ">+025.12      ", "!01"]
)
def test_anything_else_is_a_protocol_error(text: str) -> None:
    with raises("protocol.reply.number_form"):
        parse_temperatures(text)
    with raises("protocol.text.form"):
        decode(b"\xff>+025.12\r")


@pytest.mark.parametrize("wire", ["tcp", "pty"])
@pytest.mark.parametrize("check", [False, True])
def test_temperatures_are_the_twins(wire: str, check: bool) -> None:
    address = f"{ADDRESS}&wire={wire}&checksum={int(check)}"
    with DconTemperature(address, DconSettings(checksum=check)) as thermometer:
        reading = thermometer.read()
        assert thermometer.open_sensors == ()
        assert thermometer.identify().model == "7018"
        assert thermometer.identify().simulated
        twin = world("cframe", 3).machine
        truth = dict(zip(twin.temperature_sensors, twin.temperatures([0.0])[0], strict=True))
    assert list(reading) == ["frame", "ambient", "spindle_front", "spindle_rear", "column"]
    for name, value in reading.items():
        assert value == pytest.approx(truth[name], abs=0.11)  # five sigma of 0.02 K, and the last digit


def test_an_open_sensor_is_nan_and_named() -> None:
    with DconTemperature(f"{ADDRESS}&open=1") as thermometer:
        reading = thermometer.read()
        assert thermometer.open_sensors == ("ambient",)
    assert math.isnan(reading.pop("ambient"))
    assert all(math.isfinite(value) for value in reading.values())


def test_names_and_inputs_are_settings() -> None:
    settings = DconSettings(channels=("air", "bed"), unit=0x1F)
    with DconTemperature(f"{ADDRESS}&sensors=ambient,bed&unit=31", settings) as thermometer:
        assert list(thermometer.read()) == ["air", "bed"]


def test_a_name_for_a_disabled_channel_is_an_error() -> None:
    with (
        DconTemperature(f"{ADDRESS}&sensors=frame,bed") as thermometer,
        pytest.raises(ProtocolError, match="spindle_front, spindle_rear, column are disabled"),
    ):
        thermometer.read()


def test_fewer_inputs_than_names_is_an_error() -> None:
    settings = DconSettings(channels=tuple(f"input_{i}" for i in range(9)))
    with (
        DconTemperature(ADDRESS, settings) as thermometer,
        pytest.raises(ProtocolError, match=r"at least 9 temperatures .* found 8"),
    ):
        thermometer.read()


def test_a_refused_request_and_a_missing_module_are_errors() -> None:
    with DconTemperature(ADDRESS) as thermometer, pytest.raises(InstrumentError, match=r"refuses '\$01X': '\?01'"):
        thermometer._query("$01X", "!01")
    with pytest.raises(InstrumentTimeoutError):
        DconTemperature(ADDRESS, DconSettings(unit=2, timeout=0.3)).open()


def test_a_sensor_that_the_machine_does_not_have_is_refused() -> None:
    with pytest.raises(InstrumentError, match=r"sensors of the machine, .*found coffee"):
        DconTemperature(f"{ADDRESS}&sensors=coffee").open()


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ("silence", InstrumentTimeoutError),
        ("drop", InstrumentTimeoutError),
        ("garbage", ProtocolError),
        ("disconnect", InstrumentError),
    ],
)
@pytest.mark.parametrize("at", [0, 4])
def test_each_fault_becomes_a_typed_error(fault: str, error: type[InstrumentError], at: int) -> None:
    thermometer = DconTemperature(f"{ADDRESS}&fault={fault}&fault_at={at}", QUICK)
    with pytest.raises(error), thermometer:
        read_often(thermometer, 4)


def test_a_bad_checksum_is_a_protocol_error_and_splitting_none() -> None:
    settings = DconSettings(checksum=True, timeout=0.3)
    with (
        DconTemperature(f"{ADDRESS}&checksum=1&fault=checksum&fault_at=3", settings) as thermometer,
        raises("protocol.checksum"),
    ):
        read_often(thermometer, 3)
    with DconTemperature(f"{ADDRESS}&checksum=1&fault=split", settings) as thermometer:
        assert all(math.isfinite(value) for value in thermometer.read().values())
    with pytest.raises(InstrumentError, match="does not have this fault"):
        DconTemperature(f"{ADDRESS}&fault=checksum").open()


def test_out_of_range_is_nan_everywhere() -> None:
    with DconTemperature(f"{ADDRESS}&fault=out_of_range") as thermometer:
        assert all(math.isnan(value) for value in thermometer.read().values())
        assert len(thermometer.open_sensors) == 5


def test_a_recorded_session_plays_back(tmp_path: Path) -> None:
    path = tmp_path / "thermometer.rec"
    with DconTemperature(ADDRESS, record=path) as thermometer:
        readings = [thermometer.read() for _ in range(3)]
    with DconTemperature(f"replay://{path}") as thermometer:
        assert [thermometer.read() for _ in range(3)] == readings


def test_flags_and_positions_state_type_and_location_of_a_sensor() -> None:
    settings = DconSettings.model_validate({"places": {"frame": ("0.1 m", "20 mm", 0.0)}})
    with DconTemperature(f"{ADDRESS}&open=1,3", settings) as thermometer:
        assert set(thermometer.flags.values()) == {"not read"}
        thermometer.read()
        assert list(thermometer.flags.values()) == ["", "open", "", "open", ""]
        assert thermometer.places["frame"] == (0.1, 0.02, 0.0)
        assert thermometer.places["column"] is None


@pytest.mark.parametrize("wire", ["tcp", "pty"])
def test_an_unplugged_module_is_received_again_automatically(wire: str) -> None:
    settings = DconSettings(timeout=0.7, retry=0.05)
    address = f"{ADDRESS}&wire={wire}&fault=unplugged&fault_at=4&unplugged_for=1.6"
    with DconTemperature(address, settings) as thermometer:
        before = thermometer.read()
        gaps, end = 0, time.monotonic() + 20
        while time.monotonic() < end:
            try:
                after = thermometer.read()
                break
            except InstrumentError:
                assert set(thermometer.flags.values()) == {"no answer"}
                gaps += 1
                time.sleep(0.02)
        assert gaps >= 2
        assert after == pytest.approx(before, abs=0.2)  # ten sigma of 0.02 K


@pytest.mark.parametrize("end", [b"\r", b"\r\n", b"\n"])
@pytest.mark.parametrize("echo", [False, True])
def test_an_echo_and_other_ends_of_lines_are_read(end: bytes, echo: bool) -> None:
    answers = {b"$01M": b"!014018", b"$01F": b"!01A1.0", b"$012": b"!01100600", b"#01": b">+025.12+026.00"}

    def reply(data: bytes) -> None:
        server.send((data if echo else b"") + answers[data.strip()] + end)

    server = TcpServer("dcon", reply)
    server.start()
    settings = DconSettings(channels=("a", "b"), timeout=1.0, echo=echo)
    try:
        with DconTemperature(server.url, settings) as thermometer:
            assert [thermometer.read() for _ in range(3)] == [{"a": 25.12, "b": 26.0}] * 3
        if echo:
            with pytest.raises(ProtocolError, match="The line returns the request: set 'echo' to true"):
                DconTemperature(server.url, settings.model_copy(update={"echo": False})).open()
    finally:
        server.close()
