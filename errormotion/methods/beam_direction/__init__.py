"""Origin and direction of the beam of a point sensor, from its readings on planes while a stage moves it (Lu et al.).

``method`` is the plugin. In ``identification``, ``model`` is the equation with all sources of uncertainty, ``reading``
reads and checks the raw dataset, ``planes`` fits the gradient of the readings on each plane, ``direction`` selects one
of two possible directions, ``sensor`` is the calibration, and ``beam`` states from these what was observed.
"""

from errormotion.methods.beam_direction.method import BeamDirection
from errormotion.methods.beam_direction.settings import BeamDirectionSettings

__all__ = ["BeamDirection", "BeamDirectionSettings"]
