"""Machines under LinuxCNC: the driver, and the bridge that runs on the computer of LinuxCNC."""

from pathlib import Path

from errormotion.instruments.controller.linuxcnc.driver import LinuxCNC
from errormotion.instruments.controller.linuxcnc.settings import LinuxCNCSettings

#: The program that is copied to the machine.
BRIDGE = Path(__file__).with_name("bridge.py")

#: The realtime part of a compensation, loaded by LinuxCNC.
COMPENSATION = Path(__file__).with_name("compensation.tcl")

__all__ = ["BRIDGE", "COMPENSATION", "LinuxCNC", "LinuxCNCSettings"]
