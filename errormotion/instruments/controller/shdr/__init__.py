"""Machines with an SHDR adapter, the plain text behind MTConnect agents, read-only."""

from errormotion.instruments.controller.shdr.driver import Shdr
from errormotion.instruments.controller.shdr.settings import ShdrSettings

__all__ = ["Shdr", "ShdrSettings"]
