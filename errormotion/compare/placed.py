"""Errors of one dataset as arrays, and their transfer to a common grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from errormotion.arrays import Array, filled, products
from errormotion.compare.stack import Estimate
from errormotion.datasets.results.interpolation import interpolated
from errormotion.datasets.results.reduction import changes, influence_of
from errormotion.kinematics.iso import DOF


@dataclass(frozen=True)
class Placed:
    """Errors of one dataset at n points as arrays: values (n, 6), covariance (n, 6, 6), influence (source, n, 6)."""

    value: Array
    total: Array
    influence: Array
    source: list[str]
    identity: list[str]

    @classmethod
    def of(cls, ds: xr.Dataset) -> Placed:
        """Read a dataset with one dimension or none."""
        value = np.stack([np.asarray(ds[name].values, dtype=float) for name in DOF], axis=-1).reshape(-1, 6)
        F = influence_of(ds)
        source = [str(each) for each in ds["source"].values.tolist()] if len(F) else []
        identity = ds["source_id"].values.tolist() if len(F) and "source_id" in ds.coords else [""] * len(F)
        total = np.asarray(ds["covariance"].values, dtype=float).reshape(-1, 6, 6)
        return cls(value, total, F.reshape(len(F), len(value), 6), source, [str(each) for each in identity])

    @property
    def seen(self) -> list[str]:
        """Freedoms with known values."""
        return [name for name, values in zip(DOF, self.value.T, strict=True) if np.isfinite(values).any()]

    @property
    def turns(self) -> Array:
        """Rotations (n, 3), 0 where unknown."""
        return filled(self.value[:, 3:])

    def at_times(self, time: Array, grid: Array) -> Placed:
        """Return the errors at other times."""
        E, C, F, _ = interpolated(
            np.asarray(time, dtype=float), self.value, self.total, self.influence, grid, starting=True
        )
        return replace(self, value=E, total=C, influence=F)

    def since_first(self) -> Placed:
        """Return the changes since the first point."""
        E, C, F, further = changes(self.value, self.total, self.influence, np.arange(len(self.value)) == 0)
        return Placed(E, C, F, [*self.source, *further], [*self.identity, *[""] * len(further)])

    def estimate(self, name: str, freedoms: Sequence[str]) -> Estimate:
        """Return freedoms as an estimate; sources without an identity are specific to this dataset."""
        k = [DOF.index(freedom) for freedom in freedoms]
        F = self.influence[..., k]
        own = self.total[:, k][:, :, k] - products(F)
        keys = (identity or f"{name}: {source}" for identity, source in zip(self.identity, self.source, strict=True))
        return Estimate(name, self.value[:, k], own, F, tuple(keys))
