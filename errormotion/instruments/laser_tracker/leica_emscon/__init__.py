"""Leica laser trackers with an emScon server: LT and AT901 series, AT4xx."""

from errormotion.instruments.laser_tracker.leica_emscon.driver import Event, LeicaEmScon
from errormotion.instruments.laser_tracker.leica_emscon.settings import EmSconSettings

__all__ = ["EmSconSettings", "Event", "LeicaEmScon"]
