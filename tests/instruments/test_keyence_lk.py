"""The LK-G/LK-H driver against its wire simulator, over real ptys and sockets."""

import itertools
import math
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from coded import raises
from pydantic import ValidationError

from errormotion.datasets.units import EDGE
from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.point_lds.keyence_lk import KeyenceLK, LKSettings
from errormotion.instruments.point_lds.keyence_lk.codec import HEADS
from errormotion.instruments.simulators import world
from errormotion.instruments.simulators.point_lds.keyence_lk import SimulatedKeyenceLK
from errormotion.instruments.transports import parse_address
from errormotion.plugins import Samples

SIX = "sim://cframe/lk?seed=3&readings=1.2345,-4.273,0,nan,12,-12"
SHOWN = [1.2345e-3, -4.273e-3, 0.0, math.nan, math.nan, math.nan]
QUICK = LKSettings(timeout=0.3)
PATIENT = LKSettings(timeout=10.0)
HALF_STEP = 0.05e-6 * 1.001
INCLINED = math.radians(20.0)


def take(sensor: KeyenceLK, blocks: int, block: int | None = None) -> list[Samples]:
    return list(itertools.islice(sensor.stream(block), blocks))


def values(blocks: list[Samples]) -> np.ndarray:
    return np.concatenate([block.values[0] for block in blocks])


def reasons(blocks: list[Samples]) -> Counter[str]:
    return sum((Counter(block.invalid) for block in blocks), Counter())


# ---------------------------------------------------------------------- readings


@pytest.mark.parametrize("wire", ["pty", "tcp"])
def test_readings_and_reasons_of_missing_ones(wire: str) -> None:
    with KeyenceLK(f"{SIX}&wire={wire}", PATIENT) as sensor:
        seen = [(sensor.read(), sensor.no_value) for _ in range(6)]
    np.testing.assert_allclose([value for value, _ in seen], SHOWN, rtol=1e-12, atol=0)
    # the controller counts towards the head: what is beyond the far end is under its range
    assert [reason for _, reason in seen] == ["", "", "", "no value", "under range", "over range"]


@pytest.mark.parametrize("wire", ["pty", "tcp"])
def test_a_stream_has_the_same_readings_and_counts_the_missing_ones(wire: str) -> None:
    with KeyenceLK(f"{SIX}&wire={wire}", PATIENT) as sensor:
        blocks = take(sensor, 4, block=9)
    assert [block.first for block in blocks] == [0, 9, 18, 27]
    assert all(block.values.shape == (1, 9) and block.rate == 100.0 and not block.dropped for block in blocks)
    np.testing.assert_allclose(values(blocks), SHOWN * 6, rtol=1e-12, atol=0)
    assert reasons(blocks) == {"no value": 6, "under range": 6, "over range": 6}
    assert all(sum(block.invalid.values()) == np.isnan(block.values).sum() for block in blocks)


def test_readings_increase_along_the_beam_whatever_the_sign_of_the_controller() -> None:
    for positive in ("near", "far"):
        with KeyenceLK(f"{SIX}&positive={positive}", LKSettings(positive=positive)) as sensor:
            assert sensor.read() == pytest.approx(1.2345e-3)
            assert sensor.read() == pytest.approx(-4.273e-3)
    with KeyenceLK(f"{SIX}&positive=far") as sensor:  # reported wrongly
        assert sensor.read() == pytest.approx(-1.2345e-3)


@pytest.mark.parametrize("display", ["0.01 mm", "0.001 mm", "0.0001 mm", "0.1 um"])
def test_a_reading_has_the_digits_of_the_display(display: str) -> None:
    step = {"0.01 mm": 1e-5, "0.001 mm": 1e-6, "0.0001 mm": 1e-7, "0.1 um": 1e-7}[display]
    number = {"0.01 mm": 0, "0.001 mm": 1, "0.0001 mm": 2, "0.1 um": 4}[display]
    with KeyenceLK(f"sim://cframe/lk?readings=-9.87654321&display={number}", LKSettings(display=display)) as sensor:
        reading = sensor.read()
    assert reading == pytest.approx(-9.87654321e-3, abs=step / 2 * 1.001)
    assert reading / step == pytest.approx(round(reading / step), abs=1e-6)


def test_an_older_controller_is_queried_with_its_own_commands() -> None:
    settings = LKSettings(controller="LK-G3000", head="LK-G30", output=2)
    with KeyenceLK("sim://cframe/lk?controller=LK-G3000&head=LK-G30&output=2&readings=3.25,6", settings) as sensor:
        assert sensor.read() == pytest.approx(3.25e-3)
        assert math.isnan(sensor.read())  # beyond +-5 mm
        assert sensor.measuring_range == (-5e-3, 5e-3)


