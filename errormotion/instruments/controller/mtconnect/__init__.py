"""Machines with an MTConnect agent, read-only."""

from errormotion.instruments.controller.mtconnect.driver import MTConnect
from errormotion.instruments.controller.mtconnect.settings import MTConnectSettings

__all__ = ["MTConnect", "MTConnectSettings"]
