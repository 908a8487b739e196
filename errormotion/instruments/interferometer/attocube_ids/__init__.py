"""attocube IDS3010: a fibre interferometer with three beams, by JSON-RPC over TCP."""

from errormotion.instruments.interferometer.attocube_ids.driver import AttocubeIds
from errormotion.instruments.interferometer.attocube_ids.settings import IdsSettings

__all__ = ["AttocubeIds", "IdsSettings"]
