"""Positioning, straightness and angles of one linear axis at target positions (ISO 230-2, ISO 230-1).

``method`` is the plugin. In ``identification``, ``reading`` reads and checks the raw dataset, ``expansion`` corrects it
for temperatures, ``standard`` contains the formulas of ISO 230-2, ``scatter`` estimates the variation of the readings
from run to run, ``extremes`` the bias and uncertainty of figures that are extreme values, ``budget`` the sources of
uncertainty, and ``identify`` combines these parts.
"""

from errormotion.methods.linear_positioning.method import LinearPositioning
from errormotion.methods.linear_positioning.settings import Settings

__all__ = ["LinearPositioning", "Settings"]
