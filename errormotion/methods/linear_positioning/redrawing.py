"""Draws of the sources of a test for the Monte Carlo method.

Each source changes the readings by its effect on their means.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from errormotion.methods.linear_positioning.diagonals.redrawing import draw_effects, of_trial, ordered, redraw_diagonals
from errormotion.methods.linear_positioning.identification import budget, moving
from errormotion.methods.linear_positioning.identification.identify import Evaluated, evaluate
from errormotion.methods.linear_positioning.identification.reading import labels, length_uncertainty
from errormotion.methods.linear_positioning.schema import APPROACHES, READINGS
from errormotion.plugins import Redraw, Redrawing, replaced

if TYPE_CHECKING:
    from collections.abc import Callable

    import xarray as xr

    from errormotion.arrays import Array
    from errormotion.methods.linear_positioning.settings import Settings


def redrawing(raw: xr.Dataset, settings: Settings, errors: xr.Dataset) -> Redrawing:
    """Return the readings, and the draws of their sources: scatter, drift, instrument, alignment, expansion."""
    if "end_deviation" in raw:
        return _moving(raw, settings, errors)
    if "diagonal_deviation" in raw:
        return redraw_diagonals(raw, settings)
    evaluated = evaluate(raw, settings, [])
    groups = dict.fromkeys(source.group for source in evaluated.sources if source.group != budget.END)
    sources = {"readings": Redraw(_readings(evaluated), groups=(budget.END,), own=True)}
    sources |= {group: Redraw(_shared(evaluated, group), groups=(group,)) for group in groups}
    return Redrawing(ordered(raw, "deviation", READINGS), of_trial(settings), sources)


def _moving(raw: xr.Dataset, settings: Settings, errors: xr.Dataset) -> Redrawing:
    """Return the readings of a moving axis, and the draws of their sources: noise, cold reference, lengths."""
    dims = ("freedom", "cycle", "end")
    cold = raw["reading_time"].values <= 0.0
    shape = tuple(raw.sizes[dim] for dim in dims)
    noise = np.broadcast_to(errors["reading_noise"].values[:, None, None], shape)
    along = np.array([str(name)[1] == str(name)[2] for name in errors["freedom"].values])[:, None, None]
    P = raw["end_position"].values
    lever = np.broadcast_to(along * (P - P.min()), shape)
    relative = length_uncertainty(raw, settings)
    reference = (
        noise[:, :1] / np.sqrt(np.isfinite(raw["end_deviation"].transpose(*dims).values[:, cold]).sum(axis=1))[:, None]
    )

    def changed(raw: xr.Dataset, change: Array) -> xr.Dataset:
        return replaced(raw, {"end_deviation": raw.variables["end_deviation"].values + change})

    def readings(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        return changed(raw, noise * generator.normal(size=shape) * ~cold[:, None]), settings

    def cold_state(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        return changed(raw, reference * generator.normal(size=reference.shape) * cold[:, None]), settings

    def lengths(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        return changed(raw, relative * lever * generator.normal() * ~cold[:, None]), settings

    sources = {
        "readings": Redraw(readings, own=True),
        moving.COLD: Redraw(cold_state, groups=(moving.COLD,)),
        moving.LENGTH: Redraw(lengths, groups=(moving.LENGTH,)),
    }
    return Redrawing(ordered(raw, "end_deviation", dims), settings, sources)


def _readings(evaluated: Evaluated) -> _Draw:
    """Return a draw of the errors that are independent from target to target: scatter by approach, and instrument."""
    size = evaluated.scatter_of_means()

    def change(generator: np.random.Generator) -> Array:
        common = evaluated.at_target[:, None, None] * generator.normal(size=(len(size), 1, size.shape[-1]))
        return np.asarray(size * generator.normal(size=size.shape) + common)

    return _Draw(size.shape, change)


def _shared(evaluated: Evaluated, group: str) -> _Draw:
    """Return a draw of the sources of one group."""
    effects = np.nan_to_num([source.effect for source in evaluated.sources if source.group == group])
    count, approaches, _, targets = evaluated.readings.x.shape
    return _Draw((count, approaches, targets), partial(draw_effects, effects, group))


class _Draw:
    """Adds a change (freedom, approach, target) to the readings of all runs, in the order of the raw dataset."""

    def __init__(self, shape: tuple[int, ...], change: Callable[[np.random.Generator], Array]) -> None:
        self._shape, self._change = shape, change

    def __call__(
        self, raw: xr.Dataset, settings: Settings, generator: np.random.Generator
    ) -> tuple[xr.Dataset, Settings]:
        """Return changed readings, and the unchanged settings."""
        change = np.broadcast_to(self._change(generator), self._shape)
        approaches = [APPROACHES.index(label) for label in labels(raw, "approach")]
        rank = np.argsort(np.argsort(raw["target_position"].values))
        by_label = np.nan_to_num(change)[:, None, approaches][..., rank]
        return replaced(raw, {"deviation": raw.variables["deviation"].values + by_label}), settings
