"""A LinuxCNC for tests of compensation, whose servo thread records the offset and what the drive of X is commanded.

``ddt`` and ``minmax`` see every cycle: an offset, or a change of it, that lasts one cycle is in the record.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from errormotion.instruments.compensator.linuxcnc import (
    LinuxCNCCompensatorSettings,
    LinuxCNCFeedback,
    LinuxCNCOffset,
)
from errormotion.instruments.controller.linuxcnc import BRIDGE, COMPENSATION, LinuxCNC, LinuxCNCSettings
from errormotion.instruments.simulators.controller.linuxcnc_config import Compensated, ini_text
from errormotion.instruments.simulators.controller.linuxcnc_process import LinuxCNCProcess

DISPLAY = Path(__file__).with_name("linuxcnc_display.py")
TRAVEL = 0.1  # m, in both directions
RAPID = 0.1  # m/s
MAX_WAIT = 600.0  # s, for another simulated LinuxCNC on this computer
MICROMETRE = 1e-3  # mm, the unit of the INI file
MAX_ANSWER = 20.0  # s, on a computer with other work
SETTLED = 1e-7  # mm; LinuxCNC's planner comes closer than that in some cycles
DRIVERS = {"external": LinuxCNCOffset, "feedback": LinuxCNCFeedback}
WATCH = """
loadrt ddt names=watch-slew,watch-speed
loadrt minmax names=watch-offset,watch-change,watch-drive,watch-motion
net {offset} => watch-slew.in
net {offset} => watch-offset.in
net watch-rate watch-slew.out => watch-change.in
net J0:pos-cmd => watch-speed.in
net J0:pos-cmd => watch-drive.in
net watch-velocity watch-speed.out => watch-motion.in
addf watch-slew servo-thread
addf watch-speed servo-thread
addf watch-offset servo-thread
addf watch-change servo-thread
addf watch-drive servo-thread
addf watch-motion servo-thread
"""
RECORDS = ("offset", "change", "drive", "motion")


@dataclass(frozen=True)
class Record:
    """What the servo thread saw since the last `Machine.watch`: offset of X, um, and command of its drive."""

    lowest: float
    highest: float
    fastest: float
    drive_moved: float
    drive_fastest: float


class Machine:
    """The real LinuxCNC with a compensation, its bridge, and its record."""

    def __init__(self, compensated: Compensated) -> None:
        self.compensated = compensated
        axes = dict.fromkeys("XYZ", (-TRAVEL, TRAVEL))
        ini = ini_text("test", axes, RAPID, 6000.0, arguments="{folder} --compensate", compensated=compensated)
        ini = ini.replace("HALFILE = compensation.tcl", "HALFILE = compensation.tcl\nHALFILE = watch.hal")
        external = compensated.route == "external"
        files = {
            "linuxcnc.ini": ini,
            "balls.hal": "",
            COMPENSATION.name: COMPENSATION.read_text(),
            "machine_bridge.py": BRIDGE.read_text(),
            "watch.hal": WATCH.format(offset="watch-x axis.x.eoffset" if external else "errormotion-offset-x"),
        }
        self.process = LinuxCNCProcess(files, DISPLAY, wait=MAX_WAIT)
        self.address = f"unix://{self.process.socket}"
        self.token = self.process.folder / "token"
        self.control = LinuxCNC(self.address, LinuxCNCSettings(arm=True, token_file=self.token, timeout=MAX_ANSWER))

    def compensator(self) -> LinuxCNCOffset:
        """Return another compensator, not yet open."""
        return DRIVERS[self.compensated.route](self.address, LinuxCNCCompensatorSettings(token_file=self.token))

    def hal(self, *lines: str) -> str:
        """Execute commands of halcmd."""
        return subprocess.run(
            ["halcmd", "-s", "-f"], input="\n".join(lines), capture_output=True, text=True, check=True
        ).stdout

    def pins(self, *names: str) -> list[float]:
        """Return values of pins; of bits, 1 and 0."""
        found = self.hal(*(f"getp {name}" for name in names)).split()
        return [float({"TRUE": "1", "FALSE": "0"}.get(text, text)) for text in found]

    def offset(self) -> float:
        """Return the offset of X that the limit in the servo thread gives, um."""
        return self.pins("errormotion-limit-x.out")[0] / MICROMETRE

    def offsets(self) -> list[float]:
        """Return the offset of X that the limit gives, and that the planner of LinuxCNC has applied if it does, um."""
        names = ["errormotion-limit-x.out"]
        if self.compensated.route == "external":
            names.append("axis.x.eoffset")
        return [value / MICROMETRE for value in self.pins(*names)]

    def watch(self) -> None:
        """Begin another record."""
        for value in (1, 0):
            self.hal(*(f"setp watch-{each}.reset {value}" for each in RECORDS))
            time.sleep(0.01)  # some servo cycles

    def record(self) -> Record:
        """Return the record."""
        found = self.pins(*(f"watch-{each}.{end}" for each in RECORDS for end in ("min", "max")))
        offset, change, drive, motion = (
            (found[2 * k] / MICROMETRE, found[2 * k + 1] / MICROMETRE) for k in range(len(RECORDS))
        )
        return Record(
            *offset,
            max(map(abs, change)),
            drive[1] - drive[0],
            max(map(abs, motion)),
        )

    def _without_offset(self) -> bool:
        given, applied = self.pins("errormotion-limit-x.out", "axis.x.eoffset")
        return given == 0 and abs(applied) < SETTLED

    def kill_bridge(self) -> None:
        """Kill the bridge and return when another one runs."""
        announced = self.process.folder / "announced.json"
        before = json.loads(announced.read_text())["pid"]
        os.kill(before, signal.SIGKILL)
        until(lambda: announced.exists() and json.loads(announced.read_text())["pid"] != before)

    @contextmanager
    def suspended_bridge(self) -> Iterator[None]:
        """Stop the bridge for a while."""
        pid = json.loads((self.process.folder / "announced.json").read_text())["pid"]
        os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            os.kill(pid, signal.SIGCONT)

    def rest(self) -> None:
        """Switch on, at the start, without an offset."""
        self.control.reset()
        self.control.enable()
        if not self.control.state()["homed"]:
            self.control.home()
        until(self._without_offset)
        self.control.move_to([0.001, 0.0, 0.0])  # LinuxCNC's interpreter may not know how far an offset was left behind
        self.control.move_to([0.0, 0.0, 0.0])


def until(condition: Callable[[], bool], limit: float = 20.0) -> None:
    """Wait for a condition."""
    end = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < end, "the condition does not come true"
        time.sleep(0.05)
