"""One array of a raw store along the growing dimension: its current block, the files of its chunks, its packing."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from xarray.conventions import encode_cf_variable

from errormotion.datasets.storage.zarr_folder import dtype_of, encoded, fill_of, values_of


class Column:
    """One array along the growing dimension, with its current block in memory."""

    def __init__(self, path: Path, metadata: dict[str, Any], dim: str) -> None:
        self.path = path
        self.dims = dims_of(metadata)
        self.axis = self.dims.index(dim)
        chunk = metadata["chunk_grid"]["configuration"]["chunk_shape"]
        self.block = int(chunk[self.axis])
        self.dtype = dtype_of(metadata)
        self.shape = tuple(metadata["shape"])
        self.packing = {
            key: metadata["attributes"][key] for key in ("scale_factor", "add_offset") if key in metadata["attributes"]
        }
        if self.packing:
            self.packing |= {"dtype": self.dtype.name, "_FillValue": metadata["fill_value"]}
        self._metadata = metadata
        self._values = np.full(chunk, fill_of(metadata), self.dtype)

    @property
    def attributes(self) -> Mapping[str, Any]:
        """Attributes, with those of the packing."""
        return dict(self._metadata["attributes"])

    def _at(self, start: int, stop: int) -> tuple[slice, ...]:
        return tuple(slice(start, stop) if axis == self.axis else slice(size) for axis, size in enumerate(self.shape))

    def load(self, count: int) -> None:
        """Read the last, incomplete block."""
        start = count // self.block * self.block
        if count > start:
            stored = values_of(self.path, self.metadata(count), self._at(start, count))
            self._values[self._at(0, count - start)] = stored

    def put(self, fill: int, values: np.ndarray, first: int, length: int) -> None:
        """Put some of the values of a dataset into the present block."""
        self._values[self._at(fill, fill + length)] = values[self._at(first, first + length)]

    def file(self, start: int) -> Path:
        """Return the file of the block that begins at a sample."""
        return self.path.joinpath(
            "c", *(str(start // self.block if axis == self.axis else 0) for axis in range(len(self.dims)))
        )

    def content(self, length: int) -> bytes:
        """Return the content of the file of the present block, which has some samples."""
        self._values[self._at(length, self.block)] = fill_of(self._metadata)
        return encoded(self._values, self._metadata)

    def metadata(self, count: int) -> dict[str, Any]:
        """Return the metadata of the array with some samples."""
        shape = list(self._metadata["shape"])
        shape[self.axis] = count
        return self._metadata | {"shape": shape}


def dims_of(metadata: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of the dimensions of an array; a scalar has none."""
    return tuple(metadata.get("dimension_names") or ())


def encode(variable: xr.Variable, packing: Mapping[str, Any]) -> np.ndarray | None:
    """Return the numbers to store; None if the packing would lose more than the rounding error."""
    values = variable.values
    if not packing:
        if values.dtype.kind == "U":
            return values.astype(object)
        if values.dtype.kind in "fiu":  # needs no encoding
            return values
        return np.asarray(encode_cf_variable(xr.Variable(variable.dims, values)).values)
    scale, offset, fill = packing["scale_factor"], packing["add_offset"], packing["_FillValue"]
    limits = np.iinfo(packing["dtype"])
    steps = values - offset
    steps /= scale
    whole = np.rint(steps)
    missing = np.isnan(steps)
    some = bool(missing.any())
    with np.errstate(invalid="ignore"):
        steps -= whole
        # 1e-6 of a step is far above the rounding of float64 (and that of 16 bit steps), far below half a step
        good = np.abs(steps, out=steps) < 1e-6
        good &= whole >= limits.min
        good &= whole <= limits.max
        good &= whole != fill
    if some:
        good |= missing
        whole[missing] = fill
    packed: np.ndarray | None = whole.astype(packing["dtype"]) if good.all() else None
    return packed


def fits(variable: xr.Variable, stored: np.dtype[Any]) -> bool:
    """Whether values are stored without a change."""
    if stored.kind == "O":
        return variable.dtype.kind == "U" or is_text(variable)
    kind = variable.dtype
    return kind == stored or (kind.kind == "b" and stored == np.int8) or np.can_cast(kind, stored, "safe")


def is_text(variable: xr.Variable) -> bool:
    """Whether all values of a variable of objects are texts."""
    return variable.dtype.kind == "O" and all(isinstance(each, str) for each in variable.values.ravel())
