"""Positioning, straightness and angles of one linear axis at target positions (ISO 230-2, ISO 230-1).

In ``identification``, ``model`` states the measurement model of readings along lines, of an axis and of diagonals, with
all sources of uncertainty; ``reading`` reads and checks the raw dataset, ``expansion`` states what expands, ``scatter``
estimates the variation of the readings from run to run, ``standard`` contains the formulas of ISO 230-2, ``extremes``
the bias and uncertainty of figures that are extreme values, and ``identify`` states the errors and figures of an axis;
``moving`` is the test of a moving axis. ``method`` is the plugin.
"""

from errormotion.methods.linear_positioning.method import LinearPositioning
from errormotion.methods.linear_positioning.settings import LinearPositioningSettings

__all__ = ["LinearPositioning", "LinearPositioningSettings"]
