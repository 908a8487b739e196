"""Errors of one dataset as arrays, and their transfer to a common grid."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import xarray as xr

from errormotion.arrays import Array, filled, products
from errormotion.compare.stack import Estimate
from errormotion.datasets.results.interpolation import interpolated
from errormotion.datasets.results.reduction import changes, influence_of
from errormotion.kinematics.iso import DOF
from errormotion.kinematics.twists import adjoint


@dataclass(frozen=True)
class PointErrors:
    """Errors of one dataset at n points as arrays: values (n, 6), own (n, 6, 6), influence (source, n, 6).

    ``own`` is the covariance of contributions that are independent between points, without the sources.
    """

    value: Array
    own: Array
    influence: Array
    source: list[str]
    identity: list[str]

    @classmethod
    def of(cls, ds: xr.Dataset) -> PointErrors:
        """Read a dataset with one dimension or none."""
        value = np.stack([np.asarray(ds[name].values, dtype=float) for name in DOF], axis=-1).reshape(-1, 6)
        F = influence_of(ds)
        source = [str(each) for each in ds["source"].values.tolist()] if len(F) else []
        identity = ds["source_id"].values.tolist() if len(F) and "source_id" in ds.coords else [""] * len(F)
        F = F.reshape(len(F), len(value), 6)
        own = np.asarray(ds["covariance"].values, dtype=float).reshape(-1, 6, 6) - products(F)
        return cls(value, own, F, source, [str(each) for each in identity])

    @property
    def seen(self) -> list[str]:
        """Freedoms with known values."""
        return [name for name, values in zip(DOF, self.value.T, strict=True) if np.isfinite(values).any()]

    def at_times(self, time: Array, grid: Array) -> PointErrors:
        """Return the errors at other times."""
        total = self.own + products(self.influence)
        E, C, F, _ = interpolated(np.asarray(time, dtype=float), self.value, total, self.influence, grid, starting=True)
        return replace(self, value=E, own=C - products(F), influence=F)

    def since_first(self) -> PointErrors:
        """Return the changes since the first point."""
        total = self.own + products(self.influence)
        E, C, F, further = changes(self.value, total, self.influence, np.arange(len(self.value)) == 0)
        names, ids = [*self.source, *further], [*self.identity, *[""] * len(further)]
        return PointErrors(E, C - products(F), F, names, ids)

    def times(self, A: Array) -> PointErrors:
        """Return the errors multiplied by a matrix (6, 6), or by matrices (n, 6, 6).

        An unknown rotation counts as 0 where it acts by a lever, and makes a freedom unknown where it replaces it.
        """
        value, own, influence, unknown = self._filled
        block = np.zeros_like(A)
        block[..., :3, :3], block[..., 3:, 3:] = A[..., :3, :3] != 0, A[..., 3:, 3:] != 0
        if A.ndim == 2:  # one product of large matrices, instead of one of small ones at each point
            gone = unknown @ block.T > 0
            own = (own.reshape(-1, 36) @ np.kron(A, A).T).reshape(-1, 6, 6)
            value, influence = value @ A.T, influence @ A.T
        else:
            gone = np.matmul(block, unknown[..., None])[..., 0] > 0
            own = np.matmul(np.matmul(A, own), np.swapaxes(A, 1, 2))
            value, influence = (np.matmul(A, each[..., None])[..., 0] for each in (value, influence))
        if gone.any():
            value[gone] = np.nan
            own[gone[:, :, None] | gone[:, None, :]] = np.nan
            influence[:, gone] = np.nan
        return replace(self, value=value, own=own, influence=influence)

    @cached_property
    def _filled(self) -> tuple[Array, Array, Array, Array]:
        """Values, own and influence with 0 for unknown ones, and which values are unknown (1)."""
        return filled(self.value), filled(self.own), filled(self.influence), np.isnan(self.value).astype(float)

    def estimate(self, name: str, freedoms: Sequence[str]) -> Estimate:
        """Return freedoms as an estimate; sources without an identity are specific to this dataset."""
        keys = tuple(
            identity or f"{name}: {source}" for identity, source in zip(self.identity, self.source, strict=True)
        )
        if tuple(freedoms) == tuple(DOF):
            return Estimate(name, self.value, self.own, self.influence, keys)
        k = [DOF.index(freedom) for freedom in freedoms]
        return Estimate(name, self.value[:, k], self.own[:, k][:, :, k], self.influence[..., k], keys)


def _unchanged(errors: PointErrors) -> PointErrors:
    return errors


@dataclass(frozen=True)
class Stored:
    """The errors of one dataset on the common grid, as a function of the errors that it states.

    A mistake in a dataset changes the errors at its own functional point; ``shift`` leads from there to the common one.

    Attributes
    ----------
    errors : PointErrors
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

    errors: PointErrors
    shift: Array
    finish: Callable[[PointErrors], PointErrors] = _unchanged
    levers: dict[str, Array] = field(default_factory=dict)
    line: Callable[[PointErrors], PointErrors] = _unchanged

    def changed(self, A: Array) -> PointErrors:
        """Return the errors on common ground if the stated ones are multiplied by matrices (6, 6) or (n, 6, 6)."""
        return self.finish(self.errors.times(self._from_own(A)))

    def values(self, A: Array) -> Array:
        """Return the values (n, 6) of `changed`."""
        return self.finish(self._exact.times(self._from_own(A))).value

    def _from_own(self, A: Array) -> Array:
        """Return matrices that act at the functional point of the dataset as those that act at the common one."""
        values: Array = self.transfer @ A @ self._back
        return values

    @cached_property
    def _exact(self) -> PointErrors:
        """The errors without uncertainty."""
        each = self.errors
        return PointErrors(each.value, np.zeros_like(each.own), each.influence[:0], [], [])

    @cached_property
    def transfer(self) -> Array:
        """Matrix (6, 6) from the functional point of the dataset to the common one."""
        return adjoint(shift=self.shift)

    @cached_property
    def _back(self) -> Array:
        return adjoint(shift=-self.shift)
