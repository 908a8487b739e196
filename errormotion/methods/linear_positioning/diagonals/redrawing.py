"""Sources of a test along diagonals, drawn anew for the Monte Carlo method; the alignment is drawn exponentially."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.methods.linear_positioning.diagonals.identification import measure, shared
from errormotion.methods.linear_positioning.identification import budget
from errormotion.methods.linear_positioning.schema import APPROACHES, STOPS
from errormotion.plugins import Redraw, Redrawing

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.arrays import Array
    from errormotion.methods.linear_positioning.settings import Settings

FEWEST_TRIALS = 200
"""Of the figures in a trial, whose values are not used."""


def redraw_diagonals(raw: xr.Dataset, settings: Settings) -> Redrawing:
    """Return the readings, and their sources: scatter, drift, scale, alignment."""
    measured = measure(raw, settings, [])
    _, groups, effects = shared(measured)
    size = np.array(
        [
            np.sqrt(of.own_factor * of.own / np.maximum(np.isfinite(x).sum(axis=1), 1))
            for x, of in ((each.found.readings.x[0], each.found.spreads[0]) for each in measured)
        ]
    )  # (diagonal, approach, stop)

    def readings(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        return _changed(raw, size * generator.normal(size=size.shape)), settings

    sources = {"readings": Redraw(readings, own=True)}
    for group in dict.fromkeys(groups):
        chosen = np.nan_to_num(effects[[each == group for each in groups]])
        sources[group] = Redraw(_Shared(chosen, exponential=group == budget.ALIGNMENT), groups=(group,))
    return Redrawing(raw.load(), settings.model_copy(update={"trials": FEWEST_TRIALS}), sources)


class _Shared:
    """Draws sources (source, diagonal, stop) that all runs and both approaches share."""

    def __init__(self, effects: Array, *, exponential: bool) -> None:
        self._effects, self._exponential = effects, exponential

    def __call__(
        self, raw: xr.Dataset, settings: Settings, generator: np.random.Generator
    ) -> tuple[xr.Dataset, Settings]:
        """Return changed readings, and the settings as they are."""
        number = len(self._effects)
        z = generator.exponential(size=number) - 1.0 if self._exponential else generator.normal(size=number)
        return _changed(raw, np.tensordot(z, self._effects, axes=1)[:, None, :]), settings


def _changed(raw: xr.Dataset, change: Array) -> xr.Dataset:
    """Add a change (diagonal, approach, stop), approaches forward and backward, to the readings of all runs."""
    labels = [str(label) for label in raw["approach"].values.astype(str)]
    shape = (change.shape[0], len(APPROACHES), change.shape[2])
    by_label = np.broadcast_to(change, shape)[:, [APPROACHES.index(label) for label in labels]]
    deviation = raw["diagonal_deviation"].transpose(*STOPS)
    return raw.assign(diagonal_deviation=deviation.copy(data=deviation.values + by_label[:, None]))
