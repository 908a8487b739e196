"""Origin and direction of the beam of a point sensor, from its readings on planes while a stage moves it (Lu et al.).

``method`` is the plugin. In ``identification``, ``reading`` reads and checks the raw dataset, ``slopes`` fits the
gradient of the readings on each plane, ``direction`` estimates the most likely direction, ``compensation`` corrects the
inclination error, ``origin`` estimates the zero point, ``propagation`` propagates the uncertainties, and ``planes``
combines these parts.
"""

from errormotion.methods.beam_direction.method import BeamDirection
from errormotion.methods.beam_direction.settings import Settings

__all__ = ["BeamDirection", "Settings"]
