"""The optoNCDT driver against its wire simulator, over real sockets and ptys."""

import itertools
import time
from pathlib import Path

import numpy as np
import pytest
from coded import raises
from pydantic import ValidationError

from errormotion.datasets.units import EDGE
from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments.point_lds.optoncdt import OptoNCDT, OptoSettings
from errormotion.instruments.simulators import world
from errormotion.instruments.simulators.faults import Fault, parse_fault
from errormotion.instruments.transports import parse_address
from errormotion.plugins import Samples

SLOW = OptoSettings(rate=1500.0, timeout=10.0)
RESOLUTION = 2e-3 * 1.02 / 65520


def take(sensor: OptoNCDT, blocks: int, block: int | None = None) -> list[Samples]:
    return list(itertools.islice(sensor.stream(block), blocks))


def values(blocks: list[Samples]) -> np.ndarray:
    return np.concatenate([block.values[0] for block in blocks])


def reasons(blocks: list[Samples]) -> dict[str, int]:
    names = {name for block in blocks for name in block.invalid}
    return {name: sum(block.invalid.get(name, 0) for block in blocks) for name in names}


@pytest.mark.parametrize("wire", ["tcp", "pty"])
def test_a_sensor_states_its_identity_and_that_it_is_simulated(wire: str) -> None:
    address = f"sim://cframe/X1?seed=3&wire={wire}"
    with OptoNCDT(address, SLOW) as sensor:
        identity = sensor.identify()
    assert (identity.manufacturer, identity.model) == ("Micro-Epsilon", "ILD2300")
    assert identity.serial_number.isdigit()
    assert identity.simulated
    assert identity.details["address"] == address


@pytest.mark.parametrize("wire", ["tcp", "pty"])
def test_samples_are_those_of_the_twin_to_half_a_step(wire: str) -> None:
    with OptoNCDT(f"sim://cframe/Y2?seed=3&wire={wire}", SLOW) as sensor:
        blocks = take(sensor, 4)
        truth = world("cframe", 3).machine.distances(0, 3000, 1500.0, ["Y2"])[0]
    assert [block.first for block in blocks] == [0, 750, 1500, 2250]
    assert all(block.values.shape == (1, 750) and block.rate == 1500 and not block.dropped for block in blocks)
    np.testing.assert_allclose(values(blocks), truth, rtol=0, atol=RESOLUTION / 2 * 1.001)


def test_host_times_are_monotonic() -> None:
    before = time.monotonic()
    with OptoNCDT("sim://cframe/X1?seed=3", SLOW) as sensor:
        times = [before, *(block.host_time for block in take(sensor, 20, block=1000)), time.monotonic()]
    assert times == sorted(times)


def test_a_reading_is_one_distance_and_the_next_is_another() -> None:
    with OptoNCDT("sim://cframe/Z?seed=3", SLOW) as sensor:
        first, second = sensor.read(), sensor.read()
        truth = world("cframe", 3).machine.distances(0, 2, 1500.0, ["Z"])[0]
    np.testing.assert_allclose([first, second], truth, rtol=0, atol=RESOLUTION / 2 * 1.001)


def test_commands_are_answered_while_data_stream() -> None:
    with OptoNCDT("sim://cframe/X1?seed=3", SLOW) as sensor:
        stream = sensor.stream()
        before = next(stream)
        assert any(line.startswith("Serial:") for line in sensor.command("GETINFO"))
        with pytest.raises(InstrumentError, match="refuses 'NONSENSE': E01"):
            sensor.command("NONSENSE")
        after = list(itertools.islice(stream, 40))
        stream.close()
    assert after[0].first == before.first + 750
    assert not any(block.dropped or block.invalid for block in after)


def test_without_the_counter_distances_alone_are_sent() -> None:
    with OptoNCDT("sim://cframe/X1?seed=3", OptoSettings(rate=1500.0, counter=False, timeout=10.0)) as sensor:
        blocks = take(sensor, 3)
        truth = world("cframe", 3).machine.distances(0, 2250, 1500.0, ["X1"])[0]
    np.testing.assert_allclose(values(blocks), truth, rtol=0, atol=RESOLUTION / 2 * 1.001)


