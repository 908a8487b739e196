"""Leica total stations and industrial stations (TM30, TS30, TS60, TDRA6000, TPS1200) by GeoCOM."""

from errormotion.instruments.laser_tracker.leica_geocom.driver import LeicaGeoCom
from errormotion.instruments.laser_tracker.leica_geocom.settings import GeoComSettings

__all__ = ["GeoComSettings", "LeicaGeoCom"]
