"""The optoNCDT driver against scripted sensors that answer as in the manuals."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from coded import raises
from optoncdt_by_the_manual import Bench, Bus, Sensor
from pydantic import ValidationError

from errormotion.datasets.units import EDGE
from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments.point_lds.optoncdt import OptoNCDT, OptoSettings
from errormotion.instruments.spindle_frame.five_sensor_frame import FiveSensorFrame
from errormotion.instruments.spindle_frame.settings import CHANNELS, FrameSettings

OPTO_2300 = OptoSettings(rate=2500.0, timeout=5.0)
OPTO_1420 = OptoSettings(model="ILD1420", rate=4000.0, timeout=5.0)


def readings(driver: OptoNCDT, count: int) -> np.ndarray:
    return np.concatenate([block.values[0] for block in itertools.islice(driver.stream(block=count), 1)])


@pytest.mark.parametrize("echo", ["ON", "OFF"])
@pytest.mark.parametrize(("model", "settings"), [("ILD2300", OPTO_2300), ("ILD1420", OPTO_1420)])
def test_a_sensor_by_the_manual_streams(model: str, settings: OptoSettings, echo: str) -> None:
    sensor = Sensor(model, millimetres=10.0, ECHO=echo)
    with Bench(sensor), OptoNCDT(sensor.url, settings) as driver:
        values = readings(driver, 200)
        assert driver.identify().model.startswith(model)
    raws = (values / 10e-3 + 0.01) / 1.02 * 65520
    np.testing.assert_allclose(np.diff(raws), 1.0, atol=1e-6)


def test_only_what_the_manual_lists_is_sent() -> None:
    for model, settings in (("ILD2300", OPTO_2300), ("ILD1420", OPTO_1420)):
        sensor = Sensor(model, millimetres=10.0)
        with Bench(sensor), OptoNCDT(sensor.url, settings) as driver:
            driver.read()
            assert "refused commands" not in driver.identify().details
        assert ("SYNC NONE TERMOFF" in sensor.received) == (model == "ILD2300")
        assert "RESETCNT MEASCNT" in sensor.received


@pytest.mark.parametrize(("rate", "word"), [(49.14e3, "49"), (1500.0, "1.5"), (20e3, "20")])
def test_the_rates_have_the_words_of_the_manual(rate: float, word: str) -> None:
    sensor = Sensor("ILD2300")
    with Bench(sensor), OptoNCDT(sensor.url, OptoSettings(rate=rate, timeout=5.0)) as driver:
        assert sensor.settings["MEASRATE"] == word
        assert driver.rate == rate


def test_the_rate_of_an_old_bench_file_is_still_accepted() -> None:
    assert OptoSettings.model_validate({"rate": "49.14 kHz"}, context=EDGE).rate == 49.14e3


def test_a_rate_of_newer_sensors_is_refused_by_an_older_one() -> None:
    settings = OptoSettings(model="ILD1420", rate=8000.0, timeout=5.0)
    older, newer = Sensor("ILD1420"), Sensor("ILD1420", rates=r"0\.25|0\.5|1|2|4|8")
    with Bench(older, newer):
        with pytest.raises(InstrumentError, match="refuses 'MEASRATE 8': E236"):
            OptoNCDT(older.url, settings).open()
        with OptoNCDT(newer.url, settings):
            assert newer.settings["MEASRATE"] == "8"


def test_a_range_that_the_sensor_does_not_have_is_refused() -> None:
    sensor = Sensor("ILD2300", millimetres=20.0)
    with Bench(sensor), raises("sensor.range.differs"):
        OptoNCDT(sensor.url, OptoSettings(range=2e-3, rate=2500.0, timeout=5.0)).open()


@pytest.mark.parametrize("millimetres", [2.0, 20.0, 200.0])
def test_the_range_is_the_one_that_the_sensor_reports(millimetres: float) -> None:
    sensor = Sensor("ILD2300", millimetres=millimetres, values=lambda n: 32760)
    with Bench(sensor):
        driver = OptoNCDT(sensor.url, OPTO_2300)
        with raises("sensor.range.unknown"):
            driver.measuring_range  # noqa: B018
        with driver:
            assert driver.measuring_range == (0.0, pytest.approx(millimetres * 1e-3))
            assert driver.read() == pytest.approx(millimetres / 2 * 1e-3)
            assert driver.encoding["scale_factor"] == pytest.approx(1.02 / 65520 * millimetres * 1e-3)


@pytest.mark.parametrize(
    ("model", "left_on"),
    [
        ("ILD2300", {"OUTADD_RS422": "SHUTTER INTENSITY"}),
        ("ILD2300", {"OUTSTATISTIC_RS422": "MIN MAX PEAK2PEAK"}),
        ("ILD2300", {"OUTDIST_RS422": "DIST1 DIST2"}),
        ("ILD2300", {"AVERAGE": "MEDIAN 9", "OUTHOLD": "INFINITE", "OUTREDUCE": "10"}),
        ("ILD2300", {"TRIGGER": "EDGE TERMON"}),
        ("ILD1420", {"OUTADD_RS422": "TIMESTAMP DIST_RAW", "OUTREDUCEDEVICE": "RS422"}),
        ("ILD1420", {"OUTHOLD": "100", "AVERAGE": "MOVING 16", "TRIGGER": "EDGE"}),
    ],
)
def test_outputs_of_an_earlier_user_are_cleared_and_restored(model: str, left_on: dict[str, str]) -> None:
    sensor = Sensor(model, millimetres=10.0, **left_on)
    settings = OPTO_2300 if model == "ILD2300" else OPTO_1420
    with Bench(sensor):
        before = dict(sensor.settings)
        with OptoNCDT(sensor.url, settings) as driver:
            assert sensor.layout() == ["DIST1", "COUNTER"]
            assert {sensor.settings[name] for name in left_on} <= {"NONE", "NONE TERMON", "COUNTER", "DIST1", "1"}
            assert np.isfinite(readings(driver, 100)).all()
        assert sensor.settings == before


OPTIONAL = [
    ("ILD1420", "AVERAGE", "MOVING 16"),
    ("ILD1420", "AVERAGE", "MEDIAN 5"),
    ("ILD1420", "TRIGGER", "EDGE"),
    ("ILD1420", "LASERPOW", "REDUCED"),
    ("ILD2300", "OUTREDUCE", "10"),
    ("ILD2300", "OUTHOLD", "INFINITE"),
]


@pytest.mark.parametrize(("model", "name", "value"), OPTIONAL)
def test_a_setting_that_changes_the_values_and_cannot_be_cleared_is_an_error(model: str, name: str, value: str) -> None:
    sensor = Sensor(model, millimetres=10.0, **{name: value})
    sensor.grammar = sensor.grammar | {name: value.replace(".", r"\.")}  # it refuses every other value
    settings = OPTO_2300 if model == "ILD2300" else OPTO_1420
    with (
        Bench(sensor),
        pytest.raises(InstrumentError, match=rf"refuses '{name} \w+': E.*its setting is '{name} {value}'"),
    ):
        OptoNCDT(sensor.url, settings).open()
    assert sensor.settings[name] == value


@pytest.mark.parametrize(("model", "name", "value"), OPTIONAL)
def test_a_setting_that_is_neutral_is_not_sent(model: str, name: str, value: str) -> None:
    sensor = Sensor(model, millimetres=10.0)
    sensor.grammar = sensor.grammar | {name: value}  # it would refuse the neutral value that it has
    with Bench(sensor), OptoNCDT(sensor.url, OPTO_2300 if model == "ILD2300" else OPTO_1420) as driver:
        assert np.isfinite(readings(driver, 100)).all()
        assert "refused commands" not in driver.identify().details


def test_a_setting_that_the_sensor_does_not_have_is_a_remark() -> None:
    sensor = Sensor("ILD1420", millimetres=10.0)
    sensor.grammar = {name: words for name, words in sensor.grammar.items() if name != "TRIGGER"}
    del sensor.settings["TRIGGER"]
    with Bench(sensor), OptoNCDT(sensor.url, OPTO_1420) as driver:
        assert driver.identify().details["refused commands"] == "TRIGGER NONE"


def test_values_that_cannot_be_cleared_are_refused_with_their_names() -> None:
    sensor = Sensor("ILD2300")
    sensor.layout = lambda: ["DIST1", "THICK12", "COUNTER"]  # type: ignore[method-assign]
    with Bench(sensor), pytest.raises(InstrumentError, match=r"lists .*THICK12"):
        OptoNCDT(sensor.url, OPTO_2300).open()


def test_the_counter_may_precede_the_distance() -> None:
    sensor = Sensor("ILD2300", counter_first=True)
    with Bench(sensor), OptoNCDT(sensor.url, OPTO_2300) as driver:
        values = readings(driver, 200)
    np.testing.assert_allclose(np.diff(values) / (2e-3 * 1.02 / 65520), 1.0, atol=1e-6)


def test_a_streaming_sensor_and_an_incomplete_command_are_handled() -> None:
    sensor = Sensor("ILD2300", OUTPUT="RS422", OUTADD_RS422="SHUTTER INTENSITY")
    sensor._line = b"MEASRA"
    with Bench(sensor), OptoNCDT(sensor.url, OPTO_2300) as driver:
        assert np.isfinite(readings(driver, 100)).all()


def test_an_output_in_use_is_restored_and_an_unused_one_is_not() -> None:
    for before, after in (("ANALOG", "ANALOG"), ("RS422", "NONE")):
        sensor = Sensor("ILD1420", OUTPUT=before, MEASRATE="2")
        with Bench(sensor):
            with OptoNCDT(sensor.url, OPTO_1420):
                assert sensor.settings["MEASRATE"] == "4"
            assert (sensor.settings["OUTPUT"], sensor.settings["MEASRATE"]) == (after, "2")


def test_a_mastered_sensor_measures_from_the_start_of_its_range_and_is_not_mastered_again() -> None:
    sensor = Sensor("ILD2300", MASTERMV="MASTER 1.5")
    with Bench(sensor):
        with OptoNCDT(sensor.url, OPTO_2300):
            assert sensor.settings["MASTERMV"] == "NONE"
        assert sensor.settings["MASTERMV"] == "NONE"


def test_the_termination_of_the_sync_line_stays() -> None:
    sensor = Sensor("ILD2300", SYNC="NONE TERMON")
    with Bench(sensor), OptoNCDT(sensor.url, OPTO_2300) as driver:
        driver.read()
        assert sensor.settings["SYNC"] == "NONE TERMON"


@pytest.mark.parametrize(("model", "last"), [("ILD2300", 64876), ("ILD1420", 64877)])
def test_the_measuring_range_ends_as_in_the_manual_of_the_model(model: str, last: int) -> None:
    for raw, known in ((last, True), (last + 1, False)):
        sensor = Sensor(model, millimetres=10.0, values=lambda n, raw=raw: raw)
        with Bench(sensor), OptoNCDT(sensor.url, OPTO_2300 if model == "ILD2300" else OPTO_1420) as driver:
            assert np.isfinite(driver.read()) == known


# ---------------------------------------------------------------------- late answers


def test_after_a_late_answer_the_next_one_is_correct() -> None:
    sensor = Sensor("ILD2300")
    with Bench(sensor), OptoNCDT(sensor.url, OptoSettings(rate=2500.0, timeout=0.3)) as driver:
        sensor.late, sensor.late_for = 0.45, "GETINFO"
        with pytest.raises(InstrumentTimeoutError):
            driver.command("GETINFO")
        assert driver.command("MEASRATE") == ["MEASRATE 2.5"]
        assert driver.command("OUTADD_RS422") == ["OUTADD_RS422 COUNTER"]
        assert np.isfinite(driver.read())


def test_after_a_late_answer_in_a_stream_the_next_one_is_correct() -> None:
    sensor = Sensor("ILD2300")
    with Bench(sensor), OptoNCDT(sensor.url, OptoSettings(rate=2500.0, timeout=0.3)) as driver:
        stream = driver.stream(block=10)
        next(stream)
        sensor.late, sensor.late_for = 0.45, "GETINFO"
        with pytest.raises(InstrumentTimeoutError):
            driver.command("GETINFO")
        assert driver.command("MEASRATE") == ["MEASRATE 2.5"]
        assert driver.command("OUTADD_RS422") == ["OUTADD_RS422 COUNTER"]
        stream.close()


def test_a_sensor_that_stays_silent_is_a_timeout_error_each_time() -> None:
    sensor = Sensor("ILD2300")
    with Bench(sensor):
        driver = OptoNCDT(sensor.url, OptoSettings(rate=2500.0, timeout=0.2))
        driver.open()
        sensor.silent_for = "GETINFO"
        for _ in range(2):
            with pytest.raises(InstrumentTimeoutError):
                driver.identify()
        sensor.silent_for = ""
        assert driver.identify().model == "ILD2300"
        driver.close()


# ---------------------------------------------------------------------- five sensors


def test_five_sensors_on_one_sync_line_start_at_the_same_instant_each_time() -> None:
    bus = Bus()
    sensors = {name: Sensor("ILD2300", bus=bus) for name in CHANNELS}
    sensors["Y2"].settings["SYNC"] = "MASTER TERMON"  # as after an earlier user
    addresses = {name: sensor.url for name, sensor in sensors.items()}
    with (
        Bench(*sensors.values()),
        FiveSensorFrame(settings=FrameSettings(rate=2500.0, timeout=5.0, addresses=addresses)) as frame,
    ):
        for channels in (None, ["Y1", "Z", "X1"], None):
            block = next(iter(itertools.islice(frame.stream(channels, block=200), 1)))
            assert np.isfinite(block.values).all()
            assert np.ptp(block.values, axis=0).max() == 0.0
    found = {name: sensors[name].settings["SYNC"] for name in CHANNELS}
    assert found == dict.fromkeys(CHANNELS, "NONE TERMOFF") | {"Y2": "MASTER TERMON"}


def test_a_model_without_sync_is_not_taken_for_one_with_it() -> None:
    sensor = Sensor("ILD1420")
    with Bench(sensor), OptoNCDT(sensor.url, OPTO_1420) as driver:
        with raises("sensor.not_synchronisable"):
            driver.start(10, "SLAVE")
        assert np.isfinite(driver.read())
        assert not [line for line in sensor.received if line.startswith("SYNC")]


def test_a_wrong_setting_names_what_the_model_offers() -> None:
    with pytest.raises(ValidationError, match=r"1\.5, 2\.5, 5, 10, 20, 30, 49\.14 kHz; found 49 kHz"):
        OptoSettings(rate=49e3)


def test_a_session_by_the_manual_is_replayed(tmp_path: Path) -> None:
    path, sensor = tmp_path / "book.rec", Sensor("ILD2300", millimetres=20.0)
    with Bench(sensor), OptoNCDT(sensor.url, OPTO_2300, record=path) as driver:
        values = readings(driver, 50)
    with OptoNCDT(f"replay://{path}", OPTO_2300) as driver:
        assert driver.measuring_range[1] == pytest.approx(20e-3)
        np.testing.assert_array_equal(readings(driver, 50), values)
