"""Errors of one dataset as arrays, and their transfer to a common grid."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr

from errormotion.arrays import Array, filled, products
from errormotion.compare.stack import Estimate
from errormotion.datasets.results.interpolation import interpolated
from errormotion.datasets.results.reduction import changes, influence_of
from errormotion.kinematics.iso import DOF
from errormotion.kinematics.twists import adjoint


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

    def times(self, A: Array) -> Placed:
        """Return the errors multiplied by matrices (6, 6) or (n, 6, 6).

        An unknown rotation counts as 0 where it acts by a lever, and makes a freedom unknown where it replaces it.
        """
        T = np.broadcast_to(A, (len(self.value), 6, 6))
        block = (T != 0).astype(float)
        block[:, :3, 3:] = block[:, 3:, :3] = 0.0
        gone = np.matmul(block, np.isnan(self.value)[..., None].astype(float))[..., 0] > 0
        value = np.where(gone, np.nan, np.matmul(T, filled(self.value)[..., None])[..., 0])
        total = np.matmul(np.matmul(T, filled(self.total)), np.swapaxes(T, 1, 2))
        total[gone[:, :, None] | gone[:, None, :]] = np.nan
        influence = np.matmul(T, filled(self.influence)[..., None])[..., 0]
        influence[:, gone] = np.nan
        return replace(self, value=value, total=total, influence=influence)

    def estimate(self, name: str, freedoms: Sequence[str]) -> Estimate:
        """Return freedoms as an estimate; sources without an identity are specific to this dataset."""
        k = [DOF.index(freedom) for freedom in freedoms]
        F = self.influence[..., k]
        own = self.total[:, k][:, :, k] - products(F)
        keys = (identity or f"{name}: {source}" for identity, source in zip(self.identity, self.source, strict=True))
        return Estimate(name, self.value[:, k], own, F, tuple(keys))


def _unchanged(placed: Placed) -> Placed:
    return placed


@dataclass(frozen=True)
class Stored:
    """The errors of one dataset on the common grid, as a function of the errors that it states.

    A mistake in a dataset changes the errors at its own functional point; ``shift`` leads from there to the common one.

    Attributes
    ----------
    placed : Placed
        At the common functional point.
    shift : ndarray, (3,)
        From the functional point of the dataset to the common one, m.
    finish : callable
        Linear steps after the change of the functional point, such as the removal of a reference line.
    levers : dict of str to ndarray (n, 3)
        Of a linear axis: where else its straightness may have been read, and the shift from there, m.
    line : callable
        Removal of the reference line of a straightness, which is contained in ``finish`` or needed with ``levers``.
    """

    placed: Placed
    shift: Array
    finish: Callable[[Placed], Placed] = _unchanged
    levers: dict[str, Array] = field(default_factory=dict)
    line: Callable[[Placed], Placed] = _unchanged

    def changed(self, A: Array) -> Placed:
        """Return the errors on common ground if the stated ones are multiplied by matrices (6, 6) or (n, 6, 6)."""
        return self.finish(self.placed.times(self.transfer @ A @ adjoint(shift=-self.shift)))

    @property
    def transfer(self) -> Array:
        """Matrix (6, 6) from the functional point of the dataset to the common one."""
        return adjoint(shift=self.shift)
