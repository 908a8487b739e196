"""Circular test according to ISO 230-4: the radial deviation of a circular path, by a telescoping ballbar.

``method`` is the plugin with its measurement model, ``circles`` reads a test and averages it by sectors, ``path`` is
the effect of the errors of two axes on a circle, and ``figures`` computes the figures of the standard.
"""

from errormotion.methods.circular_test.method import CircularTest
from errormotion.methods.circular_test.settings import CircularTestSettings

__all__ = ["CircularTest", "CircularTestSettings"]
