"""Redrawing of the readings of a beam detection for the Monte Carlo method; that of a drift follows from its model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.methods.spindle_drift.identification.detection import segmented
from errormotion.methods.spindle_drift.settings import TrialSettings
from errormotion.plugins import Redraw, Redrawing, replaced

if TYPE_CHECKING:
    from errormotion.methods.spindle_drift.settings import Settings


def redrawing_of_beams(raw: xr.Dataset, settings: Settings, errors: xr.Dataset) -> Redrawing:
    """Return the readings of the stepped sphere; their noise is that of the residuals of each beam."""
    steps = segmented(raw, settings, []) if "scan" in raw.variables else raw
    steps = steps.load().assign(distance=steps["distance"].transpose("channel", "profile", "step"))
    sigma = errors["noise"].sel(beam=[str(name) for name in raw["channel"].values]).values[:, None, None]

    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        distance = raw.variables["distance"].values
        return replaced(raw, {"distance": distance + sigma * generator.normal(size=distance.shape)}), settings

    return Redrawing(steps, TrialSettings.of(settings), {"readings": Redraw(draw, own=True)})
