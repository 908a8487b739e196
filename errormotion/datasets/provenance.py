"""Where a result comes from: settings, raw data, instruments, software."""

from __future__ import annotations

import hashlib
import json
import math
import platform
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, cast

import numpy as np
import xarray as xr
from pydantic import BaseModel
from xarray.indexes import RangeIndex

_PACKAGES = ("errormotion", "numpy", "scipy", "xarray", "zarr", "h5netcdf", "numba")
_BLOCK = 2**21  # values in memory at a time


def make(
    settings: BaseModel | Mapping[str, Any],
    raw: xr.Dataset | None,
    instruments: Sequence[Mapping[str, Any]] | None,
    seed: int | None = None,
    steps: Sequence[Any] = (),
) -> dict[str, Any]:
    """Return the provenance of a result; the same inputs give the same provenance.

    Parameters
    ----------
    settings : BaseModel or mapping
        Effective settings, defaults included.
    raw : Dataset or None
        What was identified; its hash goes in.
    instruments : sequence of mapping or None
        Serial number, address and calibration of each; None takes the raw dataset's attribute ``instruments`` (JSON).
    seed : int, optional
        Of whatever was drawn.
    steps : sequence
        What was done, in order.

    Returns
    -------
    dict
        Of JSON values.
    """
    if instruments is None and raw is not None and isinstance(raw.attrs.get("instruments"), str):
        instruments = json.loads(raw.attrs["instruments"])
    return {
        "settings": plain(settings),
        "raw": None if raw is None else {"schema": str(raw.attrs.get("schema", "")), "hash": hash_dataset(raw)},
        "instruments": plain(instruments or []),
        "software": _software(),
        "seed": seed,
        "steps": plain(steps),
    }


def of(ds: xr.Dataset) -> dict[str, Any]:
    """Return the provenance that a dataset carries."""
    return cast(dict[str, Any], json.loads(ds.attrs["provenance"]))


def plain(value: Any) -> Any:
    """Return a value as JSON knows it; numbers that are not finite become text."""
    if isinstance(value, BaseModel):
        return plain(value.model_dump(mode="json"))
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)


def hash_dataset(ds: xr.Dataset) -> str:
    """Return ``sha256:...`` of a dataset's names, dimensions, attributes and values.

    Memory stays constant however big the dataset; file format, chunks, byte order and the width of texts do not
    matter. Evenly spaced times that the attributes ``sample_rate`` and ``time_start`` tell are not read.
    """
    digest = hashlib.sha256()
    _tell(digest, "attributes", _canonical(ds.attrs))
    for name in sorted(map(str, ds.variables)):
        if isinstance(ds.xindexes.get(name), RangeIndex):
            continue
        variable = ds.variables[name]
        kind = "text" if variable.dtype.kind in "OSTU" else variable.dtype.newbyteorder("<").str
        _tell(digest, name, list(map(str, variable.dims)), list(variable.shape), kind, _canonical(variable.attrs))
        for block in _blocks(variable):
            digest.update(block)
    return f"sha256:{digest.hexdigest()}"


def _tell(digest: Any, *parts: Any) -> None:
    digest.update(json.dumps(parts, sort_keys=True).encode() + b"\n")


def _canonical(attrs: Mapping[Any, Any]) -> Any:
    """Return attributes with what a NetCDF round trip changes made equal: arrays of one element are numbers."""
    return {
        name: value[0] if isinstance(value, list) and len(value) == 1 else value for name, value in plain(attrs).items()
    }


def _blocks(variable: xr.Variable) -> Iterator[bytes]:
    """Yield the values as bytes, in blocks that the shape alone determines."""
    if variable.dtype.kind in "OSTU":
        texts = np.asarray(variable.values).ravel().tolist()
        yield json.dumps([text.decode() if isinstance(text, bytes) else str(text) for text in texts]).encode()
        return
    if variable.ndim == 0 or variable.size <= _BLOCK:
        yield _bytes(variable)
        return
    # Two dimensions at a time: blocks across all the others would read every stored chunk again and again.
    for index in np.ndindex(*variable.shape[:-2]):
        part = variable[index]
        longest = max(part.sizes, key=lambda dim: part.sizes[dim])
        size = part.sizes[longest]
        length = max(1, _BLOCK * size // part.size)
        for start in range(0, size, length):
            yield _bytes(part.isel({longest: slice(start, start + length)}))


def _bytes(variable: xr.Variable) -> bytes:
    values = np.asarray(variable.values)
    if values.dtype.kind == "f":
        values = np.where(np.isnan(values), values.dtype.type(np.nan), values)  # one NaN, whatever its bits were
    return values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes()


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    found = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return tuple(found.items())


def _software() -> dict[str, str]:
    return dict(_versions())
