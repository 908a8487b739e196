#!/usr/bin/python3
"""Display of a LinuxCNC in tests: homes, moves one axis to positions, and writes what its servo thread commanded.

Arguments: folder, letter of the axis, number of its joint, positions in mm. ``moves.json`` in the folder gets
``[position, pos-cmd, motor-pos-cmd]`` of each stop; the program then waits until it is ended.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

import hal
import linuxcnc

folder, letter, joint, *positions = sys.argv[3:]  # after -ini and its file
TIMEOUT = 20.0  # s


def wait(condition):
    until = time.monotonic() + TIMEOUT
    while not condition():
        if time.monotonic() > until:
            raise TimeoutError(condition)
        time.sleep(0.01)


component = hal.component("errormotion-moves")
component.ready()
command, status = linuxcnc.command(), linuxcnc.stat()


def polled(question):
    status.poll()
    return question()


def mdi(line):
    command.mdi(line)
    command.wait_complete(TIMEOUT)
    wait(lambda: polled(lambda: status.inpos and status.interp_state == linuxcnc.INTERP_IDLE))


(Path(folder) / "token").write_text("none")
announced = Path(folder) / "bridge.part"
announced.write_text(json.dumps({"socket": "none", "pid": os.getpid()}))
announced.rename(Path(folder) / "bridge.json")
found = []
try:
    wait(lambda: polled(lambda: status.task_mode > 0))
    command.state(linuxcnc.STATE_ESTOP_RESET)
    command.wait_complete(TIMEOUT)
    command.state(linuxcnc.STATE_ON)
    command.wait_complete(TIMEOUT)
    command.home(-1)
    wait(lambda: polled(lambda: all(status.homed[:3])))
    command.mode(linuxcnc.MODE_MDI)
    command.wait_complete(TIMEOUT)
    for position in positions:
        mdi(f"G21 G53 G0 {letter}{position}")
        time.sleep(0.1)  # the compensation follows with the joint's own acceleration
        pins = [hal.get_value(f"joint.{joint}.{pin}") for pin in ("pos-cmd", "motor-pos-cmd")]
        found.append([float(position), *pins])
finally:
    part = Path(folder) / "moves.part"
    part.write_text(json.dumps(found))
    part.rename(Path(folder) / "moves.json")
    signal.pause()
