"""Provenance of results: settings, raw data, instruments, software."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any, cast

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from pydantic import BaseModel

from errormotion import plugins
from errormotion.datasets import clock
from errormotion.datasets.files.hashing import hash_dataset, plain

__all__ = ["hash_dataset", "identity", "make", "of", "plain"]

IMPORTED = "imported"
"""Attribute of raw data that were not acquired by errormotion: the names of their files."""

_PACKAGES = ("errormotion", "numpy", "scipy", "xarray", "zarr", "h5netcdf", "numba")


def make(
    settings: BaseModel | Mapping[str, Any],
    raw: xr.Dataset | None,
    instruments: Sequence[Mapping[str, Any]] | None,
    seed: int | None = None,
    steps: Sequence[Any] = (),
    raw_hash: str | None = None,
) -> dict[str, Any]:
    """Return the provenance of a result; it is deterministic.

    Parameters
    ----------
    settings : BaseModel or mapping
        Effective settings, including defaults; for imported data those of `of_evaluation`.
    raw : Dataset or None
        The raw data, whose hash is stored.
    instruments : sequence of mapping or None
        Serial number, address and calibration of each; default: the attribute ``instruments`` (JSON) of ``raw``.
    seed : int, optional
        Seed of random numbers.
    steps : sequence
        Processing steps, in order.
    raw_hash : str, optional
        The hash of ``raw`` if it is known, from `errormotion.datasets.files.hashing.DatasetHasher`.

    Returns
    -------
    dict
        Values are those of JSON.
    """
    if instruments is None and raw is not None and isinstance(raw.attrs.get("instruments"), str):
        instruments = json.loads(raw.attrs["instruments"])
    interrupted = clock.notes(raw.attrs) if raw is not None else []
    return {
        "settings": plain(settings if raw is None or IMPORTED not in raw.attrs else of_evaluation(settings, raw)),
        "raw": None
        if raw is None
        else {"schema": str(raw.attrs.get("schema", "")), "hash": raw_hash or hash_dataset(raw)},
        "instruments": plain(instruments or []),
        "software": _software(),
        "seed": seed,
        "steps": plain(steps),
    } | ({"interruptions": interrupted} if interrupted else {})


def of_evaluation(settings: BaseModel | Mapping[str, Any], raw: xr.Dataset) -> BaseModel | Mapping[str, Any]:
    """Return settings without those of the acquisition that nobody stated: their defaults never applied."""
    owner = plugins.owner_of_schema(str(raw.attrs.get("schema", "")))
    if not isinstance(settings, BaseModel) or owner is None or not issubclass(owner, plugins.Method):
        return settings
    unused = {*owner.acquisition_settings} - settings.model_fields_set
    return {name: each for name, each in settings.model_dump(mode="json").items() if name not in unused}


def identity(*calibrated: ArrayLike | str, part: str, along: ArrayLike = ()) -> str:
    """Return the identity of a source: equal in two datasets that use the same calibration.

    Parameters
    ----------
    *calibrated : array_like or str
        Values and covariance of the calibration, or its hash.
    part : str
        Name of one of the independent parts of its uncertainty.
    along : array_like, optional
        Direction of this part in the space of the calibrated parameters, rounded to 1e-6; the reversed direction is
        another source.

    Returns
    -------
    str
        For ``source_ids`` of `errormotion.datasets.build_errors`.
    """
    digest = hashlib.sha256()
    for each in (*calibrated, np.round(np.asarray(along, dtype=float), 6) + 0.0):
        if isinstance(each, str):
            data, shape = each.encode(), "text"
        else:
            array = np.ascontiguousarray(each, dtype="<f8")
            data, shape = array.tobytes(), str(array.shape)
        digest.update(f"{shape} {len(data)}:".encode() + data)
    return f"sha256:{digest.hexdigest()[:32]}/{part}"


def of(ds: xr.Dataset) -> dict[str, Any]:
    """Return the provenance of a dataset."""
    return cast(dict[str, Any], json.loads(ds.attrs["provenance"]))


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            versions[package] = "not installed"
    return tuple(versions.items())


def _software() -> dict[str, str]:
    return dict(_versions())