def test_new_settings_apply_from_the_next_stream_on() -> None:
    with OptoNCDT("sim://cframe/X1?seed=3", SLOW) as sensor:
        take(sensor, 1)
        sensor.configure(OptoSettings(rate=30e3))
        assert take(sensor, 1)[0].rate == 30e3
        stream = sensor.stream()
        next(stream)
        with raises("stream.running"):
            sensor.configure(SLOW)
        stream.close()


# ---------------------------------------------------------------------- settings


def test_settings_from_a_file_have_units() -> None:
    text = {"model": "ILD1420", "range": "10 mm", "rate": "4 kHz", "baudrate": 460800}
    settings = OptoSettings.model_validate(text, context=EDGE)
    assert (settings.range, settings.rate) == (pytest.approx(0.01), 4000)
    with pytest.raises(ValidationError, match="expected a length with its unit"):
        OptoSettings.model_validate({"range": 2}, context=EDGE)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"rate": 20.5e3}, "ILD2300 measures at 1.5, 2.5, 5, 10, 20, 30, 49.14 kHz; found 20.5 kHz"),
        ({"range": 3e-3}, "has ranges of 2, 5, 10"),
        ({"baudrate": 1234}, "has the baud rates"),
        ({"baudrate": 921600}, "= 1200000 bit/s"),
        ({"model": "ILD1420"}, "ILD1420 measures at"),
        ({"nois": 1e-6}, "nois"),
    ],
)
def test_settings_that_the_sensor_does_not_have_are_refused(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        OptoSettings(**wrong)


@pytest.mark.parametrize("address", ["serial:///dev/ttyUSB0", "serial:///dev/ttyUSB0?baudrate=921600"])
def test_a_rate_that_the_line_does_not_carry_is_refused_before_it_is_opened(address: str) -> None:
    with raises("sensor.rate.too_high"):
        OptoNCDT(address, OptoSettings(rate=20e3)).open()


def test_another_sensor_than_the_settings_say_is_refused() -> None:
    with pytest.raises(InstrumentError, match=r"model ILD1420; .* is a 'ILD2300'"):
        OptoNCDT("sim://cframe/X1?seed=3", OptoSettings(model="ILD1420", range=0.01, rate=4e3)).open()
    with pytest.raises(InstrumentError, match=r"range of 10 mm; .* has 2 mm"):
        OptoNCDT("sim://cframe/X1?seed=3", OptoSettings(range=0.01)).open()


def test_the_smaller_model_works_as_well() -> None:
    settings = OptoSettings(model="ILD1420", range=0.01, rate=4e3)
    with OptoNCDT("sim://cframe/X1?seed=3&model=ILD1420", settings) as sensor:
        assert sensor.identify().model == "ILD1420-10"
        reading = sensor.read()
        truth = world("cframe", 3).machine.distances(0, 1, 4e3, ["X1"])[0, 0]
    assert reading == pytest.approx(truth, abs=5 * RESOLUTION / 2 * 1.001)


def test_a_sensor_whose_user_may_only_read_is_refused_with_a_hint() -> None:
    with pytest.raises(InstrumentError, match=r"refuses 'OUTPUT NONE': E06 Access denied\. Its user level may be USER"):
        OptoNCDT("sim://cframe/X1?seed=3&user=USER", SLOW).open()


@pytest.mark.parametrize("model", ["ILD2300", "ILD1420"])
@pytest.mark.parametrize("echo", ["ON", "OFF"])
def test_settings_of_an_earlier_user_change_no_value(model: str, echo: str) -> None:
    left = f"OUTADD_RS422+SHUTTER+TIMESTAMP;AVERAGE+MEDIAN+9;OUTHOLD+INFINITE;ECHO+{echo}"
    rate = 1500.0 if model == "ILD2300" else 2000.0
    with OptoNCDT(
        f"sim://cframe/X1?seed=3&model={model}&range=10&left={left}",
        OptoSettings(model=model, rate=rate, timeout=10.0),
    ) as sensor:
        blocks = take(sensor, 2, block=500)
        truth = world("cframe", 3).machine.distances(0, 1000, rate, ["X1"])[0]
    np.testing.assert_allclose(values(blocks), truth, rtol=0, atol=5 * RESOLUTION / 2 * 1.001)


def test_a_beam_that_the_machine_does_not_have_is_refused() -> None:
    with OptoNCDT("sim://cframe/X9", SLOW) as sensor, pytest.raises(InstrumentError, match="No such beam"):
        sensor.read()


# ---------------------------------------------------------------------- the fault menu


def test_silence_from_the_start_is_a_timeout_error() -> None:
    settings = OptoSettings(rate=1500.0, timeout=0.2)
    with raises("instrument.no_answer"):
        OptoNCDT("sim://cframe/X1?seed=3&fault=silence", settings).open()


def test_silence_in_a_stream_is_a_timeout_error_after_the_samples_before_it() -> None:
    settings = OptoSettings(rate=1500.0, timeout=0.2)
    got: list[Samples] = []
    with (
        OptoNCDT(
            "sim://cframe/X1?seed=3&fault=silence&fault_at=5001", settings
        ) as sensor,  # one more confirms the last
        raises("instrument.no_answer"),
    ):
        got.extend(sensor.stream(block=1000))
    assert len(got) == 5


def test_a_silent_sensor_gives_timeouts_until_it_answers_again() -> None:
    settings = OptoSettings(rate=1500.0, timeout=0.2)
    with OptoNCDT("sim://cframe/X1?seed=3&fault=silence&fault_at=5000", settings) as sensor:
        with pytest.raises(InstrumentTimeoutError):
            take(sensor, 10, block=1000)
        for _ in range(2):
            with pytest.raises(InstrumentTimeoutError):
                sensor.read()
        device = sensor.transport._device
        device.fault, device._mute = Fault(), False
        assert np.isfinite(sensor.read())
        assert np.isfinite(sensor.read())


@pytest.mark.parametrize("wire", ["tcp", "pty"])
@pytest.mark.parametrize("late", ["", "&late_by=0.45"])
def test_a_sensor_whose_stop_is_confirmed_late_is_stopped_again(wire: str, late: str) -> None:
    settings = OptoSettings(rate=1500.0, timeout=0.3, baudrate=921600)
    with OptoNCDT(f"sim://cframe/X1?seed=3&wire={wire}", settings) as sensor:
        sensor.read()
        device = sensor.transport._device
        stream = sensor.stream(block=1)
        next(stream)
        number = device._answers  # that of the stop
        device.fault = parse_fault(parse_address(f"sim://cframe?fault=late&fault_at={number}{late}"), device.faults)
        stream.close()
        assert device._answers == number + 1
        found = [sensor.read() for _ in range(3)]
        assert np.isfinite(found).all()
        assert sensor.identify().manufacturer == "Micro-Epsilon"


def test_split_frames_have_no_effect() -> None:
    with OptoNCDT("sim://cframe/X1?seed=3", SLOW) as sensor:
        whole = values(take(sensor, 8))
    with OptoNCDT("sim://cframe/X1?seed=3&fault=split", SLOW) as sensor:
        np.testing.assert_array_equal(values(take(sensor, 8)), whole)


def test_garbage_is_counted_and_changes_no_other_sample() -> None:
    with OptoNCDT("sim://cframe/X1?seed=3", SLOW) as sensor:
        whole = values(take(sensor, 20))
    with OptoNCDT("sim://cframe/X1?seed=3&fault=garbage&fault_every=100", SLOW) as sensor:
        blocks = take(sensor, 20)
    spoilt = values(blocks)
    known = np.isfinite(spoilt)
    np.testing.assert_array_equal(spoilt[known], whole[known])
    assert 0 < (~known).sum() == sum(reasons(blocks).values())
    assert set(reasons(blocks)) <= {"garbled", "lost"}


def test_out_of_range_is_nan_with_its_reason() -> None:
    with OptoNCDT("sim://cframe/X1?seed=3&fault=out_of_range&fault_at=1000&fault_for=500", SLOW) as sensor:
        blocks = take(sensor, 4)
    assert reasons(blocks) == {"no peak": 500}
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(values(blocks))), np.arange(1000, 1500))


