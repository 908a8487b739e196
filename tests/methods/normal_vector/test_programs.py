"""NC programs do what the steps say: read back by the virtual control's own interpreter."""

import math
import re

import hypothesis
import numpy as np
import pytest
from coded import raises
from hypothesis import given
from hypothesis import strategies as st

from errormotion.instruments.simulators.virtual_world.nc_program import interpret
from errormotion.methods.normal_vector import NormalVector, NormalVectorSettings
from errormotion.methods.normal_vector.acquisition import cycle
from errormotion.methods.normal_vector.acquisition.programs import CYCLE, WARM_UP, cycle_program
from errormotion.twin import VirtualMachine

GANTRY = VirtualMachine("gantry", seed=5)
BALLS = [{"centre": tuple(place)} for place in GANTRY.balls.nominal.tolist()]
MINUTE = 60.0


class Nominal:
    """Balls where they are said to be, and a log of what the program orders."""

    def __init__(self, settings: NormalVectorSettings) -> None:
        self.settings = settings
        self.speeds: list[tuple[float, float]] = []
        self.lines: list[str] = []

    def pass_by(self, start, goal, feed, time):
        for ball in self.settings.balls:
            along = np.linspace(start, goal, 30)
            assert np.linalg.norm(along - ball.centre, axis=1).min() > ball.radius + 3e-3 - 2e-6  # as it is written

    def skip(self, start, goal, feed, time):
        way = goal - start
        return start + self.settings.approach * way / np.linalg.norm(way)

    def spindle(self, speed, time):
        self.speeds.append((time, speed))

    def print(self, order, time):
        if not isinstance(order, str):  # POPEN, PCLOS
            self.lines.append(order.text())

    def clock(self, time):
        return time


def settings(**options) -> NormalVectorSettings:
    return NormalVectorSettings(
        **({"balls": BALLS[:3], "touches": 4, "duration": 40 * MINUTE, "interval": 20 * MINUTE} | options)
    )


def walked(chosen: NormalVectorSettings, name: str):
    """Return the path of a program from a place high above, and what it ordered."""
    orders = Nominal(chosen)
    start = cycle.cycle_steps(chosen)[0].place
    path = interpret(NormalVector().programs(chosen)[name], start, GANTRY.travel, 1.0, orders)
    return path, orders


def corners(places) -> np.ndarray:
    """Return places one after the other, those left out where nothing moved."""
    places = np.asarray(places)
    return places[np.concatenate([[True], np.abs(np.diff(places, axis=0)).max(axis=1) > 2e-6])]


micrometres = st.integers(-300, 300)
schedules = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 15000)), max_size=4, unique_by=lambda e: e[0])


@hypothesis.settings(max_examples=25)
@given(
    shifts=st.lists(st.tuples(micrometres, micrometres, micrometres), min_size=3, max_size=3),
    touches=st.integers(4, 7),
    order=st.sampled_from(["there and back", "forward"]),
    events=schedules,
    settle=st.sampled_from([0.0, 2.0]),
    moves=st.sampled_from([(), ((1.0, 0.0, 0.8), (3.0, 0.5, 0.9))]),
    feed=st.integers(1, 20),
)
def test_program_has_the_positions_and_times_of_the_steps(shifts, touches, order, events, settle, moves, feed) -> None:
    balls = [
        {"centre": tuple(c + 1e-6 * d for c, d in zip(ball["centre"], shift, strict=True))}
        for ball, shift in zip(BALLS, shifts, strict=False)
    ]
    chosen = settings(
        balls=balls, touches=touches, order=order, settle=settle, moves=moves, positioning_feed=feed / MINUTE,
        schedule=[{"at": at * MINUTE, "spindle_speed": float(speed)} for at, speed in sorted(events)],
    )  # fmt: skip
    path, orders = walked(chosen, WARM_UP)
    steps = cycle.campaign_steps(chosen)
    planned = corners([step.place for step in steps if step.place is not None])
    # Places have micrometres; a place that is rounded may miss the start of a touch by one, and is then left out.
    np.testing.assert_allclose(corners(path.places), planned, atol=1.1e-6)
    assert path.duration == pytest.approx(math.fsum(step.seconds for step in steps), abs=0.1)
    # the spindle turns when the steps say so
    now, speed, expected = 0.0, 0.0, []
    for step in steps:
        if step.spindle_speed != speed:
            speed = step.spindle_speed
            expected.append((now, speed))
        now += step.seconds
    commanded = [(time, speed) for time, speed in orders.speeds]
    changes = [each for last, each in zip([(0.0, 0.0), *commanded], commanded, strict=False) if each[1] != last[1]]
    assert [speed for _, speed in changes] == [speed for _, speed in expected]
    assert [time for time, _ in changes] == pytest.approx([time for time, _ in expected], abs=0.1)
    cycles = cycle.cycles(chosen)
    numbers = [int(re.match(r"N(\d+) ", line)[1]) for line in orders.lines]
    assert numbers == [*range(1, 3 * touches + 1)] * cycles


