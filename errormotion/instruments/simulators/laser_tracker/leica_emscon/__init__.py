"""An emScon server with a tracker beside the virtual machine."""

from errormotion.instruments.simulators.laser_tracker.leica_emscon.device import SimulatedEmScon

__all__ = ["SimulatedEmScon"]
