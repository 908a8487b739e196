"""The last values recorded by another process: a run, a monitor or a compensation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import xarray as xr

from errormotion import datasets
from errormotion.campaign.compensation.following import STATUS, read_status
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.runner import stored_plan
from errormotion.campaign.storage.store import committed_length
from errormotion.datasets.results.places import in_field_units

MAX_VALUES = 200
"""Number of values of one sample that are returned."""


@dataclass(frozen=True)
class Value:
    """One number of the last sample: variable, label in its other dimensions, value in the unit of the record."""

    variable: str
    label: str
    value: float
    unit: str


@dataclass(frozen=True)
class Recorded:
    """The last sample of a record.

    Attributes
    ----------
    title : str
        Test and campaign, or the kind of the record.
    samples : int
        Number of samples.
    values : tuple of Value
        Values of the last sample; NaN if unknown.
    estop : bool, optional
        Emergency stop; None if the record does not state it.
    program : str
    """

    title: str
    samples: int
    values: tuple[Value, ...] = ()
    estop: bool | None = None
    program: str = ""


def recorded(path: Path) -> Recorded:
    """Return the last sample of a run folder that is visible to readers.

    Raises
    ------
    ErrormotionError
        The path is not a run folder, or its record is damaged.
    """
    folder = RunFolder.open(path)
    campaign = folder.data.get("campaign")
    title = str(folder.data.get("test", ""))
    if isinstance(campaign, dict):
        title = f"{title} of {campaign.get('name', '')}"
    estop, program = None, ""
    if (path / STATUS).exists():
        status = read_status(path)
        estop, program = status.estop, status.program
    dim = dim_of(folder)
    samples = committed_length(folder.raw, dim) if (folder.raw / "zarr.json").exists() else 0
    values: tuple[Value, ...] = ()
    if samples:
        with datasets.load(folder.raw) as raw:
            count = min(samples, int(raw.sizes.get(dim, 0)))
            values = tuple(islice(_last(raw, dim, count), MAX_VALUES)) if count else ()
    return Recorded(title, samples, values, estop, program)


def dim_of(folder: RunFolder) -> str:
    """Return the dimension along which the record of a run grows."""
    if "campaign" not in folder.data:
        return "time"
    tests = stored_plan(folder).tests
    test_found = next((test for test in tests if test.name == folder.data.get("test")), None)
    return test_found.method().append_dim(test_found.settings) if test_found is not None else "time"


def _last(raw: xr.Dataset, dim: str, count: int) -> Iterator[Value]:
    for name, variable in raw.data_vars.items():
        if dim not in variable.dims or variable.dtype.kind not in "fiu":
            continue
        last = variable.isel({dim: count - 1})
        numbers = np.atleast_1d(np.asarray(last.values, dtype=float))
        unit = str(variable.attrs.get("units", ""))
        for index in np.ndindex(numbers.shape):
            labels = (_label(raw, str(d), k) for d, k in zip(last.dims, index, strict=False))
            yield Value(str(name), " ".join(labels), float(numbers[index]), unit)


def _label(raw: xr.Dataset, dim: str, index: int) -> str:
    if dim in raw.coords and raw[dim].ndim == 1:
        value = raw[dim].values[index]
        if isinstance(value, str):
            return str(value)
        if np.isreal(value):
            values, unit = in_field_units(raw[dim])
            return f"{dim} {values[index]:g} {unit}".removesuffix(" 1")
        return str(value)
    return f"{dim} {index + 1}"
