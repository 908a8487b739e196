"""The world of the simulators: one machine, one clock, until the last device is closed."""

import itertools
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from armed import CONTROLLER
from coded import raises

from errormotion.errors import InstrumentError
from errormotion.instruments import simulators
from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.point_lds.optoncdt import OptoNCDT, OptoSettings
from errormotion.instruments.simulators import world
from errormotion.instruments.spindle_frame.five_sensor_frame import FiveSensorFrame, FrameSettings
from errormotion.instruments.thermometer.dcon import DconTemperature
from errormotion.plugins import Samples
from errormotion.twin import Event

SLOW = OptoSettings(rate=1500.0, timeout=10.0)
FRAME = FrameSettings(rate=1500.0, timeout=10.0)


def names() -> set[str]:
    return {thread.name for thread in threading.enumerate() if thread.name.startswith(("sim-", "reader-"))}


def test_devices_of_one_machine_and_seed_share_a_world_and_others_do_not() -> None:
    with (
        OptoNCDT("sim://cframe/X1?seed=3", SLOW),
        VirtualController("sim://cframe/controller?seed=3", CONTROLLER) as controller,
        VirtualController("sim://cframe/controller?seed=4", CONTROLLER) as other,
    ):
        controller.elapse(10.0)
        assert controller.state()["time"] == 10.0
        assert other.state()["time"] == 0.0
        assert world("cframe", 3) is not world("cframe", 4)


def test_a_world_lives_until_its_last_device_is_closed() -> None:
    first, second = OptoNCDT("sim://cframe/X1?seed=3", SLOW), OptoNCDT("sim://cframe/X2?seed=3", SLOW)
    first.open()
    second.open()
    here = world("cframe", 3)
    first.read()
    first.close()
    assert world("cframe", 3) is here
    assert "sim-world-cframe" in names()
    second.close()
    assert world("cframe", 3) is not here
    assert names() == set()


def test_reset_ends_devices_that_were_left_open() -> None:
    sensor = OptoNCDT("sim://cframe/X1?seed=3", SLOW)
    sensor.open()
    stream = sensor.stream()
    next(stream)
    simulators.reset()
    assert {name for name in names() if name.startswith("sim-")} == set()
    with raises("connection.lost"):
        list(stream)
    sensor.close()


def test_the_clock_shows_the_time_that_the_readers_have_reached() -> None:
    with (
        FiveSensorFrame("sim://cframe?seed=3", FRAME) as frame,
        VirtualController("sim://cframe/c?seed=3", CONTROLLER) as controller,
    ):
        controller.start([])
        stream = frame.stream()
        for second in (0.5, 1.0, 1.5, 2.0):
            next(stream)
            assert controller.state()["time"] == pytest.approx(second, abs=1e-9)
        stream.close()
        assert controller.state()["time"] == pytest.approx(2.0, abs=1e-9)
        controller.elapse(58.0)
        next(frame.stream(["Z"]))
        assert controller.state()["time"] == pytest.approx(60.5, abs=1e-9)


def test_the_same_commands_give_the_same_samples() -> None:
    def session() -> np.ndarray:
        with (
            FiveSensorFrame("sim://cframe?seed=5", FRAME) as frame,
            VirtualController("sim://cframe/c?seed=5", CONTROLLER) as c,
        ):
            frame.read()
            frame.read()
            c.start([Event(0.0, spindle_speed=9000.0)])
            warm = np.concatenate([block.values for block in itertools.islice(frame.stream(), 5)], axis=1)
            again = np.concatenate([block.values for block in itertools.islice(frame.stream(), 5)], axis=1)
            return np.concatenate([warm, again], axis=1)

    np.testing.assert_array_equal(session(), session())


def test_a_schedule_is_kept_whatever_is_buffered() -> None:
    """The bar starts to turn at 20 s, although the samples were computed long before they were read."""
    with (
        FiveSensorFrame("sim://cframe?seed=3", FRAME) as frame,
        VirtualController("sim://cframe/c?seed=3", CONTROLLER) as controller,
    ):
        controller.start([Event(20.0, spindle_speed=15000.0)])
        x1 = np.concatenate([block.values[0] for block in itertools.islice(frame.stream(["X1"]), 80)])
    still, turning = x1[: 20 * 1500], x1[21 * 1500 :]
    assert np.std(still) < 0.5e-6  # noise of 0.3 um
    assert np.std(turning) > 2 * np.std(still)  # and the runout


def test_with_a_pace_the_clock_follows_real_time() -> None:
    with OptoNCDT("sim://cframe/X1?seed=3&pace=20", SLOW) as sensor:
        sensor.read()
        start = time.monotonic()
        list(itertools.islice(sensor.stream(block=1500), 4))  # 4 s at twentyfold pace
        assert time.monotonic() - start >= 4 / 20 - 0.05


def test_unsynchronised_sensors_may_have_different_rates() -> None:
    fast, slow = OptoSettings(rate=5000.0, timeout=10.0), OptoSettings(rate=2500.0, timeout=10.0)
    with (
        OptoNCDT("sim://cframe/X1?seed=3", fast) as one,
        OptoNCDT("sim://cframe/X2?seed=3", slow) as two,
        ThreadPoolExecutor() as pool,  # the clock waits for its slowest reader, so that each has a thread of its own
    ):
        read = [pool.submit(fifty_blocks, one, 1000), pool.submit(fifty_blocks, two, 500)]
        blocks = [block for reading in read for block in reading.result()]
    assert len(blocks) == 100
    assert not any(block.invalid for block in blocks)


def fifty_blocks(sensor: OptoNCDT, size: int) -> list[Samples]:
    return list(itertools.islice(sensor.stream(block=size), 50))


def test_temperatures_belong_to_the_last_sample_that_was_read() -> None:
    with (
        FiveSensorFrame("sim://cframe?seed=3", FRAME) as frame,
        VirtualController("sim://cframe/c?seed=3", CONTROLLER) as controller,
        DconTemperature("sim://cframe/t?seed=3") as thermometer,
    ):
        controller.start([Event(0.0, spindle_speed=15000.0)])
        list(itertools.islice(frame.stream(), 240))
        twin = world("cframe", 3).machine
        truth = dict(zip(twin.temperature_sensors, twin.temperatures([120.0])[0], strict=True))
        for name, reading in thermometer.read().items():
            assert reading == pytest.approx(truth[name], abs=0.1)  # five sigma of 0.02 K


@pytest.mark.parametrize("order", ["start", "mount", "elapse"])
def test_commands_that_would_interrupt_a_stream_are_refused(order: str) -> None:
    with (
        FiveSensorFrame("sim://cframe?seed=3", FRAME) as frame,
        VirtualController("sim://cframe/c?seed=3", CONTROLLER) as controller,
    ):
        stream = frame.stream()
        next(stream)
        arguments = {"start": [[]], "mount": ["sphere"], "elapse": [1.0]}[order]
        with pytest.raises(InstrumentError, match=r"while .*X1.* stream"):
            getattr(controller, order)(*arguments)
        assert not next(stream).invalid
        stream.close()
