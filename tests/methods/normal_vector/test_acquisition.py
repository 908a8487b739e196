"""Acquisition with simulated machines: real-time controls, printed lines, lost connections."""

import json
import logging
import math
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion import datasets
from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.methods.normal_vector import NormalVector, NormalVectorSettings, simulation
from errormotion.methods.normal_vector.acquisition import cycle
from errormotion.methods.normal_vector.acquisition.live import LiveBalls
from errormotion.plugins import Contact, Identity, InstrumentInfo
from errormotion.twin import VirtualMachine

GANTRY = VirtualMachine("gantry", seed=5)
BALLS = [{"centre": tuple(place), "name": f"B{i}"} for i, place in enumerate(GANTRY.balls.nominal[:3].tolist(), 1)]
SPINNING = [{"at": 0.0, "spindle_speed": 9000.0}]
LENGTH = 100.0  # of a cycle, s


def settings(**options) -> NormalVectorSettings:
    basic = {"balls": BALLS, "touches": 4, "duration": 2400.0, "interval": 600.0, "schedule": SPINNING}
    return NormalVectorSettings(**(basic | options))


class Control:
    """A real machine; its clock started long ago."""

    def __init__(self, time: float = 5000.0, *, simulated: bool = False) -> None:
        self.time, self.place, self.simulated = time, (0.0, 0.0, 0.9), simulated
        self.log: list[tuple] = []
        self.alarms: list[str] = []
        self.turning = 0.0
        self.lost = False
        self.deaf = False

    def identify(self):
        return Identity("maker", "machine", "1", simulated=self.simulated)

    def state(self):
        self._answers()
        return {
            "time": self.time, "commanded_position": list(self.place), "position": list(self.place), "estop": False,
            "alarms": self.alarms, "enabled": not self.alarms, "homed": True, "running": False,
        }  # fmt: skip

    def _answers(self):
        if self.lost:
            raise InstrumentError("the connection is lost")

    def move_to(self, place, feed):
        self._answers()
        self.time += math.dist(place, self.place) / feed
        self.place = tuple(place)
        self.log.append(("move", self.place))

    def spindle(self, speed):
        self._answers()
        self.turning = speed
        self.log.append(("spindle", speed))

    def elapse(self, seconds):
        self._answers()
        assert seconds >= 0
        self.time += seconds

    def stop(self, *, spindle):
        self._answers()
        self.turning = 0.0
        self.log.append(("stop", spindle))

    def open(self):
        if self.deaf:
            raise InstrumentError("nobody is there")
        self.lost = False

    def close(self):
        self.log.append(("close",))


class Programmed(Control):
    """One that runs programs, too."""

    def run_program(self, text):
        self.log.append(("program", [line for line in text.splitlines() if line.startswith("T")]))
        return {}


class Probe:
    """A probe that the control moves, and that meets the balls where they are said to be."""

    info = InstrumentInfo("lab", "touch_probe", "", "simulated_only")
    tip_radius, noise = 3e-3, 0.25e-6

    def __init__(self, moves: Control, breaks=None) -> None:
        self.moves, self.breaks, self.cycle = moves, breaks or {}, -1

    @property
    def control(self):
        return self.moves

    def measure(self, touches):
        self.cycle += 1
        assert self.moves.turning == 0
        for number, touch in enumerate(touches):
            if (error := self.breaks.get((self.cycle, number))) is not None:
                raise error
            self.moves.time += LENGTH / len(touches)
            yield Contact(touch.start, self.moves.time)


class Printer:
    """A probe that hears what a program prints: for each cycle the times of its touches, or an error."""

    info = InstrumentInfo("lab", "touch_probe", "", "simulated_only")
    tip_radius, noise = 3e-3, math.nan

    def __init__(self, cycles, *, simulated=False) -> None:
        self.cycles, self.simulated = list(cycles), simulated

    def identify(self):
        return Identity("maker", "printer", "1", simulated=self.simulated)

    def measure(self, touches):
        for touch, time in zip(touches, self.cycles.pop(0), strict=False):
            if isinstance(time, BaseException):
                raise time
            yield Contact(touch.start, time)


class Thermometer:
    """Counts its readings."""

    channels = ("bed", "air")

    def __init__(self) -> None:
        self.readings = 0

    def read(self):
        self.readings += 1
        return {"bed": 20.0 + self.readings, "air": 20.0}


class Bench:
    """What the method sees of a bench."""

    machine = "lab machine"

    def __init__(self, thermometers=None, **drivers) -> None:
        self.drivers, self.thermometers, self.asked = drivers, thermometers or {}, []

    def of_kind(self, kind):
        return self.drivers[kind]

    def all_of_kind(self, kind):
        return self.thermometers

    def has_kind(self, kind):
        return kind in self.drivers

    def ask(self, message):
        self.asked.append(message)


