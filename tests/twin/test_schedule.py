"""Commands, and the resulting angle of the spindle and compensation."""

import numpy as np
import pytest
from coded import raises
from hypothesis import given
from hypothesis import strategies as st

from errormotion.errors import BenchError
from errormotion.twin import Event, StepProgram
from errormotion.twin.schedule import SLEW, Schedule

TOP = 15000.0
SPIN_UP = TOP / 60 / 0.75


def schedule(*events):
    return Schedule(events, SPIN_UP, TOP)


def test_full_speed_is_reached_after_three_quarters_of_a_second():
    s = schedule(Event(2.0, TOP))
    assert s.speed([1.9, 2.0, 2.375, 2.75, 100.0]) == pytest.approx([0, 0, TOP / 2, TOP, TOP])


@given(
    st.lists(
        st.tuples(st.floats(0.05, 3.0), st.sampled_from([0.0, 3000.0, 12000.0, TOP])),
        min_size=1,
        max_size=6,
    )
)
def test_angle_is_the_integral_of_the_speed(changes):
    times = np.cumsum([gap for gap, _ in changes])
    s = schedule(*(Event(float(t), speed) for t, (_, speed) in zip(times, changes, strict=True)))
    t = np.linspace(0, times[-1] + 2, 20001)
    turns, rate, half = s.turning(t).T
    # trapezoid over h: exact but for cells with a kink, where it is off by at most acceleration h^2 / 4
    steps = np.diff(turns) - (rate[1:] + rate[:-1]) / 2 * np.diff(t)
    assert np.max(np.abs(steps)) < SPIN_UP * (t[1] - t[0]) ** 2
    assert np.all(rate >= -1e-9)
    assert np.all(rate <= TOP / 60 + 1e-9)
    assert set(np.round(np.abs(half) * 2 / SPIN_UP, 9)) <= {0.0, 1.0}


def test_spindle_settles_at_the_last_speed_even_when_changes_come_fast():
    s = schedule(Event(0, TOP), Event(0.2, 0), Event(0.3, 6000))
    assert s.speed([10.0]) == pytest.approx([6000])


def test_compensation_switches_within_its_slew_time():
    s = schedule(Event(10, compensation={"Z": False}), Event(20, compensation={"Z": True, "X": False}))
    share = s.compensation(np.array([9.9, 10 + SLEW / 2, 15, 20 + SLEW, 30]))
    assert share[:, 2] == pytest.approx([1, 0.5, 0, 1, 1])
    assert share[:, 0] == pytest.approx([1, 1, 1, 0, 0])
    assert share[:, 1] == pytest.approx(np.ones(5))


@pytest.mark.parametrize(
    ("events", "message"),
    [
        ([Event(5), Event(1)], "in order"),
        ([Event(-1.0)], "from 0 on"),
        ([Event(float("nan"))], "finite"),
        ([Event(0, 99999)], "15000 /min"),
        ([Event(0, float("nan"))], "found nan /min"),
        ([Event(0, compensation={"A": False})], "X, Y and Z"),
    ],
)
def test_invalid_schedules_are_refused(machine, events, message):
    with pytest.raises(BenchError, match=message):
        machine.start(events)


def test_step_program_reaches_every_position_in_time():
    p = StepProgram((1e-3, 0, 0), (0, 2, 0), 20e-6, 101, dwell=1.0, travel=0.1, begin=5.0, approach=0.5)
    assert p.places.shape == (103, 3)
    assert p.places[1] == pytest.approx([1e-3, 0, 0])
    assert p.places[-2] == pytest.approx([1e-3, 2e-3, 0])
    assert p.places[0] == pytest.approx([1e-3, 1e-3, 0])
    assert p.duration == pytest.approx(101 * 1.0 + 100 * 0.1 + 2 * 0.5)
    assert p.arrivals[1] == pytest.approx(5.5)
    assert np.all(p.departures[1:-1] - p.arrivals[1:-1] == pytest.approx(1.0))
    assert p.arrivals[-1] == pytest.approx(p.end)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"direction": (0, 0, 0)}, "virtual.steps.direction"),
        ({"count": 0}, "virtual.steps.form"),
        ({"dwell": 0.0}, "virtual.steps.form"),
        ({"start": (1, 2)}, "virtual.point.form"),
        ({"home": (0, 0, float("nan"))}, "virtual.point.form"),
    ],
)
def test_invalid_steps_are_refused(change, code):
    good = {"start": (0, 0, 0), "direction": (0, 1, 0), "step": 20e-6, "count": 3}
    with raises(code):
        StepProgram(**(good | change))
