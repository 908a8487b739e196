"""Multilateration: volumetric errors from displacements of a reflector, measured from four or more stations.

``method`` is the plugin. ``model`` states the equation, its unknowns and its sources, from which identification, plan,
random draws and simulated data follow (`errormotion.measurement`). ``result`` reads raw data into the model and adds
what follows from its solution, with ``start`` (approximate stations), ``determinacy`` (undetermined freedoms),
``scale`` (air, expansion), ``drift``, ``repeatability`` and ``axes``. ``acquisition`` measures, ``planning`` searches
the best layout, ``report`` and ``figures`` present a result, ``networks`` solves arrays without raw data.

Source: Takeuchi et al., estimation of three-dimensional volumetric errors of numerically controlled machine tools by a
laser tracker.
"""

from errormotion.methods.multilateration.method import Multilateration
from errormotion.methods.multilateration.settings import MultilaterationSettings

__all__ = ["Multilateration", "MultilaterationSettings"]
