"""Spindle drift by five distance sensors (ISO 230-3): beam detection, drift, ISO 230-3 values.

``method`` is the plugin. ``acquisition`` measures. In ``identification``, ``segmentation`` divides a stepped scan into
rests, ``beams`` fits origin and direction of a beam, and ``detection`` returns them as a dataset; ``averaging``
averages a record, ``bar`` fits the bar, ``uncertainty`` propagates the uncertainties, ``drift`` combines these parts,
and ``iso230_3`` evaluates the values of ISO 230-3. Source: Geiselhart et al. (euspen 2024).
"""

from errormotion.methods.spindle_drift.method import SpindleDrift
from errormotion.methods.spindle_drift.settings import Event, SpindleDriftSettings

__all__ = ["Event", "SpindleDrift", "SpindleDriftSettings"]
