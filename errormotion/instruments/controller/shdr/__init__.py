"""Machines with an SHDR adapter, the text protocol between machines and MTConnect agents, read-only."""

from errormotion.instruments.controller.shdr.driver import Shdr
from errormotion.instruments.controller.shdr.settings import ShdrSettings

__all__ = ["Shdr", "ShdrSettings"]
