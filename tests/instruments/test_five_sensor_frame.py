"""Five sensors on one clock."""

import itertools
import json
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from coded import raises
from pydantic import ValidationError

from errormotion.datasets.units import EDGE
from errormotion.errors import InstrumentError, InstrumentTimeoutError, ReplayError
from errormotion.instruments.point_lds.optoncdt import OptoNCDT
from errormotion.instruments.simulators import world
from errormotion.instruments.spindle_frame.five_sensor_frame import FiveSensorFrame, FrameSettings
from errormotion.plugins import Samples
from errormotion.twin import Event

CHANNELS = ("X1", "X2", "Y1", "Y2", "Z")
HALF_A_STEP = 2e-3 * 1.02 / 65520 / 2 * 1.001
ADDRESS = "sim://cframe?seed=3"


def settings(**changes: object) -> FrameSettings:
    return FrameSettings(**{"rate": 1500.0, "timeout": 10.0, **changes})


def with_fault(channel: str, fault: str, **changes: object) -> FrameSettings:
    addresses = {name: f"sim://cframe/{name}?seed=3" for name in CHANNELS}
    addresses[channel] += f"&fault={fault}"
    return settings(addresses=addresses, **changes)


def take(frame: FiveSensorFrame, blocks: int, **how: object) -> list[Samples]:
    return list(itertools.islice(frame.stream(**how), blocks))


def values(blocks: list[Samples]) -> np.ndarray:
    return np.concatenate([block.values for block in blocks], axis=1)


def test_sample_0_is_the_same_instant_for_all_channels_and_so_are_the_others() -> None:
    with FiveSensorFrame(ADDRESS, settings()) as frame:
        blocks = take(frame, 20)
        truth = world("cframe", 3).machine.distances(0, 15000, 1500.0)
    assert [block.first for block in blocks] == list(range(0, 15000, 750))
    np.testing.assert_allclose(values(blocks), truth, rtol=0, atol=HALF_A_STEP)


@pytest.mark.parametrize("wire", ["tcp", "pty"])
def test_a_turning_spindle_is_measured_from_time_0_on(wire: str) -> None:
    with FiveSensorFrame(f"{ADDRESS}&wire={wire}", settings()) as frame:
        frame.read()
        world("cframe", 3).start([Event(0.0, spindle_speed=15000.0)])
        blocks = take(frame, 4)
        truth = world("cframe", 3).machine.distances(0, 3000, 1500.0)
    np.testing.assert_allclose(values(blocks), truth, rtol=0, atol=HALF_A_STEP)


def test_some_channels_may_stream_separately_and_in_any_order() -> None:
    with FiveSensorFrame(ADDRESS, settings()) as frame:
        single = values(take(frame, 2, channels=["Z"]))
        pair = values(take(frame, 2, channels=["Y1", "X1"], block=500))
        truth = world("cframe", 3).machine.distances(0, 2500, 1500.0)
    np.testing.assert_allclose(single, truth[[4], :1500], rtol=0, atol=HALF_A_STEP)
    np.testing.assert_allclose(pair, truth[[2, 0], 1500:], rtol=0, atol=HALF_A_STEP)


def test_a_reading_is_one_distance_of_each_channel() -> None:
    with FiveSensorFrame(ADDRESS, settings()) as frame:
        reading = frame.read()
    assert reading.shape == (5,)
    np.testing.assert_allclose(reading, 1e-3, atol=0.1e-3)  # set to mid-range, 1 mm


@pytest.mark.parametrize("channels", [["X3"], ["X1", "X1"], []])
def test_missing_channels_are_refused(channels: list[str]) -> None:
    with FiveSensorFrame(ADDRESS, settings()) as frame, raises("frame.channels.unknown"):
        frame.stream(channels)


def test_one_stream_at_a_time() -> None:
    with FiveSensorFrame(ADDRESS, settings()) as frame:
        stream = frame.stream()
        next(stream)
        with raises("stream.running"):
            frame.stream()
        stream.close()
        assert len(take(frame, 1)) == 1


# ---------------------------------------------------------------------- faults


@pytest.mark.parametrize("channel", ["X1", "Y2", "Z"])
def test_a_stalled_channel_is_named(channel: str) -> None:
    frame = FiveSensorFrame(settings=with_fault(channel, "silence&fault_at=2000", timeout=0.5))
    with frame, pytest.raises(InstrumentTimeoutError, match=f"^{channel}: no data for 0.5 s"):
        take(frame, 100)


