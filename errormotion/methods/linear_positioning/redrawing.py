"""Sources of a test, drawn anew for the Monte Carlo method.

Every source changes the readings by what it changes in their means. The cosine error of the alignment is drawn from its
exponential distribution, all others are normal.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.methods.linear_positioning.diagonals.redrawing import redraw_diagonals
from errormotion.methods.linear_positioning.identification import budget, moving
from errormotion.methods.linear_positioning.identification.identify import Evaluated, evaluate
from errormotion.methods.linear_positioning.schema import APPROACHES
from errormotion.plugins import Redraw, Redrawing

if TYPE_CHECKING:
    from collections.abc import Callable

    import xarray as xr

    from errormotion.arrays import Array
    from errormotion.methods.linear_positioning.settings import Settings

FEWEST_TRIALS = 200
"""Of the figures in a trial, whose values are not used."""


def redrawing(raw: xr.Dataset, settings: Settings, errors: xr.Dataset) -> Redrawing:
    """Return the readings, and their sources: scatter, drift, instrument, alignment, expansion."""
    if "end_deviation" in raw:
        return _moving(raw, settings, errors)
    if "diagonal_deviation" in raw:
        return redraw_diagonals(raw, settings)
    found = evaluate(raw, settings, [])
    groups = dict.fromkeys(source.group for source in found.sources if source.group != budget.END)
    sources = {"readings": Redraw(_readings(found), groups=(budget.END,), own=True)}
    sources |= {group: Redraw(_shared(found, group), groups=(group,)) for group in groups}
    return Redrawing(raw.load(), settings.model_copy(update={"trials": FEWEST_TRIALS}), sources)


def _moving(raw: xr.Dataset, settings: Settings, errors: xr.Dataset) -> Redrawing:
    """Return the readings of a moving axis, and their sources: noise, cold reference, lengths."""
    dims = ("freedom", "cycle", "end")
    cold = raw["reading_time"].values <= 0.0
    shape = tuple(raw.sizes[dim] for dim in dims)
    noise = np.broadcast_to(errors["reading_noise"].values[:, None, None], shape)
    along = np.array([str(name)[1] == str(name)[2] for name in errors["freedom"].values])[:, None, None]
    P = raw["end_position"].values
    lever = np.broadcast_to(along * (P - P.min()), shape)
    relative = float(raw["length_uncertainty"]) if "length_uncertainty" in raw else settings.uncertainty.length
    reference = (
        noise[:, :1] / np.sqrt(np.isfinite(raw["end_deviation"].transpose(*dims).values[:, cold]).sum(axis=1))[:, None]
    )

    def changed(raw: xr.Dataset, change: Array) -> xr.Dataset:
        deviation = raw["end_deviation"].transpose(*dims)
        return raw.assign(end_deviation=deviation.copy(data=deviation.values + change))

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
    return Redrawing(raw.load(), settings, sources)


def _readings(found: Evaluated) -> _Draw:
    """Return a draw of what is new at each target: scatter by approach, and the instrument at the target."""
    readings = found.readings
    size = np.array(
        [
            np.sqrt(spread.own_factor * spread.own / np.maximum(np.isfinite(x).sum(axis=1), 1))
            for x, spread in zip(readings.x, found.spreads, strict=True)
        ]
    )  # (freedom, approach, target)

    def change(generator: np.random.Generator) -> Array:
        common = found.at_target[:, None, None] * generator.normal(size=(len(size), 1, size.shape[-1]))
        return np.asarray(size * generator.normal(size=size.shape) + common)

    return _Draw(found, change)


def _shared(found: Evaluated, group: str) -> _Draw:
    """Return a draw of the sources of one group."""
    effects = np.nan_to_num([source.effect for source in found.sources if source.group == group])

    def change(generator: np.random.Generator) -> Array:
        number = len(effects)
        exponential = group == budget.ALIGNMENT
        z = generator.exponential(size=number) - 1.0 if exponential else generator.normal(size=number)
        return np.tensordot(z, effects, axes=1)[:, None, :]

    return _Draw(found, change)


class _Draw:
    """Adds a change (freedom, approach, target) to the readings of all runs, in the order of the raw dataset."""

    def __init__(self, found: Evaluated, change: Callable[[np.random.Generator], Array]) -> None:
        self._found, self._change = found, change

    def __call__(
        self, raw: xr.Dataset, settings: Settings, generator: np.random.Generator
    ) -> tuple[xr.Dataset, Settings]:
        """Return changed readings, and the settings as they are."""
        change = np.broadcast_to(self._change(generator), self._shape)
        approaches = [APPROACHES.index(_text(label)) for label in raw["approach"].values]
        rank = np.argsort(np.argsort(raw["target_position"].values))
        by_label = np.nan_to_num(change)[:, approaches][..., rank]
        deviation = raw["deviation"].transpose("freedom", "approach", "run", "target")
        return raw.assign(deviation=deviation.copy(data=deviation.values + by_label[:, :, None, :])), settings

    @property
    def _shape(self) -> tuple[int, int, int]:
        count, approaches, _, targets = self._found.readings.x.shape
        return count, approaches, targets


def _text(label: object) -> str:
    return label.decode() if isinstance(label, bytes) else str(label)
