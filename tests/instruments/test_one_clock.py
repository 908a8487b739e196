"""A virtual world that follows a schedule: one machine for several measurements."""

from collections.abc import Iterator

import numpy as np
import pytest
from coded import raises

from errormotion.instruments import simulators
from errormotion.instruments.simulators import world
from errormotion.instruments.simulators.virtual_world.tracker_scene import TrackerScene
from errormotion.instruments.simulators.virtual_world.world import VirtualWorld
from errormotion.instruments.transports import parse_address
from errormotion.twin import Event

HEAT = (Event(600.0, spindle_speed=12000.0),)


@pytest.fixture
def here() -> Iterator[VirtualWorld]:
    yield world("gantry", 4)
    simulators.reset()


def test_resetting_the_clock_restores_the_state(here: VirtualWorld) -> None:
    here.follow(HEAT, 3600.0)
    first = here.machine.temperatures([here.time])
    here.move_to([1.0, 0.2, 0.1])
    here.elapse(1800.0)
    here.spindle(0.0)
    assert np.abs(here.machine.temperatures([here.time]) - first).max() > 0.5
    here.follow(HEAT, 3600.0)
    assert here.time == 3600.0
    assert here.position() == [0.0, 0.0, 0.0]
    np.testing.assert_array_equal(here.machine.temperatures([here.time]), first)
    assert here.commanded_speed(here.time) == 12000.0


def test_commands_to_the_spindle_turn_it_and_do_not_change_the_heat(here: VirtualWorld) -> None:
    here.follow(HEAT, 3600.0)
    before = here.machine.temperatures([7200.0])
    here.spindle(0.0)
    assert here.commanded()["spindle_speed"] == here.commanded()["commanded_spindle_speed"] == 0.0
    here.run_program("%\nG21 G90\nM3 S4000\nG4 P1\nM30\n%\n")
    assert here.commanded()["commanded_spindle_speed"] == 4000.0
    np.testing.assert_array_equal(here.machine.temperatures([7200.0]), before)
    with raises("machine.spindle.too_fast"):
        here.spindle(1e6)


def test_a_schedule_has_to_be_a_part_of_the_one_that_is_followed(here: VirtualWorld) -> None:
    here.follow(HEAT, 600.0)
    here.start([Event(0.0, spindle_speed=12000.0)])
    assert here.time == 600.0
    with raises("simulator.schedule.differs"):
        here.start([Event(0.0, spindle_speed=9000.0)])
    with raises("simulator.time.negative"):
        here.follow(HEAT, -1.0)


def test_the_reflector_moves_with_the_same_thermal_errors_as_the_probe(here: VirtualWorld) -> None:
    here.follow(HEAT, 7200.0)
    here.move_to([3.5, -0.6, 0.8])
    times = np.array([here.time])
    scene = TrackerScene(here, parse_address("sim://gantry/tracker?seed=4&thermal=1"))
    place = scene.places(times)[0] - here.position()
    np.testing.assert_allclose(place, here.machine.probe_error(here.position(), times)[0], atol=1e-12)
