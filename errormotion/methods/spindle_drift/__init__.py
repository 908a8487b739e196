"""Spindle drift by five distance sensors (ISO 230-3): beam detection, drift, ISO 230-3 values.

``method`` is the plugin. Beneath it, from the wire up: ``acquisition`` measures; ``segmentation`` cuts a stepped scan;
``beams`` finds where a beam starts and goes, ``detection`` makes it a dataset; ``averaging`` brings a record down to
means, ``bar`` fits the bar, ``uncertainty`` carries what is unknown through, ``drift`` puts them together, and
``iso230_3`` states what a certificate states. Source: Geiselhart et al. (euspen 2024).
"""

from errormotion.methods.spindle_drift.method import SpindleDrift
from errormotion.methods.spindle_drift.settings import Event, Settings

__all__ = ["Event", "Settings", "SpindleDrift"]
