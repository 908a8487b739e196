"""Machines that an MTConnect agent tells of, read-only."""

from errormotion.instruments.controller.mtconnect.driver import MTConnect
from errormotion.instruments.controller.mtconnect.settings import MTConnectSettings

__all__ = ["MTConnect", "MTConnectSettings"]
