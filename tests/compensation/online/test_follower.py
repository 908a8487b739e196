"""Offsets written to a machine: never beyond limit or slew limit, never while it must not be disturbed."""

import math

import numpy as np
import pytest
from coded import raises
from hypothesis import given
from hypothesis import strategies as st

from errormotion.compensation.online.follower import Conditions, Follower, State
from errormotion.compensation.online.settings import Limits

LIMITS = Limits(limit="50 um", slew="1 um/s", period="1 s", hold="5 s", settle="3 s")
HERE = np.zeros(3)


def armed(limits: Limits = LIMITS, applied: np.ndarray = HERE) -> Follower:
    follower = Follower(limits)
    follower.arm(applied)
    return follower


def wanted(*um: float) -> Conditions:
    return Conditions(target=np.array(um) * 1e-6)


NOTHING = Conditions(cause="the thermometer is silent")


def run(follower: Follower, conditions: Conditions, start: float, seconds: int) -> list[tuple[State, float]]:
    """Step once a second, and return states and offsets of X in um."""
    steps = [follower.step(start + k, conditions) for k in range(seconds)]
    return [(step.state, round(float(step.offset[0]) * 1e6, 9)) for step in steps]


numbers = st.floats(allow_nan=True, allow_infinity=True)
conditions = st.builds(
    Conditions,
    target=st.one_of(st.none(), st.tuples(numbers, numbers, numbers).map(np.array), st.just(np.full(3, 3e-6))),
    cause=st.just("unknown"),
    busy=st.sampled_from(["", "", "probing"]),
    fault=st.sampled_from(["", "", "", "", "", "", "", "no answer"]),
)
steps = st.lists(
    st.tuples(st.floats(-1, 1e5), conditions, st.sampled_from(["", "", "", "", "stop", "arm"])), max_size=60
)


@given(steps, st.floats(-50e-6, 50e-6))
def test_an_offset_never_leaves_its_limits(course: list[tuple[float, Conditions, str]], applied: float) -> None:
    follower, now = armed(applied=np.full(3, applied)), 0.0
    before = follower.offset.copy()
    for wait, what, order in course:
        earlier, now = now, now + wait
        if order == "stop":
            follower.stop()
        if order == "arm" and follower.state in (State.OFF, State.FAULT):
            follower.arm(before)
        state = follower.state
        step = follower.step(now, what)
        assert np.isfinite(step.offset).all()
        assert (np.abs(step.offset) <= LIMITS.limit * (1 + 1e-12)).all()
        allowed = LIMITS.slew * min(max(now - earlier, 0.0), 2 * LIMITS.period)  # as rounded
        assert (np.abs(step.offset - before) <= allowed * (1 + 1e-9) + np.spacing(LIMITS.limit)).all()
        if what.busy or what.fault or state in (State.OFF, State.FAULT):
            assert (step.offset == before).all()
        if step.state in (State.OFF, State.ARMED) and state not in (State.OFF, State.ARMED):
            assert not step.offset.any()
        before = step.offset


def test_it_follows_no_faster_than_the_slew_limit_and_stops_at_the_limit() -> None:
    follower = armed()
    assert run(follower, wanted(3, 0, 0), 0.0, 6) == [(State.FOLLOWING, x) for x in (0, 1, 2, 3, 3, 3)]
    step = [follower.step(6.0 + k, wanted(80, 0, -90)) for k in range(60)][-1]
    assert step.offset * 1e6 == pytest.approx([50, 0, -50])
    assert step.limited == (0, 2)


def test_without_a_prediction_it_holds_then_ramps_to_zero_and_waits() -> None:
    follower = armed()
    run(follower, wanted(3, 0, 0), 0.0, 5)
    held, ramped, waiting = State.HOLDING, State.RAMPING, State.ARMED
    course = run(follower, NOTHING, 5.0, 10)
    assert course == [(held, 3)] * 5 + [(ramped, 2), (ramped, 1)] + [(waiting, 0)] * 3


