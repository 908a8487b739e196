"""Trial model of a beam detection for the Monte Carlo method; that of a drift follows from its model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.methods.spindle_drift.identification.beams import RADIUS_OF_SPHERE, SCALES
from errormotion.methods.spindle_drift.identification.detection import segmented
from errormotion.methods.spindle_drift.settings import TrialSettings
from errormotion.plugins import RandomSource, TrialModel, replaced

if TYPE_CHECKING:
    from errormotion.methods.spindle_drift.settings import SpindleDriftSettings


def trial_model_of_beams(raw: xr.Dataset, settings: SpindleDriftSettings, errors: xr.Dataset) -> TrialModel:
    """Return the readings of the stepped sphere, with the noise of each beam's residuals; radius; and scales."""
    steps = segmented(raw, settings, []) if "scan" in raw.variables else raw
    steps = steps.load().assign(distance=steps["distance"].transpose("channel", "profile", "step"))
    sigma = errors["noise"].sel(beam=[str(name) for name in raw["channel"].values]).values[:, None, None]

    def draw(
        raw: xr.Dataset, settings: SpindleDriftSettings, generator: np.random.Generator
    ) -> tuple[xr.Dataset, SpindleDriftSettings]:
        distance = raw.variables["distance"].values
        return replaced(raw, {"distance": distance + sigma * generator.normal(size=distance.shape)}), settings

    def radius(
        raw: xr.Dataset, settings: SpindleDriftSettings, generator: np.random.Generator
    ) -> tuple[xr.Dataset, SpindleDriftSettings]:
        drawn = raw["sphere_radius"].values + raw["sphere_radius_uncertainty"].values * generator.normal()
        return replaced(raw, {"sphere_radius": drawn}), settings

    def scales(
        raw: xr.Dataset, settings: SpindleDriftSettings, generator: np.random.Generator
    ) -> tuple[xr.Dataset, SpindleDriftSettings]:
        centre = raw.variables["sphere_centre"].transpose("channel", "profile", "step", "direction")
        middle = np.nanmean(centre.values, axis=(0, 1, 2))
        factor = 1 + raw["position_scale_uncertainty"].values * generator.normal(size=3)
        drawn = centre.copy(data=middle + (centre.values - middle) * factor)
        return raw.assign(sphere_centre=drawn), settings

    sources = {"readings": RandomSource(draw, own=True)}
    if float(steps.get("sphere_radius_uncertainty", 0.0)) > 0:
        sources[RADIUS_OF_SPHERE] = RandomSource(radius, groups=(RADIUS_OF_SPHERE,))
    if float(steps.get("position_scale_uncertainty", 0.0)) > 0:
        sources[SCALES] = RandomSource(scales, groups=(SCALES,))
    return TrialModel(steps, TrialSettings.of(settings), sources)
