"""Keyence LJ-X8000A line profilers over Ethernet."""

from errormotion.instruments.line_profiler.keyence_ljx.driver import KeyenceLJX
from errormotion.instruments.line_profiler.keyence_ljx.settings import LJXSettings

__all__ = ["KeyenceLJX", "LJXSettings"]
