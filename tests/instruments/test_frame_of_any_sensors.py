"""A spindle frame of any five point sensors."""

import itertools
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from coded import raises
from pydantic import ValidationError

from errormotion.campaign.files import parse_bench
from errormotion.datasets.units import EDGE
from errormotion.errors import BenchError, InstrumentError
from errormotion.instruments.spindle_frame import sampling
from errormotion.instruments.spindle_frame.five_sensor_frame import FiveSensorFrame, FrameSettings
from errormotion.testing.sessions import open_things

CHANNELS = ("X1", "X2", "Y1", "Y2", "Z")
RATE = 200.0


def lk(channel: int, **more: object) -> dict[str, object]:
    """A sensor that reads 0.1 mm times the number of preceding channels; every third reading of Z is missing."""
    readings = "0.4,0.4,nan" if channel == 4 else f"{0.1 * channel}"
    return {"driver": "keyence_lk", "address": f"sim://cframe/lk{channel}?seed=3&readings={readings}", **more}


def settings(**changes: object) -> FrameSettings:
    sensors = {name: lk(channel) for channel, name in enumerate(CHANNELS)}
    return FrameSettings.model_validate({"rate": RATE, "sensors": sensors, **changes})


class Sensor:
    """A sensor that counts its readings; each takes some time."""

    def __init__(self, seconds: float = 0.0, fails: int = -1) -> None:
        self.seconds, self.fails, self.readings = seconds, fails, 0

    def read(self) -> float:
        time.sleep(self.seconds)
        self.readings += 1
        if self.readings == self.fails:
            raise InstrumentError("no answer")
        return 1e-3 * self.readings


def test_sensors_without_synchronisation_are_read_together() -> None:
    with FiveSensorFrame(settings=settings()) as frame:
        blocks = list(itertools.islice(frame.stream(block=30), 2))
        identity = frame.identify()
    values = np.concatenate([block.values for block in blocks], axis=1)
    assert [block.first for block in blocks] == [0, 30]
    assert values.shape == (5, 60)
    for channel in range(4):
        known = values[channel][np.isfinite(values[channel])]
        np.testing.assert_allclose(known, 1e-4 * channel, atol=1e-12)
    lost = sum(block.dropped for block in blocks)
    unknown = sum(block.invalid.get("Z no value", 0) for block in blocks)
    assert np.isnan(values[0]).sum() == lost
    assert np.isnan(values[4]).sum() == lost + unknown
    assert unknown == (60 - lost) // 3
    assert identity.manufacturer == "Keyence"
    assert identity.details["synchronised"] is False


def test_readings_are_taken_at_the_rate() -> None:
    sensors = {name: Sensor() for name in CHANNELS}
    start = time.monotonic()
    (block,) = itertools.islice(sampling.polled(sensors, 20, RATE), 1)
    assert time.monotonic() - start >= 19 / RATE
    assert (block.rate, block.first) == (RATE, 0)


def test_an_instant_during_a_reading_is_lost_in_all_channels_and_counted() -> None:
    sensors = {"X1": Sensor(), "Z": Sensor(2.5 / RATE)}
    (block,) = itertools.islice(sampling.polled(sensors, 30, RATE), 1)
    missing = np.isnan(block.values)
    assert block.dropped >= 15
    assert (missing.sum(axis=1) == block.dropped).all()
    assert block.invalid == {"X1 lost": block.dropped, "Z lost": block.dropped}
    taken = np.flatnonzero(~missing[1])
    assert np.diff(taken).min(initial=2) >= 2  # the next instant passes during each reading
    assert sensors["X1"].readings == sensors["Z"].readings == taken.size


def test_a_sensor_that_fails_is_named_and_leaves_no_thread() -> None:
    before = set(threading.enumerate())
    sensors = {"X1": Sensor(), "Y2": Sensor(fails=3)}
    with raises("instrument.other"):
        list(sampling.polled(sensors, 10, RATE))
    assert set(threading.enumerate()) == before


def test_leaving_a_frame_during_a_stream_closes_everything() -> None:
    before = open_things()
    with FiveSensorFrame(settings=settings()) as frame:
        stream: Iterator[object] = frame.stream()
        next(stream)
    del stream
    deadline = time.monotonic() + 2.0
    while open_things() - before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not open_things() - before


