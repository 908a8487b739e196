"""Messages if LinuxCNC cannot be started; nothing here starts it."""

import fcntl
import os
from pathlib import Path

import pytest

from errormotion.errors import InstrumentError
from errormotion.instruments.controller.linuxcnc import BRIDGE, LinuxCNC
from errormotion.instruments.simulators.controller import linuxcnc_process
from errormotion.instruments.simulators.controller.linuxcnc_config import hal_text, ini_text, pin_values
from errormotion.instruments.simulators.controller.linuxcnc_process import LinuxCNCProcess


@pytest.fixture
def own_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(linuxcnc_process, "LOCK", tmp_path / "lock")
    monkeypatch.setattr(linuxcnc_process, "LINUXCNC_LOCK", tmp_path / "theirs")
    monkeypatch.setattr(linuxcnc_process, "why_not", lambda: "")
    monkeypatch.setattr(linuxcnc_process, "_processes", dict)
    return tmp_path / "lock"


def test_without_linuxcnc_the_debian_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(linuxcnc_process.shutil, "which", lambda name: None)
    with pytest.raises(InstrumentError, match="apt install linuxcnc-uspace"):
        LinuxCNC("sim://cframe/linuxcnc?seed=11").open()


def test_a_second_one_waits_and_then_states_the_reason(own_lock: Path) -> None:
    own_lock.touch()
    first = os.open(own_lock, os.O_RDONLY)
    fcntl.flock(first, fcntl.LOCK_EX)
    try:
        with pytest.raises(
            InstrumentError, match="can only run one LinuxCNC; another simulated one did not end in time"
        ):
            LinuxCNCProcess({}, BRIDGE, wait=0.2)
    finally:
        os.close(first)


@pytest.mark.parametrize("name", linuxcnc_process.PROCESSES)
def test_a_linuxcnc_that_may_run_a_machine_is_not_touched(
    own_lock: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    theirs = linuxcnc_process.LINUXCNC_LOCK
    theirs.touch()
    monkeypatch.setattr(linuxcnc_process, "_processes", lambda: {4711: (name, "S")})
    with pytest.raises(InstrumentError, match=rf"not simulated runs on this computer: {name} \(4711\)"):
        LinuxCNCProcess({}, BRIDGE, wait=0.2)
    assert theirs.exists()


def test_the_ini_file_contains_the_travel_in_its_unit() -> None:
    travel = {"X": (-0.254, 0.254), "Y": (0.0, 0.0254), "Z": (0.0, 1.0)}
    in_mm = ini_text("m", travel, 0.0254, 9000.0, arguments="--port 0")
    in_inch = ini_text("m", travel, 0.0254, 9000.0, arguments="--port 0", inch=True)
    assert "LINEAR_UNITS = mm" in in_mm
    assert "MAX_LIMIT = 254.001000\nMAX_VELOCITY = 25.400000" in in_mm
    assert "LINEAR_UNITS = inch" in in_inch
    assert "MAX_LIMIT = 10.000039\nMAX_VELOCITY = 1.000000" in in_inch


def test_any_of_the_balls_trips_the_probe() -> None:
    text = hal_text(3)
    assert "net ball0:any => ball1.any.in1" in text
    assert "net ball1:any => ball2.any.in1" in text
    assert text.endswith("net ball2:any => motion.probe-input\n")
    assert pin_values(1, (0.1, 0.2, 0.3), 0.0155) == {
        "ball1.x.offset": -100.0,
        "ball1.y.offset": -200.0,
        "ball1.z.offset": -300.0,
        "ball1.trip.in1": 15.5,
    }