def test_a_sensor_states_its_mid_range_and_measuring_range() -> None:
    sensor = KeyenceLK(SIX)
    assert sensor.mid_range == 0.0
    assert sensor.measuring_range == (-10e-3, 10e-3)


# ---------------------------------------------------------------------- the virtual machine


def test_on_the_machine_it_reads_its_depth_to_a_plane() -> None:
    """At right angles the inclination error is a scale error of 1e-4 at most: under 1 um on 5 mm."""
    with KeyenceLK("sim://cframe/lk?seed=3", PATIENT) as sensor:
        here = world("cframe", 3)
        assert math.isnan(sensor.read())
        assert sensor.no_value == "no value"  # no target
        here.set_target("plane", INCLINED, 0.0)
        point, home = here.machine.point_sensor, here.machine.home()
        for lift in (-5e-3, -1e-3, 0.0, 2e-3, 5e-3):
            here.move_to(home + np.array([0.0, 0.0, lift]))
            stage = np.array(here.position())
            depth = here.stand.target.meet((point.true_origin + stage)[None], point.true_direction)[0][0]
            reading = sensor.read()
            # noise 0.1 um, speckle 0.3 um, half a step; the sensors have been on for long, and k is below 1 %
            assert reading == pytest.approx(depth, abs=3e-6 + 0.01 * abs(depth))
            assert sensor.no_value == ""


def test_on_the_machine_beyond_and_before_the_range_are_distinguished() -> None:
    with KeyenceLK("sim://cframe/lk?seed=3", PATIENT) as sensor:
        here = world("cframe", 3)
        here.set_target("plane", INCLINED, 0.0)
        home = here.machine.home()
        shown = []
        for lift in (0.02, -0.02):  # further away, nearer
            here.move_to(home + np.array([0.0, 0.0, lift]))
            assert math.isnan(sensor.read())
            shown.append(sensor.no_value)
    assert shown == ["under range", "over range"]


def test_a_reading_on_the_machine_has_the_noise_of_the_settings() -> None:
    """Of 200 readings in one position the scatter is that of the noise and of the last digit, to 5 sigma (25 %)."""
    with KeyenceLK("sim://cframe/lk?seed=3", PATIENT) as sensor:
        here = world("cframe", 3)
        here.set_target("plane", INCLINED, 0.0)
        here.move_to(here.machine.home())
        readings = values(take(sensor, 1, block=200))
    expected = math.hypot(sensor.settings.noise, 0.1e-6 / math.sqrt(12))
    assert np.std(readings) == pytest.approx(expected, rel=0.25)


# ---------------------------------------------------------------------- settings of the controller


def test_another_display_unit_than_the_settings_say_is_refused_or_set() -> None:
    address = f"{SIX}&display=5"
    with pytest.raises(InstrumentError, match=r"'display' is 0\.0001 mm; .* answers 'SR,OI,01' with '0\.01 um'"):
        KeyenceLK(address).open()
    with KeyenceLK(address, LKSettings(set_up="set")) as sensor:
        assert sensor.read() == pytest.approx(1.2345e-3)
    with KeyenceLK(address, LKSettings(set_up="trust")) as sensor, pytest.raises(ProtocolError, match="4 decimals"):
        sensor.read()


def test_an_offset_is_refused_or_taken_back_and_so_is_a_zero_of_the_panel() -> None:
    with raises("sensor.offset.set"):
        KeyenceLK(f"{SIX}&offset=0.5").open()
    with KeyenceLK(f"{SIX}&offset=0.5", LKSettings(set_up="trust")) as sensor:
        assert sensor.read() == pytest.approx(1.2345e-3 - 0.5e-3)
    with KeyenceLK(f"{SIX}&offset=0.5&zero=-0.25", LKSettings(set_up="set")) as sensor:
        assert sensor.read() == pytest.approx(1.2345e-3)


def test_new_settings_apply_from_the_next_reading_on() -> None:
    with KeyenceLK(SIX, PATIENT) as sensor:
        stream = sensor.stream(block=1)
        next(stream)
        with raises("stream.running"):
            sensor.configure(QUICK)
        stream.close()
        sensor.configure(LKSettings(display="0.1 um", set_up="set", rate=10.0))
        assert sensor.read() == pytest.approx(-4.273e-3)
        assert take(sensor, 1)[0].rate == 10.0


def test_after_refused_settings_the_old_ones_remain() -> None:
    with KeyenceLK(SIX) as sensor:
        with pytest.raises(InstrumentError, match="a parameter is out of range"):
            sensor.configure(LKSettings(output=2))
        assert sensor.settings.output == 1
        assert sensor.read() == pytest.approx(1.2345e-3)


