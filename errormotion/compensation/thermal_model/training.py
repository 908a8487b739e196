"""The rows and columns of the regression: features of all campaigns, errors with their weights, groups of rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.compensation.thermal_model.features import Feature, matrix
from errormotion.compensation.thermal_model.record import Record

BLOCKS = 4
"""Number of blocks of a single campaign for cross-validation."""


class Columns:
    """Features of all campaigns, each computed once.

    Parameters
    ----------
    records : sequence of Record
    """

    def __init__(self, records: Sequence[Record]) -> None:
        self.records = records
        self._known: dict[Feature, Array] = {}

    def of(self, features: Sequence[Feature]) -> tuple[Array, Array]:
        """Return the features divided by their root mean square, (n, feature), and this, (feature,)."""
        for feature in features:
            if feature not in self._known:
                self._known[feature] = np.vstack([matrix(r.inputs, [feature]) for r in self.records])[:, 0]
        X = np.column_stack([self._known[feature] for feature in features])
        scale = np.sqrt(np.nanmean(X**2, axis=0))
        scale[~(scale > 0)] = 1.0
        return X / scale, scale


def groups(records: Sequence[Record]) -> NDArray[np.int64]:
    """Return the number of the campaign of each row; a single campaign is divided into blocks in time."""
    if len(records) > 1:
        return np.repeat(np.arange(len(records)), [record.inputs.time.size for record in records])
    n = records[0].inputs.time.size
    return np.arange(n) * BLOCKS // n


def target(records: Sequence[Record], freedom: int) -> tuple[Array, Array]:
    """Return one error of all campaigns and its weights, mean 1, 0 where the error is unknown."""
    y = np.concatenate([record.errors[:, freedom] for record in records])
    variance = np.concatenate([record.variance[:, freedom] for record in records])
    good = np.isfinite(y) & np.isfinite(variance)
    if not good.any():
        return y, np.zeros(y.size)
    floor = np.median(variance[good & (variance > 0)]) if (variance[good] > 0).any() else 1.0
    # The reference state has no variance: its weight is limited.
    weight = np.where(good, 1 / np.maximum(variance, floor), 0.0)
    return y, weight / weight[good].mean()
