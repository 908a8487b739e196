"""Machines under LinuxCNC: the driver here, and the bridge that runs beside LinuxCNC."""

from pathlib import Path

from errormotion.instruments.controller.linuxcnc.driver import LinuxCNC
from errormotion.instruments.controller.linuxcnc.settings import LinuxCNCSettings

#: The program that is copied to the machine.
BRIDGE = Path(__file__).with_name("bridge.py")

__all__ = ["BRIDGE", "LinuxCNC", "LinuxCNCSettings"]
