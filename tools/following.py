"""Compensate the real LinuxCNC with a fault at every interval: ``make following``.

The servo thread records the offset and its change, cycle by cycle. This program writes its section of
docs/reliability.md.
"""

from __future__ import annotations

import argparse
import os
import platform
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT / "tools")]

from fuzz import PAGE, write_section  # noqa: E402
from linuxcnc_follower import LIMITS, SPEEDUP  # noqa: E402
from linuxcnc_watch import DRIVERS, Machine, Record, until  # noqa: E402

from errormotion.errors import InstrumentError  # noqa: E402
from errormotion.instruments.simulators.controller.linuxcnc_config import Compensated  # noqa: E402

TITLE = "A compensation that is disturbed"
CYCLE = 1e-3  # s
EXACT = 1e-6
"""Relative, of numbers that HAL prints with seven digits."""
WATCHDOG = 5.0 / SPEEDUP  # s
SLACK = 5.0  # s, of a computer with other work
START_TIMEOUT = 300.0  # s, of a program on a computer with much other work
NAMES = {
    "kill_program": "compensating program killed",
    "suspend_program": "compensating program suspended for 3 s",
    "kill_bridge": "bridge killed and started again",
    "estop": "emergency stop, and the machine switched on again",
    "hold": "program hold for 2 s",
    "probe": "probing",
    "second": "a second compensator tries to write",
    "raw": "offsets of 1 m, without the bridge's check",
}


@dataclass
class Course:
    """Results of one route.

    Attributes
    ----------
    records : list of Record
        Of the servo thread, without gaps except at an emergency stop, at which LinuxCNC sets an external offset to
        zero at once.
    fastest_in_estop : float
        Fastest change of the command of a motor in an emergency stop, um/s.
    """

    route: str
    seconds: float = 0.0
    faults: Counter[str] = field(default_factory=Counter)
    records: list[Record] = field(default_factory=list)
    slowest_zero: float = 0.0
    fastest_in_estop: float = 0.0
    starts: int = 0
    errors: list[str] = field(default_factory=list)


