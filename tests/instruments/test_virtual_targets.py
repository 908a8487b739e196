"""Targets in the virtual world: the stage moves, and every point sensor on it reads the plane or the bar."""

import numpy as np
import pytest
from armed import CONTROLLER

from errormotion.errors import InstrumentError
from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.point_lds.optoncdt import OptoNCDT, OptoSettings
from errormotion.instruments.simulators import world
from errormotion.instruments.simulators.virtual_world.world import VirtualWorld
from errormotion.methods.beam_direction import simulation
from errormotion.twin.artefacts.planes import Plane
from errormotion.twin.sensors.point_sensor import PointSensor

SLOW = OptoSettings(rate=1500.0, timeout=10.0)
LONG = OptoSettings(rate=1500.0, timeout=10.0, range=20e-3)
SEED = "seed=3"
UP, ASIDE = np.array([0.0, 0.0, 0.03]), np.array([0.0, 0.01, 0.0])
TILT = (np.radians(20.0), np.radians(90.0))
ALL = 1.5e-6
"""More than four sigmas of noise (0.1 um), speckle (0.3 um) and steps of 20 mm in 16 bits (0.1 um) together, m."""


def expected(here: VirtualWorld, sensor: PointSensor) -> float:
    """The reading of a sensor without noise at the position of the stage."""
    target = here.stand.target
    assert target is not None
    return float(sensor.still(target, here.path.place([here.time]))[0])


def test_the_duration_of_a_move_is_that_of_its_path() -> None:
    with VirtualController(f"sim://cframe/c?{SEED}", CONTROLLER) as controller:
        assert controller.move_to([0.03, 0.04, 0.0], feed=0.01) == {"duration": pytest.approx(5.0)}
        assert controller.move_to([0.03, 0.04, 0.2])["duration"] == pytest.approx(0.2 / (20 / 60))  # rapid, 20 m/min
        state = controller.state()
        assert state["time"] == pytest.approx(5.6)
        assert state["position"] == pytest.approx([0.03, 0.04, 0.2])
        assert not state["running"]
        assert controller.move_to(state["position"]) == {"duration": 0.0}


@pytest.mark.parametrize(
    ("position", "feed", "message"),
    [
        ([0.31, 0.0, 0.0], None, "X travels from -0.305 to 0.305 m; found 0.31"),
        ([0.0, 0.0, -0.01], None, "Z travels from 0 to 0.46 m"),
        ([0.0, 0.0], None, "expected a position of three finite numbers"),
        ([0.1, 0.0, 0.0], 0.0, "expected a finite feed above 0"),
        ([0.1, 0.0, 0.0], 1.0, "at most 0.333333 m/s; found 1"),
    ],
)
def test_a_move_that_the_machine_cannot_make_is_refused_and_nothing_moves(
    position: list[float], feed: float | None, message: str
) -> None:
    with VirtualController(f"sim://cframe/c?{SEED}", CONTROLLER) as controller:
        with pytest.raises(InstrumentError, match=message):
            controller.move_to(position, feed)
        assert controller.state()["position"] == [0.0, 0.0, 0.0]
        assert controller.state()["time"] == 0.0


def test_the_state_names_the_target_only_while_there_is_one() -> None:
    with VirtualController(f"sim://cframe/c?{SEED}", CONTROLLER) as controller:
        assert "target" not in controller.state()
        controller.set_target("plane", *TILT)
        assert controller.state()["target"] == {"kind": "plane", "inclination": TILT[0], "rotation": TILT[1]}
        controller.set_target("bar")
        assert controller.state()["target"] == {"kind": "bar"}
        controller.set_target(None)
        assert "target" not in controller.state()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("cube",), "Expected the target 'plane', 'bar' or None"),
        (("plane",), "inclination and rotation"),
        (("plane", 0.1), "inclination and rotation"),
        (("bar", 0.1, 0.2), "only with a plane"),
        (("plane", 1.2, 0.0), "inclination from 0 to 60 deg; found 68.7"),
    ],
)
def test_a_target_that_does_not_exist_is_refused(arguments: tuple[object, ...], message: str) -> None:
    with VirtualController(f"sim://cframe/c?{SEED}", CONTROLLER) as controller:
        controller.set_target("bar")
        with pytest.raises(InstrumentError, match=message):
            controller.set_target(*arguments)  # type: ignore[arg-type]
        assert controller.state()["target"] == {"kind": "bar"}


@pytest.mark.parametrize("kind", ["plane", "bar"])
def test_both_kinds_of_sensor_measure_the_same_surface(kind: str) -> None:
    """One measures from mid-range, the other from the start of its range: 10 mm against 20 mm / 2."""
    with (
        VirtualController(f"sim://cframe/c?{SEED}", CONTROLLER) as controller,
        OptoNCDT(f"sim://cframe/lds?{SEED}&range=20", LONG) as opto,
    ):
        here = world("cframe", 3)
        machine = here.machine
        controller.set_target(kind, *(TILT if kind == "plane" else ()))
        middle = simulation.raw_check_bar(machine, seed=0)["bar_stage"].values[10] if kind == "bar" else machine.home()
        for shift in (-3e-3, 0.0, 2e-3):
            controller.move_to(middle + np.array([0.0, 0.0, shift]))
            true = expected(here, machine.point_sensor)
            assert here.read_point("lk") == pytest.approx(true, abs=ALL)
            from_start = expected(here, machine.point_sensor.from_start(20e-3))
            assert opto.read() == pytest.approx(from_start, abs=ALL)
            assert from_start == pytest.approx(true + 10e-3, abs=1e-9)


