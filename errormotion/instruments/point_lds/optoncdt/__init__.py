"""Micro-Epsilon optoNCDT 1420 and 2300 over RS422 or TCP."""

from errormotion.instruments.point_lds.optoncdt.driver import OptoNCDT
from errormotion.instruments.point_lds.optoncdt.settings import OptoSettings

__all__ = ["OptoNCDT", "OptoSettings"]