class Following:
    """A machine and the program that compensates it."""

    def __init__(self, route: str, folder: Path, seed: int) -> None:
        self.course = Course(route)
        self.random = random.Random(seed)
        self.folder = folder
        self.machine = Machine(Compensated(route, LIMITS.limit, LIMITS.slew, WATCHDOG))
        self.program: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the program, and wait until it writes."""
        words = [self.machine.address, str(self.machine.token), self.course.route, str(self.folder)]
        log = (self.folder / f"{self.course.route}-{self.course.starts}.log").open("wb")
        self.program = subprocess.Popen(
            [sys.executable, str(ROOT / "tests" / "support" / "linuxcnc_follower.py"), *words],
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        log.close()
        self.course.starts += 1
        until(self.alive, START_TIMEOUT)

    def alive(self) -> bool:
        """Whether new offsets arrive."""
        return bool(self.machine.pins("errormotion-alive.out")[0])

    def end(self) -> None:
        """Kill the program."""
        if self.program is not None:
            self.program.kill()
            self.program.wait()
            self.program = None

    def zero(self) -> None:
        """Wait until the offset is zero; record the time since the last possible write."""
        start = time.monotonic()
        until(lambda: self.machine.offset() == 0, 60.0)
        self.course.slowest_zero = max(self.course.slowest_zero, time.monotonic() - start)

    # ------------------------------------------------------------------ faults

    def kill_program(self) -> None:
        """Kill it and start it again."""
        self.end()
        self.zero()
        self.start()

    def suspend_program(self) -> None:
        """Stop it for longer than the time of the watchdog."""
        assert self.program is not None
        self.program.send_signal(signal.SIGSTOP)
        self.zero()
        time.sleep(1.0)
        self.program.send_signal(signal.SIGCONT)
        self._again()

    def kill_bridge(self) -> None:
        """Kill it and start it again; the program reconnects."""
        self.machine.kill_bridge()
        self.machine.control.state()  # reconnects
        self._again()

    def estop(self) -> None:
        """Stop the machine, switch it on, and start the compensation again."""
        self.course.records.append(self.machine.record())
        self.machine.watch()
        self.machine.control.estop()
        until(lambda: self.machine.offset() == 0, 60.0)
        self.course.fastest_in_estop = max(self.course.fastest_in_estop, self.machine.record().drive_fastest)
        self.end()
        self.machine.rest()
        self.machine.watch()
        self.start()

    def hold(self) -> None:
        """Hold the offset by an NC program."""
        self._program("M64 P0\nG4 P2\nM65 P0\n")

    def probe(self) -> None:
        """Probe without a contact."""
        self._program("G38.3 Z-2 F80\nG53 G0 Z0\n")

    def second(self) -> None:
        """Try to write with a second compensator."""
        with self.machine.compensator() as other:
            try:
                other.arm(LIMITS.limit)
            except InstrumentError:
                return
        self.course.errors.append("a second compensator got the right to write")

    def raw(self) -> None:
        """Set an offset of 1 m in the servo thread, without the bridge."""
        for value in (1e3, -1e3, 0.0):
            self.machine.hal(f"setp errormotion-source-x.in1 {value}")
            time.sleep(0.3)

    def _program(self, text: str) -> None:
        self.machine.control.run_program(f"G21 G90 G94\n{text}M2\n")
        self.machine.control.finish()

    def _again(self) -> None:
        """Wait until the program continues, or start it again as an operator would after a fault."""
        end = time.monotonic() + SLACK
        while time.monotonic() < end:
            if self.alive():
                return
            time.sleep(0.05)
        self.end()
        self.zero()
        self.start()

    # ------------------------------------------------------------------ the course

    def run(self, seconds: float, interval: float) -> Course:
        """Follow for a time, with a fault at each interval; all kinds in random order."""
        order: list[str] = []
        with self.machine.control:
            self.machine.rest()
            self.machine.watch()
            begin = time.monotonic()
            self.start()
            while (now := time.monotonic() - begin) < seconds:
                time.sleep(max(min(interval, seconds - now), 0.0))
                if not order:
                    order = self.random.sample(sorted(NAMES), len(NAMES))
                kind = order.pop()
                act: Callable[[], None] = getattr(self, kind)
                print(f"{self.course.route}, {time.monotonic() - begin:.0f} s: {NAMES[kind]}", flush=True)
                act()
                self.course.faults[kind] += 1
            self.end()
            self.zero()
            self.course.records.append(self.machine.record())
            self.course.seconds = time.monotonic() - begin
        return self.course

    def close(self) -> None:
        """End everything."""
        self.end()
        self.machine.process.end()


def failures(course: Course) -> list[str]:
    """Return the failures of a course."""
    found = list(course.errors)
    limit, slew = 1e6 * LIMITS.limit * (1 + EXACT), 1e6 * LIMITS.slew * (1 + EXACT)
    for record in course.records:
        if max(record.highest, -record.lowest) > limit:
            found.append(f"{course.route}: an offset of {record.lowest:g} to {record.highest:g} um")
        if record.fastest > slew:
            found.append(f"{course.route}: a change of {record.fastest:g} um/s")
    if course.slowest_zero > WATCHDOG + LIMITS.limit / LIMITS.slew + SLACK:
        found.append(f"{course.route}: zero after {course.slowest_zero:.1f} s")
    if course.fastest_in_estop > slew:
        found.append(f"{course.route}: a motor was commanded {course.fastest_in_estop:g} um/s in an emergency stop")
    return found


def section(courses: list[Course], interval: float, seed: int) -> str:
    """Return the section of the page."""
    hours = SPEEDUP * sum(course.seconds for course in courses) / 3600
    slowest = 1e6 * LIMITS.slew
    lines = [
        "The code of `errormotion compensate run` followed a thermometer with drift, jumps and missing answers, and "
        f"wrote to the real LinuxCNC on simulated joints. All times are {SPEEDUP:g} times shorter than by default, "
        f"and the slew limit is as much higher ({slowest:g} um/s; watchdog {WATCHDOG:g} s, interval of offsets "
        f"{LIMITS.period:g} s): {hours:.1f} hours at that scale, with a fault every {SPEEDUP * interval / 60:.2g} "
        "minutes. The servo thread ran at its real rate, and recorded the extremes of the offset and of its change "
        "of all its cycles. After a fault that requires an operator, the program was started again.",
        "",
        "| fault | number |",
        "|---|---|",
    ]
    total = sum((course.faults for course in courses), Counter[str]())
    lines += [f"| {NAMES[kind]} | {count} |" for kind, count in sorted(total.items())]
    lines += ["", f"| result | {' | '.join(course.route for course in courses)} |", f"|---|{'---|' * len(courses)}"]
    rows: dict[str, Callable[[Course], str]] = {
        "servo cycles": lambda c: f"{c.seconds / CYCLE:.3g}",
        "starts of the program": lambda c: f"{c.starts}",
        f"offset, within ±{1e6 * LIMITS.limit:g} um": lambda c: (
            f"{min(r.lowest for r in c.records):.5g} to {max(r.highest for r in c.records):.5g} um"
        ),
        f"fastest change, at most {slowest:g} um/s": lambda c: f"{max(r.fastest for r in c.records):.7g} um/s",
        "the same of the motor's command, in emergency stops": lambda c: f"{c.fastest_in_estop:.7g} um/s",
        "longest time to zero after the program was killed or suspended": lambda c: f"{c.slowest_zero:.2f} s",
    }
    lines += [f"| {name} | {' | '.join(text(course) for course in courses)} |" for name, text in rows.items()]
    wrong = [text for course in courses for text in failures(course)]
    lines += ["", *(["Failures:", "", *(f"* {text}" for text in wrong)] if wrong else ["No failure."])]
    where = f"{platform.machine()}, Python {platform.python_version()}"
    return "\n".join([*lines, "", f"`make following`, seed {seed}, {where}."])


def main() -> None:
    """Follow on each route, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=72.0, help="in all, real")
    parser.add_argument("--interval", type=float, default=30.0, help="from one fault to the next, s, real")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    courses = []
    with tempfile.TemporaryDirectory(prefix="following") as folder:
        os.environ["XDG_STATE_HOME"] = f"{folder}/state"
        for route in DRIVERS:
            following = Following(route, Path(folder), options.seed)
            try:
                courses.append(following.run(30.0 * options.minutes, options.interval))
            finally:
                following.close()
    body = section(courses, options.interval, options.seed)
    print(body)
    write_section(options.out, TITLE, body)
    print(f"written to {options.out}")
    sys.exit(any(failures(course) for course in courses))


if __name__ == "__main__":
    main()