def acquire(bench, chosen=None, done=None):
    return NormalVector().acquire(bench, chosen or settings(), inputs={}, done=done)


def check(chunk):
    """Check a cycle as it comes to the disk, where its counts are text."""
    datasets.validate(chunk.assign_attrs(invalid=json.dumps(chunk.attrs["invalid"])))


def driven(breaks=None, control=None, chosen=None, done=None, into=None):
    """Run a campaign on a driven machine; return its control, bench and the cycles, up to what broke."""
    control = control or Control()
    bench = Bench(controller=control, touch_probe=Probe(control, breaks))
    chunks = [] if into is None else into
    for chunk in acquire(bench, chosen, done):
        check(chunk)
        chunks.append(chunk)
    return control, bench, chunks


def joined(chunks, **attrs):
    """Return cycles as a run on disk holds them."""
    fixed = [each.drop_vars(["approach", "ball_nominal", "ball_radius", "tip_radius", "touch_noise"], errors="ignore")
             for each in chunks]  # fmt: skip
    return xr.concat(fixed, "time", combine_attrs="override").assign_attrs(chunks[0].attrs | attrs)


# ---------------------------------------------------------------------- a machine that is driven


def test_cycles_start_by_the_clock_with_a_stopped_spindle() -> None:
    control, bench, chunks = driven()
    assert [float(chunk["time"][0]) for chunk in chunks] == pytest.approx([0, 600, 1200, 1800, 2400])
    assert [each for each in control.log if each[0] == "spindle"] == [
        ("spindle", 0.0),
        *[("spindle", 9000.0), ("spindle", 0.0)] * 4,
    ]
    assert chunks[0].attrs["cold_cycle_seconds"] == pytest.approx(LENGTH + 2.0)
    speed = [float(chunk["spindle_speed"][0]) for chunk in chunks]
    # between two cycles' begins: 2 s of rest and 100 s of touches, in which it stands
    assert speed == pytest.approx([0.0, *[9000.0 * (600 - 102) / 600] * 4])
    assert "with the probe in it" in bench.asked[0]


def test_no_prompt_for_a_spindle_that_never_turns() -> None:
    _, bench, chunks = driven(chosen=settings(schedule=()))
    assert bench.asked == []
    assert len(chunks) == 5


def test_the_tool_is_changed_by_lines_of_a_program() -> None:
    chosen = settings(to_probe=("T9 M6",), to_warm_up=("T1 M6",), duration=600.0)
    control, bench, _ = driven(control=Programmed(), chosen=chosen)
    orders = [each[1] for each in control.log if each[0] in ("spindle", "program")]
    assert orders == [0.0, ["T9 M6"], ["T1 M6"], 9000.0, 0.0, ["T9 M6"]]
    assert bench.asked == []
    with raises("probing.programs.none"):
        driven(chosen=chosen)


def test_machine_in_alarm_is_not_moved() -> None:
    control = Control()
    control.alarms.append("door open")
    with raises("machine.not_ready"):
        driven(control=control)
    assert control.log == []


def test_interrupted_cycle_is_yielded_after_the_machine_was_stopped() -> None:
    control = Control()
    bench = Bench(controller=control, touch_probe=Probe(control, {(2, 5): InstrumentError("something in the way")}))
    source = acquire(bench)
    assert [float(next(source)["time"][0]) for _ in range(2)] == pytest.approx([0, 600])
    assert control.log[-1] == ("spindle", 0.0)
    broken = next(source)
    assert control.log[-1] == ("stop", True)
    assert (broken["touch_flag"].values == 0).sum() == 5
    assert (broken["touch_flag"].values == 4).sum() == 7
    assert broken.attrs["invalid"] == {"not made": 7}
    with raises("instrument.other"):
        next(source)


@pytest.mark.parametrize("error", [InstrumentError("alarm"), KeyboardInterrupt()])
def test_interrupted_cold_cycle_is_discarded(error) -> None:
    control, chunks = Control(), []
    with pytest.raises(type(error)):
        driven({(0, 7): error}, control, into=chunks)
    assert chunks == []
    assert control.log[-1] == ("stop", True)


def test_the_operator_may_interrupt_a_cycle_and_keeps_its_touches() -> None:
    chunks = []
    with pytest.raises(KeyboardInterrupt):
        driven({(1, 3): KeyboardInterrupt()}, into=chunks)
    assert [(chunk["touch_flag"].values == 0).sum() for chunk in chunks] == [12, 3]


