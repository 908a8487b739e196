"""A LinuxCNC that is started after one whose processes were all killed."""

import json
import os
import signal
import time
from pathlib import Path

import pytest

from errormotion.instruments.simulators.controller import linuxcnc_process
from errormotion.instruments.simulators.controller.linuxcnc_config import ini_text
from errormotion.instruments.simulators.controller.linuxcnc_process import LinuxCNCProcess
from errormotion.twin import VirtualMachine

if reason := linuxcnc_process.why_not():
    pytest.skip(reason, allow_module_level=True)

pytestmark = pytest.mark.slow

DISPLAY = Path(__file__).parents[3] / "support" / "linuxcnc_moves.py"
TARGET = 12.5  # mm


def started() -> LinuxCNCProcess:
    machine = VirtualMachine("cframe", 3)
    arguments = f"{{folder}} Y 1 {TARGET}"
    ini = ini_text("test", machine.travel, machine.rapid, 9000.0, arguments=arguments)
    return LinuxCNCProcess({"linuxcnc.ini": ini, "balls.hal": ""}, DISPLAY, wait=90.0)


def test_messages_of_a_killed_process_are_not_attributed_to_the_next_one() -> None:
    killed = started()
    for process in linuxcnc_process._parts(killed.folder):
        os.kill(process, signal.SIGKILL)
    following = started()
    try:
        file, until = following.folder / "moves.json", time.monotonic() + 30
        while not file.exists():
            assert time.monotonic() < until, (following.folder / "log.txt").read_text(errors="replace")[-2000:]
            time.sleep(0.05)
        ((position, *_),) = json.loads(file.read_text())
    finally:
        following.end()
        killed.end()
    assert position == TARGET