def test_cycle_starts_upwards_and_every_touch_is_printed_once_after_its_skip_move() -> None:
    text = NormalVector().programs(settings())[CYCLE]
    lines = text.splitlines()
    moves = [line for line in lines if line.startswith("G1 ")]
    high = cycle.safe_height(cycle.cycle_touches(settings(), 3e-3)[0], settings().clearance)
    assert moves[0] == f"G1 Z{1e3 * high:.3f} F5000"
    touches = [i for i, line in enumerate(lines) if line.startswith("G31")]
    assert len(touches) == 12
    assert all(lines[i + 1].startswith(f"DPRNT[N{n}*X#5061[53]") for n, i in enumerate(touches, 1))
    assert lines.index("M5") < lines.index("G4 P2.000") < touches[0]
    assert (lines[0], lines[-2:]) == ("%", ["M30", "%"])


@pytest.mark.parametrize(("dwell", "line"), [("P s", "G4 P2.000"), ("P ms", "G4 P2000"), ("X s", "G4 X2.000")])
def test_a_rest_is_written_as_the_control_counts_it_and_the_head_says_so(dwell, line) -> None:
    text = cycle_program(settings(dwell=dwell))
    assert line in text.splitlines()
    assert f"(mm, mm/min, dwells G4 {dwell})" in text.splitlines()[:4]


def test_each_cycle_has_a_sequence_number_before_its_warm_up() -> None:
    chosen = settings(schedule=[{"at": 0.0, "spindle_speed": 9000.0}])
    lines = NormalVector().programs(chosen)[WARM_UP].splitlines()
    assert [line for line in lines if line.startswith("N")] == [
        "N0 (cycle 0)",
        "N1 (warm-up and cycle 1)",
        "N2 (warm-up and cycle 2)",
    ]
    after = lines[lines.index("N1 (warm-up and cycle 1)") + 1 :]
    assert after[0].startswith("G1 Z")
    assert after[1] == "M3 S9000"


def test_tool_is_changed_with_a_stopped_spindle() -> None:
    chosen = settings(schedule=[{"at": 0.0, "spindle_speed": 9000.0}], to_probe=("T9 M6", "M19"), to_warm_up=("T1 M6",))
    lines = NormalVector().programs(chosen)[WARM_UP].splitlines()
    orders = [line for line in lines if line.startswith(("M3 ", "M5", "T", "POPEN", "M19"))]
    cold = ["M5", "T9 M6", "M19", "POPEN"]
    assert orders == [*cold, *["T1 M6", "M3 S9000", *cold] * 2]


def test_the_first_touch_of_a_ball_names_it_as_a_control_can_read_it() -> None:
    names = ("front", "Süd", "rear (left)")
    balls = [ball | {"name": name} for ball, name in zip(BALLS, names, strict=False)]
    lines = cycle_program(settings(balls=balls)).splitlines()
    named = [line.partition(" (")[2] for line in lines if line.startswith("G31") and "(" in line]
    assert named == ["front)", "S?d)", "rear ?left?)", "S?d)", "front)"]


def test_no_program_without_balls() -> None:
    with raises("probing.balls.too_few"):
        NormalVector().programs(NormalVectorSettings())