def test_machine_is_stopped_when_the_acquisition_ends_early() -> None:
    control = Control()
    source = acquire(Bench(controller=control, touch_probe=Probe(control)))
    next(source)
    source.close()
    assert control.log[-1] == ("stop", True)


def test_a_machine_that_cannot_be_stopped_is_reported() -> None:
    control = Control()

    def gone(seconds):
        control.lost = control.deaf = True
        raise InstrumentTimeoutError("no answer for 2 s")

    control.elapse = gone
    with pytest.raises(
        InstrumentTimeoutError, match=r"no answer for 2 s\. Axes and spindle could not be stopped \(nobody"
    ):
        driven(control=control, chosen=settings(settle=0.0))
    assert control.turning == 9000.0


def test_late_cycle_is_omitted(caplog) -> None:
    """A cycle of 100 s at intervals of 60 s: every other one is made."""
    with caplog.at_level(logging.WARNING):
        _, _, chunks = driven(chosen=settings(interval=60.0, duration=240.0, settle=0.0))
    assert [float(chunk["time"][0]) for chunk in chunks] == pytest.approx([0, 100, 200])
    assert "starts 40 s late" in caplog.text
    assert "cycles 2 to 2 are omitted" in caplog.text


# ---------------------------------------------------------------------- going on


def began(seconds_ago: float) -> str:
    return (datetime.now(UTC) - timedelta(seconds=seconds_ago)).isoformat()


def test_resumed_run_on_a_real_machine_continues_by_the_clock(caplog) -> None:
    chunks = []
    with pytest.raises(InstrumentError):
        driven({(2, 5): InstrumentError("alarm")}, into=chunks)
    restarted = Control(time=77.0)  # its clock began anew
    with caplog.at_level(logging.WARNING):
        _, _, more = driven(control=restarted, done=joined(chunks, start=began(1900.0)))
    # cycle 3 was due 100 s ago
    assert [float(chunk["time"][0]) for chunk in more] == pytest.approx([1900, 2400], abs=2)
    assert float(more[0]["touch_time"].min()) > 1900
    assert float(more[0]["spindle_speed"][0]) == 0  # since cycle 2, as far as is known
    assert "cycle 3 starts 100 s late" in caplog.text
    assert {chunk.attrs["start"] for chunk in more} == {more[0].attrs["start"]}


def test_run_resumed_too_late_ends_with_its_cycles() -> None:
    _, _, chunks = driven(chosen=settings(duration=600.0))
    _, _, more = driven(done=joined(chunks, start=began(1e5)))
    assert more == []


def test_run_without_a_start_time_is_not_resumed() -> None:
    _, _, chunks = driven(chosen=settings(duration=600.0))
    with raises("run.start.missing"):
        driven(done=joined(chunks, start="once"))


def test_restarted_virtual_machine_repeats_the_warm_up() -> None:
    _, _, chunks = driven(control=Control(time=0.0, simulated=True), chosen=settings(duration=1200.0))
    control = Control(time=0.0, simulated=True)
    _, _, more = driven(control=control, done=joined(chunks))
    assert [float(chunk["time"][0]) for chunk in more] == pytest.approx([1800, 2400])
    # as uninterrupted: it stood in every cycle, those before included
    assert [each[1] for each in control.log if each[0] == "spindle"] == [0.0, *[9000.0, 0.0] * 4]
    assert float(more[0]["spindle_speed"][0]) == pytest.approx(9000.0 * 498 / 600)


def test_running_virtual_machine_continues() -> None:
    control = Control(time=40.0, simulated=True)
    _, _, chunks = driven(control=control, chosen=settings(duration=1200.0))
    control.log.clear()
    _, _, more = driven(control=control, done=joined(chunks))
    assert [float(chunk["time"][0]) for chunk in more] == pytest.approx([1800, 2400])
    assert [each[1] for each in control.log if each[0] == "spindle"] == [9000.0, 0.0] * 2


# ---------------------------------------------------------------------- a machine that prints


def lines(begin: float, count: int = 12) -> list[float]:
    return [begin + 5.0 * i for i in range(count)]


def test_lines_of_a_program_started_by_the_operator_are_read() -> None:
    thermometer = Thermometer()
    bench = Bench({"t": thermometer}, touch_probe=Printer([lines(700.0 + 600 * k) for k in range(5)]))
    chunks = list(acquire(bench))
    assert bench.asked == [
        "Start the program warm_up.nc on the machine ('errormotion program' writes it). Its last cycle starts after "
        "about 40 min."
    ]
    assert [float(chunk["time"][0]) for chunk in chunks] == pytest.approx([0, 600, 1200, 1800, 2400])
    assert [float(chunk["temperature"][0, 0]) for chunk in chunks] == [21, 22, 23, 24, 25]
    assert "touch_noise" not in chunks[0]  # the probe does not say
    length = math.fsum(step.seconds for step in cycle.cycle_steps(settings()))
    expected = 9000.0 * (600 - length - 2) / 600
    assert [float(chunk["spindle_speed"][0]) for chunk in chunks] == pytest.approx([0, *[expected] * 4], rel=0.03)
    for chunk in chunks:
        check(chunk)


