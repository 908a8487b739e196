"""Where a result comes from: settings, raw data, instruments, software."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, cast

import xarray as xr
from pydantic import BaseModel

from errormotion.datasets.files.hashing import hash_dataset, plain

__all__ = ["hash_dataset", "make", "of", "plain"]

_PACKAGES = ("errormotion", "numpy", "scipy", "xarray", "zarr", "h5netcdf", "numba")


def make(
    settings: BaseModel | Mapping[str, Any],
    raw: xr.Dataset | None,
    instruments: Sequence[Mapping[str, Any]] | None,
    seed: int | None = None,
    steps: Sequence[Any] = (),
    raw_hash: str | None = None,
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
    raw_hash : str, optional
        The hash of ``raw`` if it is known already, from `errormotion.datasets.files.hashing.DatasetHasher`.

    Returns
    -------
    dict
        Of JSON values.
    """
    if instruments is None and raw is not None and isinstance(raw.attrs.get("instruments"), str):
        instruments = json.loads(raw.attrs["instruments"])
    return {
        "settings": plain(settings),
        "raw": None
        if raw is None
        else {"schema": str(raw.attrs.get("schema", "")), "hash": raw_hash or hash_dataset(raw)},
        "instruments": plain(instruments or []),
        "software": _software(),
        "seed": seed,
        "steps": plain(steps),
    }


def of(ds: xr.Dataset) -> dict[str, Any]:
    """Return the provenance that a dataset carries."""
    return cast(dict[str, Any], json.loads(ds.attrs["provenance"]))


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
