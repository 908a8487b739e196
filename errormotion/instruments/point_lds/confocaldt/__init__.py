"""Micro-Epsilon confocalDT IFC2451, IFC2461 and IFC2471 over Ethernet."""

from errormotion.instruments.point_lds.confocaldt.driver import ConfocalDT
from errormotion.instruments.point_lds.confocaldt.settings import ConfocalSettings

__all__ = ["ConfocalDT", "ConfocalSettings"]
