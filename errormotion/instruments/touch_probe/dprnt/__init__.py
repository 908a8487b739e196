"""Contacts that a probing program of the machine prints as lines of text."""

from errormotion.instruments.touch_probe.dprnt.driver import Dprnt
from errormotion.instruments.touch_probe.dprnt.settings import DprntSettings

__all__ = ["Dprnt", "DprntSettings"]