def test_an_output_that_the_controller_does_not_have_is_refused() -> None:
    with pytest.raises(InstrumentError, match=r"refuses 'SR,OI,02' with error 62: a parameter is out of range"):
        KeyenceLK(SIX, LKSettings(output=2)).open()


def test_the_wrong_generation_is_refused() -> None:
    settings = LKSettings(controller="LK-G3000", head="LK-G30", set_up="trust")
    with (
        KeyenceLK(SIX, settings) as sensor,
        pytest.raises(InstrumentError, match="refuses 'M1' with error 50: unknown command"),
    ):
        sensor.read()


def test_it_states_its_identity_as_far_as_known() -> None:
    with KeyenceLK(f"{SIX}&wire=pty") as sensor:
        identity = sensor.identify()
    assert (identity.manufacturer, identity.model) == ("Keyence", "LK-G5000 with LK-H050")
    assert identity.serial_number == "unknown"
    assert identity.simulated
    assert identity.details["output"] == 1


# ---------------------------------------------------------------------- settings


def test_settings_from_a_file_have_units() -> None:
    text = {"head": "LK-H020", "display": "0.00001 mm", "rate": "20 Hz", "noise": "50 nm", "timeout": "2 s"}
    settings = LKSettings.model_validate(text, context=EDGE)
    assert (settings.rate, settings.noise, settings.timeout) == (20.0, pytest.approx(50e-9), 2.0)
    with pytest.raises(ValidationError, match="expected a frequency with its unit"):
        LKSettings.model_validate({"rate": 20}, context=EDGE)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"display": "0.00001 mm"}, "shows up to 9.99999 mm, but the LK-H050 measures to 10 mm"),
        ({"display": "0.01 um"}, "choose a coarser unit"),
        ({"controller": "LK-G3000"}, "for heads LK-G; found LK-H050"),
        ({"controller": "LK-G3000", "head": "LK-G30", "output": 3}, "has the outputs 1 to 2; found 3"),
        ({"output": 13}, "has the outputs 1 to 12"),
        ({"rate": 1000.0}, r"= 210000 bit/s"),
        ({"head": "LK-H051"}, "LK-H050"),
        ({"nois": 1e-6}, "nois"),
    ],
)
def test_settings_that_the_sensor_does_not_have_are_refused(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        LKSettings(**wrong)


def test_a_rate_that_the_line_of_the_address_does_not_carry_is_refused_before_it_is_opened() -> None:
    with pytest.raises(InstrumentError, match=r"exceed 9600 baud"):
        KeyenceLK("serial:///dev/ttyUSB0?baudrate=9600").open()


def test_every_head_fits_some_display() -> None:
    for head in HEADS:
        LKSettings(head=head, display="0.001 mm")


# ---------------------------------------------------------------------- the fault menu


@pytest.mark.parametrize("wire", ["pty", "tcp"])
@pytest.mark.parametrize(
    ("fault", "error"),
    [("silence", InstrumentTimeoutError), ("drop", InstrumentTimeoutError), ("disconnect", InstrumentError)],
)
@pytest.mark.parametrize("at", [0, 7])
def test_each_fault_becomes_a_typed_error(wire: str, fault: str, error: type[InstrumentError], at: int) -> None:
    sensor = KeyenceLK(f"{SIX}&wire={wire}&fault={fault}&fault_at={at}", QUICK)
    with pytest.raises(error), sensor:
        take(sensor, 2, block=10)


def test_split_answers_have_no_effect() -> None:
    with KeyenceLK(f"{SIX}&fault=split&wire=pty", PATIENT) as sensor:
        np.testing.assert_allclose(values(take(sensor, 1, block=12)), SHOWN * 2, rtol=1e-12, atol=0)


@pytest.mark.parametrize("code", ["00", "01", "20", "21", "22", "50", "51", "60", "61", "62", "88", "99", "47"])
def test_every_error_reply_is_an_error_with_its_code_and_no_reading(code: str) -> None:
    with (
        KeyenceLK(f"{SIX}&fault=error&fault_at=5&code={code}", QUICK) as sensor,
        pytest.raises(InstrumentError, match=f"refuses 'MS,01' with error {code}: "),
    ):
        sensor.read()


def test_an_error_reply_to_the_first_request_is_an_error_at_opening() -> None:
    with pytest.raises(InstrumentError, match="refuses 'R0' with error 88"):
        KeyenceLK(f"{SIX}&fault=error&code=88", QUICK).open()


@pytest.mark.parametrize(
    ("fault", "reason"), [("out_of_range", "no value"), ("over_range", "over range"), ("under_range", "under range")]
)
def test_out_of_range_is_nan_with_its_reason(fault: str, reason: str) -> None:
    # five answers go before: R0, Q0, two settings, R0
    with KeyenceLK(f"sim://cframe/lk?readings=1&fault={fault}&fault_at=9&fault_for=3", PATIENT) as sensor:
        blocks = take(sensor, 1, block=12)
    assert np.flatnonzero(np.isnan(values(blocks))).tolist() == [4, 5, 6]
    assert reasons(blocks) == {reason: 3}


@pytest.mark.parametrize("seed", range(6))
def test_garbage_only_changes_its_own_reading(seed: int) -> None:
    """After a damaged answer, driver and controller resynchronise answers and requests."""
    address = f"sim://cframe/lk?seed={seed}&readings=1,2,3,4,5,6,7&fault=garbage&fault_at=8&fault_every=6"
    with KeyenceLK(address, PATIENT) as sensor:
        blocks = take(sensor, 3, block=20)
    seen = values(blocks)
    known = np.isfinite(seen)
    np.testing.assert_allclose(seen[known], np.resize(1e-3 * np.arange(1, 8), seen.size)[known], rtol=1e-12)
    assert reasons(blocks) == {"garbled": (~known).sum()}
    assert 0 < (~known).sum() <= 12  # every sixth answer; some affect the synchronisation without effect


def test_a_late_answer_is_not_taken_for_the_next_one() -> None:
    with KeyenceLK("sim://cframe/lk?readings=1,2,3", PATIENT) as sensor:
        assert sensor.read() == pytest.approx(1e-3)
        sensor.transport.write(b"MS,01\r")  # read by a client that did not wait for the answer
        sensor._synchronised = False
        assert sensor.read() == pytest.approx(3e-3)


def test_a_lost_answer_is_an_error_and_the_next_reading_is_correct() -> None:
    with KeyenceLK("sim://cframe/lk?readings=1,2,3&fault=drop&fault_at=6&fault_every=1000", QUICK) as sensor:
        assert sensor.read() == pytest.approx(1e-3)
        with raises("instrument.no_answer"):
            sensor.read()
        assert sensor.read() == pytest.approx(3e-3)


def test_a_controller_in_its_setting_mode_is_switched_to_measuring() -> None:
    with KeyenceLK(SIX, PATIENT) as sensor:
        sensor.transport.write(b"Q0\r")
        assert sensor.transport.read_until(b"\r") == b"Q0\r"
        with pytest.raises(InstrumentError, match="refuses 'MS,01' with error 51: not possible in this mode"):
            sensor.read()
        sensor.identify()
        assert sensor.read() == pytest.approx(1.2345e-3)


def test_endless_bytes_are_not_a_controller() -> None:
    device = SimulatedKeyenceLK(parse_address(SIX))
    try:
        device.answer = lambda request: b"hello\r" * 20
        with pytest.raises(ProtocolError, match="expected an answer to 'R0'; found 16 other lines"):
            KeyenceLK(device.url, QUICK).open()
    finally:
        device.close()


# ---------------------------------------------------------------------- the simulator without the driver


@pytest.mark.parametrize(
    ("request_text", "answer"),
    [
        ("MS,01", "MS,01,-01.5000"),
        ("ms,01", "MS,01,-01.5000"),
        ("MS", "ER,MS,61"),
        ("MS,01,02", "ER,MS,61"),
        ("MS,1", "ER,MS,60"),
        ("MS,02", "ER,MS,62"),
        ("M1", "ER,M1,50"),
        ("WS,01", "WS"),
        ("SR,OI,01", "ER,SR,51"),
        ("R0", "ER,R0,51"),
        ("Q0", "Q0"),
        ("HELLO", "ER,HELLO,50"),
        ("", "ER,,50"),
    ],
)
def test_the_controller_answers_as_in_the_manual(request_text: str, answer: str) -> None:
    device = SimulatedKeyenceLK(parse_address("sim://cframe/lk?readings=1.5"))
    try:
        assert device.answer(request_text.encode()) == answer.encode() + b"\r"
    finally:
        device.close()


def test_the_controller_answers_in_its_setting_mode_as_in_the_manual() -> None:
    device = SimulatedKeyenceLK(parse_address("sim://cframe/lk?readings=1.5&offset=-0.25"))
    try:
        talk = [
            ("Q0", "Q0"),
            ("Q0", "ER,Q0,51"),
            ("MS,01", "ER,MS,51"),
            ("SR,OI,01", "SR,OI,01,2"),
            ("SR,OF,01", "SR,OF,01,-00.2500"),
            ("SR,OF", "ER,SR,61"),
            ("SR,OF,03", "ER,SR,62"),
            ("SR,ZZ,01", "ER,SR,62"),
            ("SW,OF,01,0", "ER,SW,60"),
            ("SW,OF,01,+005000", "SW,OF"),
            ("SR,OF,01", "SR,OF,01,+00.5000"),
            ("SW,OI,01,9", "ER,SW,62"),
            ("SW,OI,01,1", "SW,OI"),
            ("R0", "R0"),
            ("MS,01", "MS,01,-001.000"),
        ]
        for request, answer in talk:
            assert device.answer(request.encode()) == answer.encode() + b"\r", request
    finally:
        device.close()


@pytest.mark.parametrize(
    "wrong", ["head=LK-X1", "controller=LK-G9", "display=9", "positive=up", "readings=one", "offset=x"]
)
def test_an_unknown_controller_is_refused_by_name(wrong: str) -> None:
    with pytest.raises(InstrumentError, match=wrong.partition("=")[0]):
        KeyenceLK(f"sim://cframe/lk?{wrong}").open()


# ---------------------------------------------------------------------- pace


class Clock:
    """A clock that only advances by sleeping and answering."""

    def __init__(self, answering: float) -> None:
        self.now, self.answering, self.slept = 100.0, answering, 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.slept += seconds
        self.now += seconds


@pytest.fixture
def device():
    device = SimulatedKeyenceLK(parse_address("sim://cframe/lk?readings=1,2,3,4"))
    yield device
    device.close()


def on_clock(monkeypatch: pytest.MonkeyPatch, sensor: KeyenceLK, clock: Clock) -> None:
    measure = sensor._measure

    def measured() -> tuple[float, int]:
        clock.now += clock.answering
        return measure()

    monkeypatch.setattr(sensor, "_measure", measured)
    monkeypatch.setattr("errormotion.instruments.point_lds.keyence_lk.driver.time", clock)


def test_requests_to_a_real_sensor_are_sent_at_its_rate(monkeypatch: pytest.MonkeyPatch, device) -> None:
    with KeyenceLK(device.url, LKSettings(rate=50.0)) as sensor:  # tcp:// : not known to be simulated
        clock = Clock(answering=0.004)
        on_clock(monkeypatch, sensor, clock)
        blocks = take(sensor, 2, block=50)
    assert values(blocks).size == 100
    assert clock.slept == pytest.approx(99 * (0.02 - 0.004))  # the first is queried at once


def test_a_sensor_that_cannot_keep_the_rate_is_an_error_with_figures(monkeypatch: pytest.MonkeyPatch, device) -> None:
    with KeyenceLK(device.url, LKSettings(rate=100.0)) as sensor:
        on_clock(monkeypatch, sensor, Clock(answering=0.035))
        with raises("sensor.rate.too_high"):
            take(sensor, 10)


# ---------------------------------------------------------------------- opening, closing, recording


def test_use_before_opening_is_refused_and_opening_is_idempotent() -> None:
    sensor = KeyenceLK(SIX)
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
    sensor = KeyenceLK(SIX)
    sensor.open()
    stream = sensor.stream()
    next(stream)
    sensor.close()
    with raises("instrument.not_open"):
        next(stream)


def test_host_times_are_monotonic() -> None:
    before = time.monotonic()
    with KeyenceLK(SIX) as sensor:
        times = [before, *(block.host_time for block in take(sensor, 5, block=10)), time.monotonic()]
    assert times == sorted(times)


@pytest.mark.parametrize("wire", ["pty", "tcp"])
def test_a_recorded_session_plays_back(tmp_path: Path, wire: str) -> None:
    path = tmp_path / "session.rec"
    with KeyenceLK(f"{SIX}&wire={wire}&fault=garbage&fault_at=9&fault_every=1000", PATIENT, record=path) as sensor:
        reading, blocks = sensor.read(), take(sensor, 2, block=7)
    with KeyenceLK(f"replay://{path}", PATIENT) as sensor:
        assert sensor.transport.simulated
        assert sensor.read() == reading
        again = take(sensor, 2, block=7)
    np.testing.assert_array_equal(values(again), values(blocks))
    assert reasons(again) == reasons(blocks)
    assert reasons(blocks)["garbled"] == 1


def test_a_driver_that_sends_another_request_fails_in_replay(tmp_path: Path) -> None:
    path = tmp_path / "session.rec"
    with KeyenceLK(SIX, record=path):
        pass
    with raises("replay.write.differs"):
        KeyenceLK(f"replay://{path}", LKSettings(output=2)).open()
