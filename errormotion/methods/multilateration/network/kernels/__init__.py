"""Compiled loops over the targets of a large network. `vectorised` has the same functions for small ones."""

from errormotion.methods.multilateration.network.kernels.examination import datum_sums, examine, residuals
from errormotion.methods.multilateration.network.kernels.general import reduce_targets, screen_targets, settle_targets
from errormotion.methods.multilateration.network.kernels.readings import copied, count, moments, moved, weigh

__all__ = [
    "copied",
    "count",
    "datum_sums",
    "examine",
    "moments",
    "moved",
    "reduce_targets",
    "residuals",
    "screen_targets",
    "settle_targets",
    "weigh",
]