def test_dropped_samples_are_counted_and_nan_at_their_positions() -> None:
    with OptoNCDT("sim://cframe/X1?seed=3", SLOW) as sensor:
        whole = values(take(sensor, 4))
    with OptoNCDT("sim://cframe/X1?seed=3&fault=drop&fault_at=7&fault_every=100", SLOW) as sensor:
        blocks = take(sensor, 4)
    lost = np.arange(7, 3000, 100)
    assert sum(block.dropped for block in blocks) == lost.size
    assert reasons(blocks) == {"lost": lost.size}
    whole[lost] = np.nan
    np.testing.assert_array_equal(values(blocks), whole)


def test_a_broken_connection_is_an_instrument_error_and_can_be_opened_again() -> None:
    sensor = OptoNCDT("sim://cframe/X1?seed=3&fault=disconnect&fault_at=2000", SLOW)
    with sensor:
        with raises("connection.lost"):
            take(sensor, 10, block=500)
        sensor.close()
        sensor.open()
        assert sensor.identify().model == "ILD2300"


@pytest.mark.parametrize(
    ("fault", "message"),
    [("checksum", "does not have this fault"), ("fire", "unknown fault"), ("silenc", "expected one of silence")],
)
def test_a_fault_that_is_not_on_the_menu_is_refused(fault: str, message: str) -> None:
    with pytest.raises(InstrumentError, match=message):
        OptoNCDT(f"sim://cframe/X1?fault={fault}", SLOW).open()


