"""The table of LinuxCNC in LinuxCNC: the commands of its servo thread to the motor of an axis."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from errormotion.compensation.tables import axis_table, export, get
from errormotion.instruments.simulators.controller import linuxcnc_process
from errormotion.instruments.simulators.controller.linuxcnc_config import ini_text
from errormotion.instruments.simulators.controller.linuxcnc_process import LinuxCNCProcess
from errormotion.twin import VirtualMachine

if reason := linuxcnc_process.why_not():
    pytest.skip(reason, allow_module_level=True)

pytestmark = pytest.mark.slow

DISPLAY = Path(__file__).parents[1] / "support" / "linuxcnc_moves.py"
TARGETS = [-243.0, -130.0, -12.5, 40.0, 187.25, 251.0, 187.25, 40.0, -12.5, -130.0, -243.0]  # mm: forward, then back
REVERSAL = 4e-6
FLOAT = 1e-7
"""The motion controller holds trims as numbers of four bytes, relative."""


def measured(machine: VirtualMachine) -> xr.Dataset:
    """Return the exact errors of Y of the virtual machine with a reversal of up to 30 um."""
    y = np.linspace(-0.25, 0.25, 26)
    ds = machine.truth_axis("Y", y).load()
    reversal = np.full((1, y.size), REVERSAL)
    ds["EY"] = ds["EY"] * 10
    return ds.assign(reversal=(("freedom", "position"), reversal)).assign_coords(freedom=["EYY"])


@pytest.mark.parametrize("kind", [1, 0])
def test_with_the_table_the_tool_reaches_the_commanded_position(kind: int) -> None:
    machine = VirtualMachine("cframe", 3)
    errors = measured(machine)
    table = axis_table(errors, "Y", step=0.025)
    form = get("linuxcnc")
    exported = export(table, form, form.Settings(type=kind))
    ((name, text),) = exported.files.items()
    ini = ini_text(
        "test", machine.travel, machine.rapid, 9000.0, arguments=f"{{folder}} Y 1 {' '.join(map(str, TARGETS))}"
    )
    ini = ini.replace("[JOINT_1]\n", f"[JOINT_1]\nCOMP_FILE = {{folder}}/{name}\nCOMP_FILE_TYPE = {kind}\n")
    process = LinuxCNCProcess({"linuxcnc.ini": ini, name: str(text), "balls.hal": ""}, DISPLAY, wait=90.0)
    try:
        file, until = process.folder / "moves.json", time.monotonic() + 60
        while not file.exists():
            assert time.monotonic() < until, (process.folder / "log.txt").read_text(errors="replace")[-2000:]
            time.sleep(0.05)
        stops = np.array(json.loads(file.read_text()))
    finally:
        process.end()
    assert stops[:, 0].tolist() == TARGETS, stops
    assert np.abs(stops[:, 1] - stops[:, 0]).max() < 1e-6
    forward = np.diff(stops[:, 0], prepend=0.0) > 0
    trims = [np.interp(stops[:, 0] / 1e3, table.positions, each) for each in (table.forward, table.backward)]
    expected = 1e3 * np.where(forward, *trims)
    assert np.abs(expected).max() > 0.02
    shift = stops[:, 2] - stops[:, 1]
    assert np.abs(shift - expected).max() < 1e-6 + FLOAT  # mm: the sixth decimal of the file, and of the command
    # The axis is where it was commanded: its own error, with the reversal, and what the table does not hold.
    motor = stops[:, 2] / 1e3
    error = np.interp(motor, errors["y"], errors["EY"]) + np.where(forward, 1, -1) * REVERSAL / 2
    remaining = motor + error - stops[:, 0] / 1e3
    assert np.abs(remaining).max() <= exported.interpolation + 2e-9
