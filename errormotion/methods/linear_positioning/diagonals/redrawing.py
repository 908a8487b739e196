"""Draws of the sources of a test along diagonals for the Monte Carlo method."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.methods.linear_positioning.diagonals.identification import evaluate_diagonals, shared_sources
from errormotion.methods.linear_positioning.identification import budget
from errormotion.methods.linear_positioning.identification.reading import labels
from errormotion.methods.linear_positioning.schema import APPROACHES, STOPS
from errormotion.methods.linear_positioning.settings import TrialSettings
from errormotion.plugins import Redraw, Redrawing, replaced

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.arrays import Array
    from errormotion.methods.linear_positioning.settings import Settings


def redraw_diagonals(raw: xr.Dataset, settings: Settings) -> Redrawing:
    """Return the readings, and the draws of their sources: scatter, drift, scale, alignment."""
    diagonals = evaluate_diagonals(raw, settings, [])
    _, groups, effects = shared_sources(diagonals)
    size = np.array([each.evaluated.scatter_of_means()[0] for each in diagonals])  # (diagonal, approach, stop)

    def readings(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        return _changed(raw, size * generator.normal(size=size.shape)), settings

    def shared(group: str) -> Redraw:
        chosen = np.nan_to_num(effects[[each == group for each in groups]])

        def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
            return _changed(raw, draw_effects(chosen, group, generator)), settings

        return Redraw(draw, groups=(group,))

    sources = {"readings": Redraw(readings, own=True)} | {group: shared(group) for group in dict.fromkeys(groups)}
    return Redrawing(ordered(raw, "diagonal_deviation", STOPS), of_trial(settings), sources)


def of_trial(settings: Settings) -> TrialSettings:
    """Return the settings of a trial."""
    return TrialSettings(**{name: getattr(settings, name) for name in type(settings).model_fields})


def ordered(raw: xr.Dataset, name: str, dims: tuple[str, ...]) -> xr.Dataset:
    """Return raw data in memory, with the dimensions of one variable in this order."""
    return raw.load().assign({name: raw.variables[name].transpose(*dims)})


def draw_effects(effects: Array, group: str, generator: np.random.Generator) -> Array:
    """Return a draw of the sources (source, item, target) of a group, (item, 1, target).

    The cosine error of the alignment has an exponential distribution, every other source a normal one.
    """
    exponential, number = group == budget.ALIGNMENT, len(effects)
    z = generator.exponential(size=number) - 1.0 if exponential else generator.normal(size=number)
    return np.asarray(np.tensordot(z, effects, axes=1)[:, None, :])


def _changed(raw: xr.Dataset, change: Array) -> xr.Dataset:
    """Add a change (diagonal, approach, stop), approaches forward and backward, to the readings of all runs."""
    shape = (change.shape[0], len(APPROACHES), change.shape[2])
    by_label = np.broadcast_to(change, shape)[:, [APPROACHES.index(label) for label in labels(raw, "approach")]]
    return replaced(raw, {"diagonal_deviation": raw.variables["diagonal_deviation"].values + by_label[:, None]})
