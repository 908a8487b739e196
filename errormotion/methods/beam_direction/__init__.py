"""Where a point sensor's beam starts and where it goes, from planes that a stage moves it over (Lu et al.).

``method`` is the plugin. From readings to result: ``reading`` takes them out of the raw dataset, ``slopes`` finds how
they change with the stage's place on each plane, ``direction`` the direction most likely from that, ``compensation``
takes the inclination error off, ``origin`` finds the zero point, ``propagation`` carries what is unknown through, and
``identification`` puts them together.
"""

from errormotion.methods.beam_direction.method import BeamDirection
from errormotion.methods.beam_direction.settings import Settings

__all__ = ["BeamDirection", "Settings"]
