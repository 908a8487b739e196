"""Keyence LK-G and LK-H over RS-232C."""

from errormotion.instruments.point_lds.keyence_lk.driver import KeyenceLK
from errormotion.instruments.point_lds.keyence_lk.settings import LKSettings

__all__ = ["KeyenceLK", "LKSettings"]