def test_before_and_beyond_the_range_and_no_target_are_reported_separately() -> None:
    with (
        VirtualController(f"sim://cframe/c?{SEED}", CONTROLLER) as controller,
        OptoNCDT(f"sim://cframe/a?{SEED}", SLOW) as opto,
    ):
        here = world("cframe", 3)
        assert np.isnan(here.read_point("lk"))
        controller.set_target("plane", *TILT)
        home = here.machine.home()
        controller.move_to(home + UP)
        assert here.read_point("lk") == np.inf
        controller.move_to(home - UP)
        assert here.read_point("lk") == -np.inf
        assert np.isnan(opto.read())
        controller.set_target("bar")
        assert np.isnan(here.read_point("lk"))


def test_without_a_target_a_sensor_is_one_of_the_frame_again() -> None:
    with (
        VirtualController(f"sim://cframe/c?{SEED}", CONTROLLER) as controller,
        OptoNCDT(f"sim://cframe/X1?{SEED}", SLOW) as opto,
    ):
        at_the_bar = opto.read()
        controller.set_target("plane", *TILT)
        assert np.isnan(opto.read())  # the stage is far away
        controller.set_target(None)
        assert opto.read() == pytest.approx(at_the_bar, abs=3e-6)  # 0.3 um of noise, and cold drift of a second
    with OptoNCDT(f"sim://cframe/lds?{SEED}", SLOW) as other, pytest.raises(InstrumentError, match="No such beam"):
        other.read()


def test_a_streaming_sensor_measures_the_motion_of_the_stage() -> None:
    """The face is inclined in Y by 20 deg, the beam is not: the reading changes with y as that of the plane."""
    with (
        VirtualController(f"sim://cframe/c?{SEED}", CONTROLLER) as controller,
        OptoNCDT(f"sim://cframe/lds?{SEED}&range=20", LONG) as opto,
    ):
        here = world("cframe", 3)
        controller.set_target("plane", *TILT)
        home = here.machine.home()
        controller.move_to(home - ASIDE)
        stream = opto.stream(block=1500)
        next(stream)
        with pytest.raises(InstrumentError, match="change the target while lds stream"):
            controller.set_target(None)
        duration = controller.move_to(home + ASIDE, feed=0.01)["duration"]
        assert duration == pytest.approx(2.0)
        values = [next(stream).values[0]]
        with pytest.raises(InstrumentError, match="still running"):
            controller.move_to(home)
        while controller.state()["running"]:
            values.append(next(stream).values[0])
        stream.close()
        readings = np.concatenate(values)
        face = here.stand.target
        assert isinstance(face, Plane)
        sensor = here.machine.point_sensor.from_start(20e-3)
        ends = sensor.still(face, home + np.outer([-0.01, 0.01], [0.0, 1.0, 0.0]))
        assert readings[0] == pytest.approx(ends[0], abs=ALL)
        assert readings[-1] == pytest.approx(ends[1], abs=ALL)
        slope = (ends[1] - ends[0]) / 0.02
        middle = readings[np.searchsorted(readings, np.mean(ends)) - 500 :][:1000]
        fitted = np.polyfit(np.arange(middle.size) / 1500.0 * 0.01, middle, 1)[0]
        assert fitted == pytest.approx(slope, rel=1e-3)  # 0.3 um of speckle over 6.7 mm: 1e-4


def test_the_same_commands_give_the_same_readings() -> None:
    def session() -> list[float]:
        with VirtualController(f"sim://cframe/c?{SEED}", CONTROLLER) as controller:
            here = world("cframe", 3)
            readings = []
            for rotation in (0.0, 1.0):
                controller.set_target("plane", 0.3, rotation)
                controller.move_to(here.machine.home())
                readings += [here.read_point("lk"), here.read_point("lk")]
            return readings

    first, second = session(), session()
    assert first == second
    assert len(set(first)) == len(first)  # and no two have the same noise


def test_resetting_a_face_changes_it_slightly() -> None:
    with VirtualController(f"sim://cframe/c?{SEED}", CONTROLLER) as controller:
        faces = []
        for _ in range(2):
            controller.set_target("plane", *TILT)
            face = world("cframe", 3).stand.target
            assert isinstance(face, Plane)
            faces.append(face)
    turned = np.linalg.norm(faces[1].normal - faces[0].normal)
    assert 0 < turned < np.radians(40 / 3600)  # 5 arcsec in each direction and of both


def test_a_target_and_the_stage_stay_when_a_schedule_starts() -> None:
    with VirtualController(f"sim://cframe/c?{SEED}", CONTROLLER) as controller:
        here = world("cframe", 3)
        controller.set_target("plane", *TILT)
        controller.move_to(here.machine.home())
        before = here.read_point("lk")
        controller.start([])
        assert controller.state()["time"] == 0.0
        assert here.read_point("lk") == pytest.approx(before, abs=ALL)
