"""What a campaign will make a machine do, said beforehand: against a recorded run and against its own rules."""

import math
from itertools import pairwise

import numpy as np
import pytest
from armed import CONTROLLER
from hypothesis import given
from hypothesis import strategies as st

from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.simulators import reset, world
from errormotion.instruments.touch_probe.controller_probe import ControllerProbe, ControllerProbeSettings
from errormotion.methods.normal_vector import NormalVector, NormalVectorSettings
from errormotion.methods.normal_vector.acquisition import cycle
from errormotion.plugins import Touch
from errormotion.twin import VirtualMachine

GANTRY = VirtualMachine("gantry", seed=5)
BALLS = [{"centre": tuple(place)} for place in GANTRY.balls.nominal.tolist()]
MINUTE = 60.0


def settings(**options) -> NormalVectorSettings:
    return NormalVectorSettings(
        **({"balls": BALLS[:3], "touches": 4, "duration": 40 * MINUTE, "interval": 20 * MINUTE} | options)
    )


class Bench:
    """The least that acquisition needs: a control and a probe."""

    machine = "virtual gantry"

    def __init__(self, **drivers) -> None:
        self.drivers = drivers

    def of_kind(self, kind):
        return self.drivers[kind]

    def all_of_kind(self, kind):
        return {}

    def has_kind(self, kind):
        return kind in self.drivers

    def ask(self, message):
        pass


@pytest.mark.parametrize("moves", [(), ((1.0, 0.0, 0.8), (3.0, 0.5, 0.9))])
def test_steps_equal_the_motions_of_the_machine(monkeypatch, moves) -> None:
    chosen = settings(
        schedule=[{"at": 0.0, "spindle_speed": 9000.0}, {"at": 900.0, "spindle_speed": 0.0}], moves=moves,
        moves_feed=1 / MINUTE,
    )  # fmt: skip
    probe = ControllerProbeSettings(arm=True, approach_feed=0.2, search_feed=0.01, repeats=2)
    log = []
    usual = VirtualController._call

    def logged(self, op, **arguments):
        answer = usual(self, op, **arguments)
        if op in ("move_to", "probe"):
            log.append((virtual.time, *virtual.position()))
        return answer

    virtual = world("gantry", 5)
    monkeypatch.setattr(VirtualController, "_call", logged)
    address = "sim://gantry/controller?seed=5"
    with VirtualController(address, CONTROLLER) as control, ControllerProbe(address, probe) as touching:
        chunks = list(NormalVector().acquire(Bench(controller=control, touch_probe=touching), chosen, inputs={}))
        state = control.state()
    reset()
    assert len(chunks) == 3
    steps = NormalVector().motions(chosen, {"touch_probe": probe})
    planned = np.array([step.place for step in steps if step.place is not None])
    # the way to the first place of all is not planned: who knows where the machine is
    first = next(i for i, row in enumerate(log) if np.allclose(row[1:], steps[1].place, atol=1e-6))
    made = np.array(log[first:])
    # Balls are set up to 0.3 mm; extreme are starts and heights, which are known exactly.
    np.testing.assert_allclose(made[:, 1:].min(axis=0), planned.min(axis=0), atol=1e-6)
    np.testing.assert_allclose(made[:, 1:].max(axis=0), planned.max(axis=0), atol=1e-6)
    assert math.fsum(step.seconds for step in steps) == pytest.approx(state["time"], rel=0.02)
    way = math.fsum(math.dist(a, b) for a, b in pairwise(made[:, 1:].tolist()))
    assert math.fsum(math.dist(a, b) for a, b in pairwise(planned.tolist())) == pytest.approx(way, rel=0.02)
    slowest = [math.fsum(step.seconds for step in part.cycle) for part in cycle.parts(chosen, probe)]
    ends = [float(chunk["touch_time"].max() - chunk["time"][0]) for chunk in chunks[1:]]
    assert slowest[1:] == pytest.approx(ends, rel=0.05)


def test_no_steps_without_balls() -> None:
    assert cycle.cycle_steps(NormalVectorSettings()) == []


@given(
    touches=st.integers(4, 9),
    balls=st.integers(3, 4),
    order=st.sampled_from(["there and back", "forward"]),
    clearance=st.floats(1e-3, 0.1),
    elevation=st.floats(0, 0.5),
)
def test_every_ball_has_the_stated_touches_and_no_path_crosses_it(touches, balls, order, clearance, elevation) -> None:
    chosen = settings(touches=touches, balls=BALLS[:balls], order=order, clearance=clearance, elevation=elevation)
    planned, which = cycle.cycle_touches(chosen, 3e-3)
    assert sorted(which) == [(ball, touch) for ball in range(balls) for touch in range(touches)]
    assert [touch.item for touch in planned] == [ball for ball, _ in which]
    reach = 12.5e-3 + 3e-3
    here = (2.0, 0.0, 0.1)
    for item in cycle.itinerary(planned, clearance, here):
        if isinstance(item, Touch):
            assert item.start == here
            continue
        along = np.linspace(here, item, 200)
        for ball in chosen.balls:
            assert np.linalg.norm(along - ball.centre, axis=1).min() > reach + chosen.approach * 0.99
        here = item
    assert here[2] == pytest.approx(cycle.safe_height(planned, clearance))


@given(interval=st.integers(1, 60), count=st.integers(1, 20), number=st.integers(0, 30), late=st.floats(0, 5000))
def test_late_cycle_starts_immediately_and_earlier_ones_are_omitted(interval, count, number, late) -> None:
    chosen = settings(interval=float(interval), duration=float(interval * count))
    assert cycle.cycles(chosen) == count + 1
    found = cycle.due(chosen, number, number * interval + late)
    assert found >= number
    assert found * interval <= number * interval + late + cycle.MIN_STEP
    assert number * interval + late < (found + 1) * interval
    assert cycle.following(chosen, found * interval) == found + 1


def test_overlapping_cycles_are_omitted() -> None:
    length = math.fsum(step.seconds for step in cycle.cycle_steps(settings()))
    numbers = [part.number for part in cycle.parts(settings(interval=length / 1.5, duration=6 * length / 1.5))]
    assert numbers == [0, 1, 3, 4, 6]


@given(
    begin=st.floats(0, 2000),
    length=st.floats(0, 2000),
    events=st.lists(st.tuples(st.integers(1, 3000), st.integers(0, 15000)), max_size=5, unique_by=lambda e: e[0]),
    moves=st.sampled_from([(), ((0.0, 0.0, 0.9),), ((0.0, 0.0, 0.9), (1.0, 0.0, 0.9)), ((0.0, 0.0, 0.9),) * 2]),
)
def test_warm_up_follows_the_schedule(begin, length, events, moves) -> None:
    schedule = [{"at": float(at), "spindle_speed": float(speed)} for at, speed in sorted(events)]
    chosen = settings(schedule=schedule, moves=moves)
    steps = cycle.warm_up_steps(chosen, begin, begin + length, (0.5, 0.5, 0.9))
    assert math.fsum(step.seconds for step in steps) == pytest.approx(length, abs=2 * cycle.MIN_STEP)
    now = begin
    for step in steps:
        assert step.spindle_speed == cycle.speed_at(chosen, now)[0]
        now += step.seconds