def test_lines_without_the_time_have_the_planned_one() -> None:
    chunks = list(acquire(Bench(touch_probe=Printer([[math.nan] * 12] * 5))))
    assert [float(chunk["time"][0]) for chunk in chunks] == pytest.approx([0, 600, 1200, 1800, 2400])
    assert "touch_time" not in chunks[0]


def test_interrupted_program_keeps_its_lines_and_states_where_to_restart() -> None:
    silent = InstrumentTimeoutError("Touch 5 of 12: no line for 60 s")
    source = acquire(Bench(touch_probe=Printer([lines(0.0), [*lines(600.0, 4), silent]])))
    chunks = [next(source), next(source)]
    assert (chunks[1]["touch_flag"].values == 0).sum() == 4
    with pytest.raises(InstrumentTimeoutError, match=r"no line for 60 s\. If its program is still running, stop it"):
        next(source)
    later = Bench(touch_probe=Printer([lines(10.0 + 600 * k) for k in range(3)]))
    done = joined(chunks, start=began(2000.0))
    more = list(acquire(later, done=done))
    assert "from sequence number N2" in later.asked[0]
    assert [float(chunk["time"][0]) for chunk in more] == pytest.approx([2000, 2600, 3200], abs=2)


def test_state_of_the_control_explains_missing_lines() -> None:
    class ReadOnly:
        def state(self):
            return {"estop": False, "alarms": ["2042 spindle overload"]}

    silent = InstrumentTimeoutError("Touch 1 of 12: no line")
    with pytest.raises(InstrumentTimeoutError, match=r"no line\. The machine is in alarm: 2042 spindle overload\."):
        list(acquire(Bench(touch_probe=Printer([[silent]]), controller=ReadOnly())))


def test_an_old_line_is_not_taken_for_a_touch_of_this_cycle() -> None:
    class Active(Printer):
        """At a control that runs programs."""

        settings = settings()

        def configure(self, chosen):
            pass

    bench = Bench(touch_probe=Active([lines(5000.0), lines(5000.0)]), controller=Programmed())
    source = acquire(bench)
    next(source)
    with raises("probing.contact.early"):
        next(source)


# ---------------------------------------------------------------------- benches and settings that cannot do it


def test_probe_that_moves_the_machine_needs_a_control() -> None:
    with raises("probing.controller.missing"):
        next(acquire(Bench(touch_probe=Probe(Control()))))


def test_three_balls_are_required() -> None:
    with raises("probing.balls.too_few"):
        next(acquire(Bench(), settings(balls=BALLS[:2])))


def test_ball_not_found_in_the_cold_cycle_is_reported_immediately() -> None:
    class Blind(Probe):
        def measure(self, touches):
            for contact, touch in zip(super().measure(touches), touches, strict=True):
                yield contact if touch.item else Contact((math.nan,) * 3, contact.time, "no trip")

    control = Control()
    with pytest.raises(InstrumentError, match=r"too few good touches of B1 \(4 no trip\); expected 3 or more"):
        next(acquire(Bench(touch_probe=Blind(control), controller=control)))


# ---------------------------------------------------------------------- for the person at the machine


def test_each_cycle_is_reported_in_a_line() -> None:
    machine = VirtualMachine("gantry", seed=5)
    machine.start([])
    raw = simulation.raw(machine, [0.0, 600.0], seed=1, touches=5)
    place = raw["touch"].values
    place[1] = place[0] + np.array([4e-6, -2e-6, 7e-6])
    live = LiveBalls(settings(balls=BALLS))
    assert live.update(raw.isel(time=[0])).startswith("cycle 0 of 4, 0.0 min; warmest ")
    broken = raw.isel(time=[1])
    assert "balls X +4.0 Y -2.0 Z +7.0 um since cold; warmest" in live.update(broken)
    text = live.update(broken.assign(touch_flag=broken["touch_flag"].copy(data=np.full((1, 4, 5), 4))))
    assert "too few touches; 0 of 20 touches good" in text


def test_line_after_an_interruption_states_its_reference() -> None:
    _, _, chunks = driven()
    live = LiveBalls(settings())
    live.update(chunks[2])
    assert live.update(chunks[3]) == "cycle 3 of 4, 30.0 min; balls X +0.0 Y +0.0 Z +0.0 um since cycle 2"
