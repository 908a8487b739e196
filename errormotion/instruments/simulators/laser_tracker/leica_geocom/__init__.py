"""A total station with GeoCOM beside the virtual machine."""

from errormotion.instruments.simulators.laser_tracker.leica_geocom.device import SimulatedGeoComStation

__all__ = ["SimulatedGeoComStation"]