def test_a_short_gap_changes_nothing() -> None:
    follower = armed()
    run(follower, wanted(3, 0, 0), 0.0, 5)
    assert run(follower, NOTHING, 5.0, 3) == [(State.HOLDING, 3)] * 3
    assert run(follower, wanted(4, 0, 0), 8.0, 2) == [(State.FOLLOWING, 4)] * 2


def test_a_ramp_ends_when_predictions_were_valid_for_a_time() -> None:
    follower = armed()
    run(follower, wanted(20, 0, 0), 0.0, 21)
    assert run(follower, NOTHING, 21.0, 7)[-1] == (State.RAMPING, 18)
    assert run(follower, wanted(20, 0, 0), 28.0, 5) == [
        (State.RAMPING, 17),
        (State.RAMPING, 16),
        (State.RAMPING, 15),
        (State.FOLLOWING, 16),
        (State.FOLLOWING, 17),
    ]


def test_nothing_changes_while_the_machine_is_busy_not_even_a_ramp() -> None:
    follower = armed()
    run(follower, wanted(20, 0, 0), 0.0, 11)
    busy = Conditions(target=np.full(3, 20e-6), busy="a probing cycle runs")
    assert run(follower, busy, 11.0, 30) == [(State.HOLDING, 10)] * 30
    follower.stop()
    assert run(follower, busy, 41.0, 3) == [(State.HOLDING, 10)] * 3
    assert run(follower, wanted(20, 0, 0), 44.0, 11)[-1] == (State.OFF, 0)


def test_stopped_it_ramps_to_zero_and_is_off() -> None:
    follower = armed()
    run(follower, wanted(3, 0, 0), 0.0, 5)
    follower.stop()
    assert run(follower, wanted(3, 0, 0), 5.0, 5) == [
        (State.RAMPING, 2),
        (State.RAMPING, 1),
        (State.OFF, 0),
        (State.OFF, 0),
        (State.OFF, 0),
    ]


def test_a_fault_ends_it_until_it_is_armed_again() -> None:
    follower = armed()
    run(follower, wanted(3, 0, 0), 0.0, 5)
    assert follower.step(5.0, Conditions(fault="no answer")).state is State.FAULT
    assert run(follower, wanted(9, 0, 0), 6.0, 3) == [(State.FAULT, 3)] * 3
    follower.arm(np.array([1e-6, 0, 0]))
    assert run(follower, wanted(9, 0, 0), 9.0, 2) == [(State.FOLLOWING, 1), (State.FOLLOWING, 2)]


def test_a_stop_is_kept_when_it_is_armed_again_after_a_fault() -> None:
    follower = armed()
    run(follower, wanted(3, 0, 0), 0.0, 5)
    follower.stop()
    follower.step(5.0, Conditions(fault="no answer"))
    follower.arm(np.array([1e-6, 0, 0]))
    assert run(follower, wanted(9, 0, 0), 6.0, 3) == [(State.RAMPING, 1), (State.OFF, 0), (State.OFF, 0)]
    follower.arm(HERE)
    assert follower.step(9.0, wanted(9, 0, 0)).state is State.FOLLOWING


def test_a_restart_continues_from_the_offset_of_the_machine() -> None:
    follower = armed(applied=np.array([7e-6, 0, 0]))
    assert run(follower, wanted(9, 0, 0), 100.0, 3) == [
        (State.FOLLOWING, 7),
        (State.FOLLOWING, 8),
        (State.FOLLOWING, 9),
    ]


def test_no_jump_after_a_program_was_suspended_for_an_hour() -> None:
    follower = armed()
    follower.step(0.0, wanted(40, 0, 0))
    assert follower.step(3600.0, wanted(40, 0, 0)).offset[0] == pytest.approx(2e-6)


@pytest.mark.parametrize(
    ("applied", "code"),
    [([math.nan, 0, 0], "compensation.offset.unknown"), ([60e-6, 0, 0], "compensation.offset.beyond_limit")],
)
def test_a_machine_with_an_unknown_or_large_offset_is_not_armed(applied: list[float], code: str) -> None:
    with raises(code):
        Follower(LIMITS).arm(np.array(applied))


def test_it_is_armed_once() -> None:
    with raises("compensation.state.other"):
        armed().arm(HERE)