def test_a_recorded_frame_of_any_sensors_plays_back(tmp_path: Path) -> None:
    path = tmp_path / "frame.rec"
    with FiveSensorFrame(settings=settings(), record=path) as frame:
        serial, reading = frame.identify().serial_number, frame.read()
    with FiveSensorFrame(f"replay://{path}", settings()) as frame:
        assert frame.identify().serial_number == serial
        np.testing.assert_array_equal(frame.read(), reading)


def test_synchronised_sensors_with_their_own_tables_sample_like_those_of_the_frame() -> None:
    shared = {"rate": 1500.0, "timeout": 10.0}
    table = {name: {"driver": "optoncdt", "address": f"sim://cframe/{name}?seed=3", **shared} for name in CHANNELS}
    found = []
    for address, frame_settings in (
        ("sim://cframe?seed=3", FrameSettings(**shared)),
        ("", FrameSettings.model_validate({**shared, "sensors": table})),
    ):
        with FiveSensorFrame(address, frame_settings) as frame:
            assert frame.identify().details["synchronised"] is True
            assert frame.encoding["dtype"] == "uint16"
            found.append((next(iter(frame.stream())), frame.encoding, frame.warm))
    (one, *more), (other, *same) = found
    np.testing.assert_array_equal(one.values, other.values)
    assert more == same


BENCH = """
schema = "errormotion.bench/1"
name = "Lab"
machine = "virtual"
[instruments.frame]
driver = "five_sensor_frame"
rate = "50 Hz"
"""


def bench(**changed: str) -> str:
    lines = {name: f'driver = "keyence_lk", address = "serial:///dev/tty{name}", head = "LK-H020"' for name in CHANNELS}
    return BENCH + "".join(f"sensors.{name} = {{ {text} }}\n" for name, text in {**lines, **changed}.items())


def test_a_bench_file_states_driver_address_and_settings_of_each_sensor() -> None:
    text = bench(Z='driver = "keyence_lk", address = "serial:///dev/ttyZ", noise = "0.2 um"')
    (frame,) = parse_bench(text, Path("bench.toml")).instruments
    stored = FrameSettings.model_validate_json(frame.settings.model_dump_json())
    assert stored == frame.settings
    assert stored.sensor("Z")[1].noise == pytest.approx(0.2e-6)
    assert stored.sensor("X1")[1].head == "LK-H020"
    assert FiveSensorFrame("", stored).addresses["Y2"] == "serial:///dev/ttyY2"


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"Z": 'driver = "keyence_kl", address = "tcp://a:1"'},
            "Z.driver: No instrument plugin 'keyence_kl'.*Did you mean 'keyence_lk'",
        ),
        (
            {"Z": 'driver = "mtconnect", address = "tcp://a:1"'},
            "Z.driver: expected an instrument of kind point_lds; found controller",
        ),
        (
            {"Z": 'driver = "keyence_lk", address = "tcp://a:1", heed = "LK-H020"'},
            "Z.heed: unknown key; did you mean 'head'",
        ),
        ({"Z": 'driver = "keyence_lk", address = "tcp://a:1", noise = 1'}, "Z.noise: expected a length with its unit"),
        ({"W": 'driver = "keyence_lk", address = "tcp://a:1"'}, "the channels are X1, X2, Y1, Y2, Z; unknown: W"),
        ({"Z": 'driver = "keyence_lk", address = "com1"'}, "Z.address: Expected an address such as"),
    ],
)
def test_an_error_in_the_table_of_a_sensor_is_reported_with_its_key(changed: dict[str, str], message: str) -> None:
    with pytest.raises(BenchError, match=rf"(?s)bench\.toml.*instruments\.frame\.sensors: .*{message}"):
        parse_bench(bench(**changed), Path("bench.toml"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rate": "20 kHz"}, "read one by one, at 1000 Hz at most; found 20000 Hz"),
        ({"rate": "50 Hz", "addresses": dict.fromkeys(CHANNELS, "tcp://a:1")}, "found 'addresses' as well"),
    ],
)
def test_settings_that_contradict_the_sensors_are_refused(changes: dict[str, object], message: str) -> None:
    sensors = {name: lk(0) for name in CHANNELS}
    with pytest.raises(ValidationError, match=message):
        FrameSettings.model_validate({"sensors": sensors, **changes}, context=EDGE)
