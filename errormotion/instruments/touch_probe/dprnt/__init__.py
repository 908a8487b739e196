"""Contacts as lines of text that a machine's own probing program prints."""

from errormotion.instruments.touch_probe.dprnt.driver import Dprnt
from errormotion.instruments.touch_probe.dprnt.settings import DprntSettings

__all__ = ["Dprnt", "DprntSettings"]
