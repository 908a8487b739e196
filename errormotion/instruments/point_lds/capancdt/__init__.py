"""Micro-Epsilon capaNCDT 6200 over Ethernet."""

from errormotion.instruments.point_lds.capancdt.driver import CapaNCDT
from errormotion.instruments.point_lds.capancdt.settings import CapaSettings

__all__ = ["CapaNCDT", "CapaSettings"]
