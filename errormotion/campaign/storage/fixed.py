"""What does not grow in a raw store: variables and attributes that all appended datasets must have in common."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import xarray as xr

from errormotion.datasets.clock import ORIGIN, START
from errormotion.datasets.storage.zarr_folder import open_zarr
from errormotion.errors import RunError

_REMEDY = "All datasets that a method yields must be equal in what does not grow. What is measured so far is stored."

STARTS = ("time_start", "start", ORIGIN, START)
"""Attributes that state the beginning of a dataset; the store has those of the first one."""

PER_CHUNK = ("dropped", "invalid", *STARTS)
"""Attributes that differ between the datasets that a method yields."""


@dataclass(frozen=True)
class Fixed:
    """The variables of a store that do not grow.

    Attributes
    ----------
    path : Path
        The store.
    dim : str
        The dimension of the samples.
    dims : tuple of str
        All dimensions that grow.
    variables : mapping of str to Variable
    """

    path: Path
    dim: str
    dims: tuple[str, ...]
    variables: Mapping[str, xr.Variable]

    @classmethod
    def read(cls, path: Path, names: Iterable[str], dim: str, dims: tuple[str, ...]) -> Self:
        """Read the variables of these names.

        Raises
        ------
        RunError
            The store has a format that only another version writes.
        """
        dataset = open_zarr(path)
        if dataset is None:
            raise RunError(
                f"{path}: expected an array format that this version writes; found another one",
                code="store.array.format",
            )
        return cls(path, dim, dims, {name: dataset.variables[name].load() for name in names})

    @property
    def _along(self) -> str:
        return "along " + " or ".join(f"'{dim}'" for dim in self.dims)

    def check(self, chunk: xr.Dataset, growing: Mapping[str, Mapping[str, Any]], attrs: Mapping[str, Any]) -> None:
        """Refuse a dataset that differs from the first one in what is stored once, and would be lost.

        Parameters
        ----------
        chunk : Dataset
            The dataset to append.
        growing : mapping of str to mapping
            Attributes of the variables that grow, as stored.
        attrs : mapping
            Attributes of the store.

        Raises
        ------
        RunError
            Other variables, values or attributes.
        """
        stored = stored_variables(chunk, self.dim)
        fixed = {name: variable for name, variable in stored.items() if not set(self.dims) & set(variable.dims)}
        if more := sorted({*fixed} ^ {*self.variables}):
            expected = ", ".join(sorted(self.variables)) or "none"
            what = "new" if more[0] in fixed else "missing"
            raise RunError(
                f"{self.path}: expected the variables of the first dataset that do not grow {self._along} "
                f"({expected}); '{more[0]}' is {what}. {_REMEDY}",
                code="store.variables.fixed",
            )
        for name, variable in fixed.items():
            before = self.variables[name]
            if variable.dims != before.dims or not _equal(variable.values, before.values):
                raise RunError(
                    f"{self.path}: '{name}' does not grow {self._along}, and differs from the first dataset: "
                    f"expected {_described(before)}; found {_described(variable)}. {_REMEDY}",
                    code="store.variables.fixed",
                )
        for name, variable in stored.items():
            before_attrs = growing[name] if name in growing else self.variables[name].attrs
            self._check_attrs(f"'{name}'", before_attrs, variable.attrs)
        own = {key: value for key, value in chunk.attrs.items() if key not in PER_CHUNK}
        self._check_attrs("the dataset", attrs, own)

    def _check_attrs(self, what: str, before: Mapping[str, Any], after: Mapping[Any, Any]) -> None:
        for key, value in plain_attrs(after).items():
            if key not in before or not _same(before[key], value):
                raise RunError(
                    f"{self.path}: the attribute '{key}' of {what} differs from the first dataset: expected "
                    f"{before.get(key)!r:.100}; found {value!r:.100}. {_REMEDY}",
                    code="store.attributes.differ",
                )


def stored_variables(dataset: xr.Dataset, dim: str) -> dict[str, xr.Variable]:
    """Return the stored variables: all but the times of evenly spaced samples, which follow from rate and start."""
    regular = dim == "time" and "sample_rate" in dataset.attrs
    return {str(n): v for n, v in dataset.variables.items() if not (regular and n == "time")}


def plain_attrs(attrs: Mapping[Any, Any]) -> dict[str, Any]:
    """Return attributes as JSON values, without the counts of one chunk."""
    kept = {str(k): v for k, v in attrs.items() if k not in PER_CHUNK or k in STARTS}
    return {k: v.tolist() if isinstance(v, np.generic | np.ndarray) else v for k, v in kept.items()}


def _equal(a: np.ndarray, b: np.ndarray) -> bool:
    if a.dtype.kind in "UO" or b.dtype.kind in "UO":
        return a.shape == b.shape and a.astype(object).tolist() == b.astype(object).tolist()
    return np.array_equal(a, b, equal_nan=a.dtype.kind in "fc" and b.dtype.kind in "fc")


def _described(variable: xr.Variable) -> str:
    """Return sizes and first values for a message."""
    first = ", ".join(f"{each}" for each in variable.values.ravel()[:3].tolist())
    return f"{dict(variable.sizes) or 'one value'} ({first}{', ...' if variable.size > 3 else ''})"


def _same(a: Any, b: Any) -> bool:
    """Whether two attributes are equal as JSON; NaN equals NaN."""
    return bool(a == b) or json.dumps(a, sort_keys=True) == json.dumps(b, sort_keys=True)
