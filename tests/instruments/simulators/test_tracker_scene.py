"""A reflector of the virtual world: the error of an arrival is the same in a continued test."""

import numpy as np
import pytest

from errormotion.instruments.simulators import reset, world
from errormotion.instruments.simulators.virtual_world.tracker_scene import TrackerScene
from errormotion.instruments.transports import parse_address

REPEATABILITY = 2e-6


@pytest.fixture(autouse=True)
def _worlds():
    reset()
    yield
    reset()


def scene(seed: int = 7) -> TrackerScene:
    url = f"sim://cframe/tracker?seed={seed}&repeatability={REPEATABILITY}"
    return TrackerScene(world("cframe", seed), parse_address(url))


def arrivals(of: TrackerScene, count: int) -> np.ndarray:
    """Return the positions of the reflector after moves between two positions."""
    found = []
    for k in range(count):
        of.world.move_to((0.05 * (k % 2), 0.02, 0.1))
        of.world.elapse(1.0)
        found.append(of.places(np.array([of.world.time]))[0])
    return np.array(found)


def test_a_second_test_that_is_continued_in_another_process_finds_the_same_arrivals() -> None:
    first = scene()
    arrivals(first, 5)
    state = first.world.snapshot()
    still, after = first.places(np.array([first.world.time]))[0], arrivals(first, 6)
    reset()
    again = scene()
    again.world.restore(**state)
    np.testing.assert_array_equal(again.places(np.array([again.world.time]))[0], still)
    np.testing.assert_array_equal(arrivals(again, 6), after)


def test_each_arrival_has_an_error_of_its_own_which_all_instruments_see() -> None:
    one = scene()
    other = TrackerScene(one.world, parse_address(f"sim://cframe/ids?seed=7&repeatability={REPEATABILITY}"))
    found = []
    for k in range(300):
        one.world.move_to((0.05 * (k % 2), 0.02, 0.1))
        now = np.array([one.world.time])
        np.testing.assert_array_equal(one.places(now), other.places(now))
        if k % 2:
            found.append(one.places(now)[0])
    # 450 numbers: a standard deviation to 3.3 %
    assert np.std(found, axis=0, ddof=1).mean() == pytest.approx(REPEATABILITY, rel=0.13)
