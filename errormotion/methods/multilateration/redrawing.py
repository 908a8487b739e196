"""Sources of tracker readings for the Monte Carlo method: draws of the equation that the identification solves.

A trial is a fit of readings drawn about those measured, with drift and known values drawn about theirs. Corrections,
outliers and the size of the noise are those of the identification.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.measurement.drawing import READINGS, independent_draws, moved, standard_draw
from errormotion.methods.multilateration.identification.identify import estimated
from errormotion.methods.multilateration.identification.uncertainty import REPEATABILITY, UNEXPLAINED
from errormotion.methods.multilateration.network.model import DRIFT, STATIONS
from errormotion.methods.multilateration.network.solver import fitted_again
from errormotion.plugins import Redraw, Redrawing, replaced

if TYPE_CHECKING:
    from errormotion.arrays import Array
    from errormotion.methods.multilateration.settings import Settings
    from errormotion.plugins.redrawing import Act, Draw

XYZ = ("EX", "EY", "EZ")


def redrawing(raw: xr.Dataset, settings: Settings, errors: xr.Dataset) -> Redrawing:
    """Return the readings without outliers, and their sources: noise and repeatability, drift, scales, expansion."""
    state = estimated(raw, settings)
    network, problem = state.network, state.network.fit.problem
    sd = state.factor * np.asarray(problem.noise.sd)
    sources = {
        READINGS: Redraw(_noise(sd), groups=(STATIONS, REPEATABILITY, UNEXPLAINED), own=True),
        **{name: Redraw(standard_draw(name, n), groups=(name,)) for name, n in independent_draws(problem).items()},
    }
    if state.settings.together and state.machine.variance > 0:
        sources[REPEATABILITY] = Redraw(act=_positions(state.machine.value), own=True)

    def trial(data: xr.Dataset, _: Settings) -> xr.Dataset:
        drawn = {name: np.asarray(data[name].values) for name in independent_draws(problem) if name in data}
        if DRIFT in drawn:  # it follows from readings, whose noise is larger by this factor
            drawn[DRIFT] = drawn[DRIFT] * state.factor
        found = fitted_again(network, moved(problem, data[READINGS].values, drawn))
        return replaced(errors, dict(zip(XYZ, (found - network.nominal).T, strict=True)))

    return Redrawing(xr.Dataset({READINGS: ("reading", problem.readings)}), settings, sources, identify=trial)


def _noise(sd: Array) -> Draw:
    """Return the noise of the readings, which includes repeatability of separate set-ups."""

    def draw(data: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        return data.assign({READINGS: data[READINGS] + sd * generator.standard_normal(sd.shape)}), settings

    return draw


def _positions(repeatability: float) -> Act:
    """Return the repeatability of positions that all stations read at the same time."""

    def act(errors: xr.Dataset, generator: np.random.Generator) -> xr.Dataset:
        shift = repeatability * generator.standard_normal((3, errors.sizes["target"]))
        return replaced(errors, {name: errors[name].values + each for name, each in zip(XYZ, shift, strict=True)})

    return act
