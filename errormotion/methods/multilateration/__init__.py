"""Multilateration: volumetric errors from displacements of a reflector, measured from four or more stations.

``method`` is the plugin. ``acquisition`` measures, ``identification`` determines errors from raw data, ``planning``
predicts the uncertainty of a layout, ``report`` and ``figures`` present a result, ``simulation`` makes raw data with
known errors.

``network`` solves for targets and stations: ``model`` (the equation and its sources, for `errormotion.estimation`),
``start`` (approximate stations), ``solver`` (fit, datum, outliers), ``network`` (result and covariances), and
``diagnosis`` (outliers, undetermined freedoms). Source: Takeuchi et al., estimation of three-dimensional volumetric
errors of numerically controlled machine tools by a laser tracker.
"""

from errormotion.methods.multilateration.method import Multilateration
from errormotion.methods.multilateration.settings import Settings

__all__ = ["Multilateration", "Settings"]