def test_a_missing_channel_is_named() -> None:
    with pytest.raises(InstrumentTimeoutError, match=r"^Channel Y1: .* received nothing"):
        FiveSensorFrame(settings=with_fault("Y1", "silence", timeout=0.5)).open()


def test_a_broken_connection_is_an_instrument_error() -> None:
    frame = FiveSensorFrame(settings=with_fault("X2", "disconnect&fault_at=2000"))
    with frame, pytest.raises(InstrumentError, match=r"^X2: .* is lost"):
        take(frame, 100)


def test_a_sensor_out_of_range_for_minutes_is_only_nan_and_counted() -> None:
    samples = 4 * 60 * 1500
    with FiveSensorFrame(settings=with_fault("Y2", "out_of_range&fault_at=1500")) as frame:
        blocks = take(frame, 4, block=samples // 4)
    missing = np.isnan(values(blocks))
    assert missing[3].sum() == samples - 1500
    assert not missing[[0, 1, 2, 4]].any()
    assert sum(block.invalid["Y2 no peak"] for block in blocks) == samples - 1500
    assert not any(block.dropped for block in blocks)


def test_lost_samples_of_one_channel_do_not_shift_the_others() -> None:
    with FiveSensorFrame(settings=with_fault("X2", "drop&fault_every=10")) as frame:
        blocks = take(frame, 4)
        truth = world("cframe", 3).machine.distances(0, 3000, 1500.0)
    truth[1, ::10] = np.nan
    np.testing.assert_allclose(values(blocks), truth, rtol=0, atol=HALF_A_STEP)
    assert sum(block.dropped for block in blocks) == 300
    assert [block.invalid for block in blocks] == [{"X2 lost": 75}] * 4


# ---------------------------------------------------------------------- identity, warmth, geometry


def test_the_identity_names_all_sensors_and_is_json() -> None:
    with FiveSensorFrame(ADDRESS, settings()) as frame:
        identity = frame.identify()
        assert identity == frame.identify()
    assert identity.simulated
    assert all(f"{name} " in identity.serial_number for name in CHANNELS)
    assert len({part["serial"] for part in identity.details["channels"].values()}) == 5
    assert json.loads(json.dumps(asdict(identity)))["details"]["address"] == ADDRESS


def test_sensors_without_an_operating_time_are_treated_as_cold() -> None:
    with FiveSensorFrame(ADDRESS, settings()) as frame:
        assert not frame.warm
    late = datetime.now(UTC) - timedelta(hours=1)
    with FiveSensorFrame(ADDRESS, settings(powered_since=late)) as frame:
        assert not frame.warm


def test_sensors_that_report_their_operating_time_are_warm_after_two_hours(monkeypatch: pytest.MonkeyPatch) -> None:
    with FiveSensorFrame(ADDRESS, settings()) as frame:
        for seconds, warm in ((7199.0, False), (7200.0, True)):
            monkeypatch.setattr(OptoNCDT, "on_for", lambda _, seconds=seconds: seconds, raising=False)
            assert frame.warm == warm


def test_a_setting_may_state_when_the_sensors_were_switched_on() -> None:
    early = datetime.now(UTC) - timedelta(hours=3)
    with FiveSensorFrame(f"{ADDRESS}&warm=0", settings(powered_since=early)) as frame:
        assert frame.warm
    with pytest.raises(ValidationError, match="time zone"):
        settings(powered_since=early.replace(tzinfo=None))


def test_the_default_geometry_is_the_virtual_machines() -> None:
    geometry = FiveSensorFrame().geometry
    drawn = world("cframe", 3).machine.frame
    np.testing.assert_allclose(geometry.nominal_origin, drawn.nominal_origin, atol=1e-15)
    np.testing.assert_array_equal(geometry.nominal_direction, drawn.nominal_direction)
    np.testing.assert_allclose(geometry.expansion, drawn.expansion, atol=1e-18)
    np.testing.assert_allclose(geometry.levels, drawn.levels, atol=1e-15)
    assert (geometry.range, geometry.bar_radius) == (drawn.range, world("cframe", 3).machine.bar_radius)


def test_the_frame_carries_each_sensor_along_its_axis_by_the_published_expansion() -> None:
    geometry = FiveSensorFrame().geometry
    moved = geometry.origins_at(np.array([20.0, 21.0])) - geometry.nominal_origin
    assert not moved[0].any()
    expected = [(2.1e-6, 0, 0), (2.1e-6, 0, 0), (0, 2.4e-6, 0), (0, 2.4e-6, 0), (0, 0, 1.3e-6)]
    np.testing.assert_allclose(moved[1], expected, atol=1e-15)


def test_settings_from_a_bench_file_have_units() -> None:
    written = {
        "rate": "20 kHz",
        "bar_radius": "10 mm",
        "levels": ["10 mm", "50 mm"],
        "expansion": ["2.1 um/K", "2.4 um/K", "1.3 um/K"],
        "origin": {name: ["11 mm", "0 mm", "10 mm"] for name in CHANNELS},
        "direction": {name: [-1, 0, 0] for name in CHANNELS},
        "addresses": {name: f"tcp://10.0.0.{i}:23" for i, name in enumerate(CHANNELS)},
    }
    read = FrameSettings.model_validate(written, context=EDGE)
    assert read.bar_radius == pytest.approx(0.01)
    assert read.origin["Z"] == pytest.approx((0.011, 0, 0.01))
    with pytest.raises(ValidationError, match="expected a length with its unit"):
        FrameSettings.model_validate({"bar_radius": 5}, context=EDGE)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"bar_radius": 5.0}, "found 5000 mm. In Python, lengths are in m"),
        (
            {"direction": {**dict.fromkeys(CHANNELS, (0.0, 0.0, 1.0)), "X2": (1.0, 1.0, 0.0)}},
            "unit vector as the direction of X2",
        ),
        ({"addresses": {"X1": "tcp://a:1"}}, "missing: X2, Y1, Y2, Z"),
        ({"origin": {**dict.fromkeys(CHANNELS, (0.0, 0.0, 0.0)), "X3": (0.0, 0.0, 0.0)}}, "unknown: X3"),
    ],
)
def test_an_invalid_geometry_is_refused(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        settings(**wrong)


@pytest.mark.parametrize(("address", "message"), [("", "needs 'addresses'"), ("tcp://10.0.0.1:23", "one device")])
def test_five_sensors_need_five_addresses(address: str, message: str) -> None:
    with pytest.raises(InstrumentError, match=message):
        FiveSensorFrame(address).open()


def test_use_before_opening_is_refused_and_opening_is_idempotent() -> None:
    frame = FiveSensorFrame(ADDRESS, settings())
    for use in (frame.read, frame.identify, frame.stream, lambda: frame.warm):
        with raises("instrument.not_open"):
            use()
    frame.close()
    frame.open()
    frame.open()
    assert np.isfinite(frame.read()).all()
    frame.close()
    frame.close()


# ---------------------------------------------------------------------- recording


def test_a_recorded_session_of_five_plays_back_with_the_same_samples(tmp_path: Path) -> None:
    path = tmp_path / "frame.rec"
    with FiveSensorFrame(f"{ADDRESS}&fault=drop", settings(), record=path) as frame:
        reading, blocks = frame.read(), take(frame, 10)
    assert sorted(each.name for each in tmp_path.iterdir()) == [
        *(f"frame.{name}.rec" for name in CHANNELS),
        "frame.rec",
    ]
    with FiveSensorFrame(f"replay://{path}", settings()) as frame:
        np.testing.assert_array_equal(frame.read(), reading)
        again = take(frame, 10)
    np.testing.assert_array_equal(values(again), values(blocks))
    assert [block.invalid for block in again] == [block.invalid for block in blocks]


def test_a_changed_byte_of_one_channel_fails_and_names_it(tmp_path: Path) -> None:
    path = tmp_path / "frame.rec"
    with FiveSensorFrame(ADDRESS, settings(), record=path) as frame:
        frame.read()
    part = tmp_path / "frame.Y1.rec"
    lines = part.read_text().splitlines()
    lines[3] = lines[3][:-1] + ("0" if lines[3][-1] != "0" else "1")
    part.write_text("\n".join(lines) + "\n")
    with pytest.raises(ReplayError, match=r"Channel Y1: .*frame\.Y1\.rec, line 4"):
        FiveSensorFrame(f"replay://{path}", settings()).open()