# ---------------------------------------------------------------------- opening, closing, recording


def test_use_before_opening_is_refused_and_opening_is_idempotent() -> None:
    sensor = OptoNCDT("sim://cframe/X1?seed=3", SLOW)
    for use in (sensor.read, sensor.identify, lambda: next(sensor.stream())):
        with raises("instrument.not_open"):
            use()
    sensor.close()
    sensor.open()
    sensor.open()
    assert np.isfinite(sensor.read())
    sensor.close()
    sensor.close()


def test_closing_in_the_middle_of_a_stream_ends_it() -> None:
    sensor = OptoNCDT("sim://cframe/X1?seed=3", SLOW)
    sensor.open()
    stream = sensor.stream()
    next(stream)
    sensor.close()
    with raises("stream.not_running"):
        next(stream)


@pytest.mark.parametrize("wire", ["tcp", "pty"])
def test_a_recorded_session_plays_back_with_the_same_samples(tmp_path: Path, wire: str) -> None:
    path = tmp_path / "session.rec"
    with OptoNCDT(f"sim://cframe/X1?seed=3&wire={wire}&fault=drop", SLOW, record=path) as sensor:
        identity, reading, blocks = sensor.identify(), sensor.read(), take(sensor, 6)
    with OptoNCDT(f"replay://{path}", SLOW) as sensor:
        assert sensor.identify().serial_number == identity.serial_number
        assert sensor.transport.simulated
        assert sensor.read() == reading
        again = take(sensor, 6)
    np.testing.assert_array_equal(values(again), values(blocks))
    assert [block.dropped for block in again] == [block.dropped for block in blocks]


def test_a_driver_that_writes_something_else_fails_in_replay(tmp_path: Path) -> None:
    path = tmp_path / "session.rec"
    with OptoNCDT("sim://cframe/X1?seed=3", SLOW, record=path):
        pass
    with raises("replay.write.differs"):
        OptoNCDT(f"replay://{path}", OptoSettings(rate=2500.0)).open()


def test_a_session_that_is_cut_short_fails_in_replay(tmp_path: Path) -> None:
    path = tmp_path / "session.rec"
    with OptoNCDT("sim://cframe/X1?seed=3", SLOW, record=path) as sensor:
        sensor.read()
    sensor = OptoNCDT(f"replay://{path}", SLOW)
    sensor.open()
    with raises("replay.incomplete"):
        sensor.close()
