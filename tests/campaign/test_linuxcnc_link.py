"""A disturbed link between `errormotion compensate run` and LinuxCNC, by the record of its servo thread."""

import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from disturbed_link import HARMFUL, HARMLESS, Link
from linuxcnc_follower import MACHINE, SENSITIVITY, Thermometer, model
from linuxcnc_watch import DRIVERS, Machine, until

from errormotion.campaign.compensation.compensating import Compensation, Moment
from errormotion.campaign.files import BenchCompensator, BenchInstrument, parse_bench
from errormotion.compensation.online.settings import Limits
from errormotion.instruments.compensator.linuxcnc import LinuxCNCCompensatorSettings
from errormotion.instruments.simulators.controller import linuxcnc_process
from errormotion.instruments.simulators.controller.linuxcnc_config import Compensated
from errormotion.plugins import PluginSettings

if reason := linuxcnc_process.why_not():
    pytest.skip(reason, allow_module_level=True)

pytestmark = pytest.mark.slow

LIMIT, SLEW, WATCHDOG = 20.0, 20.0, 2.0  # um, um/s, s
LIMITS = Limits(limit=LIMIT * 1e-6, slew=SLEW * 1e-6, period=0.1, oldest=10.0, hold=10.0, settle=0.1)
EXACT = 1e-6
"""Relative, of numbers that HAL prints with seven digits."""
NEAR = 0.05  # um
SETTLED = 1e-3  # um; the planner of LinuxCNC follows the limit
WARMER = 2.0  # K
TARGET = -1e6 * SENSITIVITY * WARMER  # um
PATIENCE = 60.0  # s, of a computer with other work


class Warmed(Thermometer):
    """Has a temperature that a test sets, degC."""

    temperature = 20.0

    def read(self) -> dict[str, float]:
        return {"spindle": self.temperature}


@pytest.fixture(scope="module")
def started() -> Iterator[Machine]:
    machine = Machine(Compensated("external", LIMIT * 1e-6, SLEW * 1e-6, WATCHDOG))
    yield machine
    machine.process.end()


@pytest.fixture
def machine(started: Machine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Machine]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with started.control:
        started.rest()
        started.watch()
        yield started


class Following:
    """A compensation that runs in parallel to the test, and its states."""

    def __init__(self, machine: Machine, link: Path, runs: Path) -> None:
        head = f'schema = "errormotion.bench/1"\nname = "Shop"\nmachine = "{MACHINE}"\n'
        settings = LinuxCNCCompensatorSettings(token_file=machine.token, timeout=1.0)
        plan = replace(
            parse_bench(head, Path("bench.toml")),
            instruments=(BenchInstrument("thermometer", Warmed, "", PluginSettings()),),
            compensator=BenchCompensator(DRIVERS["external"], f"unix://{link}", settings, LIMITS),
        )
        self.moments: list[Moment] = []
        self._compensation = Compensation(plan, model().dataset, runs, arm=MACHINE)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._follow)
        self._thread.start()

    def _follow(self) -> None:
        with self._compensation:
            for moment in self._compensation.follow():
                self.moments.append(moment)
                if self._ended.is_set():
                    return

    @property
    def state(self) -> str:
        return str(self.moments[-1].step.state) if self.moments else ""

    def close(self) -> None:
        self._ended.set()
        self._thread.join()


@pytest.fixture
def link(machine: Machine, tmp_path: Path) -> Iterator[Link]:
    with closing(Link(tmp_path / "link.sock", machine.process.socket)) as found:
        yield found


@pytest.fixture
def following(machine: Machine, link: Link, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Following]:
    with closing(Following(machine, tmp_path / "link.sock", tmp_path / "runs")) as found:
        until(lambda: found.state == "following", PATIENCE)
        monkeypatch.setattr(Warmed, "temperature", Warmed.temperature + WARMER)
        until(lambda: max(abs(offset - TARGET) for offset in machine.offsets()) < SETTLED, PATIENCE)
        yield found


@pytest.mark.parametrize("kind", HARMLESS)
def test_split_and_delayed_data_have_no_effect(machine: Machine, link: Link, following: Following, kind: str) -> None:
    machine.watch()
    before = len(following.moments)
    link.kind = kind
    until(lambda: len(following.moments) > before + 30, PATIENCE)
    assert {str(moment.step.state) for moment in following.moments[before:]} == {"following"}
    record = machine.record()
    assert record.lowest == pytest.approx(TARGET, abs=NEAR)
    assert record.highest == pytest.approx(TARGET, abs=NEAR)


@pytest.mark.parametrize("kind", HARMFUL)
def test_a_disturbed_link_is_followed_by_a_hold_and_a_ramp_to_zero(
    machine: Machine, link: Link, following: Following, kind: str
) -> None:
    course: list[tuple[float, bool]] = []

    def is_zero() -> bool:
        offset, alive = machine.pins("errormotion-limit-x.out", "errormotion-alive.out")
        course.append((1e3 * offset, bool(alive)))
        return offset == 0 and following.state == "fault"

    link.kind = kind
    until(is_zero, PATIENCE)
    if kind != "numbers":  # these arrive, and are bounded
        held = [offset for offset, alive in course if alive]
        assert held == pytest.approx([TARGET] * len(held), abs=NEAR)
        assert [offset for offset, _ in course] == sorted(offset for offset, _ in course)
        link.kind = ""
        until(lambda: following.state == "following" and abs(machine.offset() - TARGET) < NEAR, PATIENCE)
    record = machine.record()
    assert record.fastest <= SLEW * (1 + EXACT)
    assert record.drive_fastest <= SLEW * (1 + EXACT)
    assert record.lowest >= -LIMIT * (1 + EXACT)
    assert record.highest <= LIMIT * (1 + EXACT)
