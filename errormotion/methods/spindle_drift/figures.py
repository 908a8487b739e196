"""Figures of merit: the errors at the end of a drift and its ISO 230-3 ranges, or the errors of the detected beams."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.datasets.results.merit import beam_errors, is_planned, last_values
from errormotion.plugins import FigureOfMerit

if TYPE_CHECKING:
    import xarray as xr

_RANGES = {
    "range_60min": "within the first 60 min",
    "range_running": "to the end of running",
    "range_total": "over the whole record",
}
"""Measures of ``iso_value``, in the order of preference."""


def figures(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return the figures of a drift or of a beam detection; none for a plan.

    The ISO 230-3 range of each quantity is that of the first 60 min; for a shorter record, the range to the end of
    running, else that over the whole record.
    """
    if is_planned(errors):
        return []
    return [*beam_errors(errors), *last_values(errors), *_ranges(errors)]


def _ranges(errors: xr.Dataset) -> list[FigureOfMerit]:
    if "iso_value" not in errors:
        return []
    value, uncertainty = errors["iso_value"], errors["iso_uncertainty"]
    ranges = []
    for quantity in value["quantity"].values:
        unit = "rad" if quantity in ("A", "B") else "m"
        for measure, interval in _RANGES.items():
            size = float(value.sel(quantity=quantity, measure=measure))
            if np.isfinite(size):
                u = float(uncertainty.sel(quantity=quantity, measure=measure))
                name = f"d({quantity}) {interval}, range (ISO 230-3)"
                effects = _effects(errors, quantity, measure)
                ranges.append(FigureOfMerit(name, size, 2.0 * u, unit, influence=effects))
                break
    return ranges


def _effects(errors: xr.Dataset, quantity: str, measure: str) -> dict[str, float] | None:
    """Return the effect of each source on an ISO 230-3 value; None for a dataset that does not state it."""
    if "iso_influence" not in errors:
        return None
    effects = errors["iso_influence"].sel(quantity=quantity, measure=measure).values
    return dict(zip(map(str, errors["source"].values), map(float, effects), strict=True))
