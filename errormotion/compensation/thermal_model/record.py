"""Input data of a model: temperatures and working parameters over time, and errors where known."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.files.reading import parse_json
from errormotion.datasets.schemas import DOF
from errormotion.errors import DatasetError


@dataclass(frozen=True)
class Inputs:
    """Temperatures and working parameters over time.

    Attributes
    ----------
    time : (n,)
        s, increasing.
    temperature : dict of str to (n,)
        Change of each sensor since its first known value, K; NaN = unknown.
    parameter : dict of str to (n,)
        ``spindle_speed`` in 1000/min and ``feed`` in m/min since the previous time, if the data contain them; 0 before
        the first time; NaN = unknown.
    """

    time: Array
    temperature: dict[str, Array]
    parameter: dict[str, Array]


@dataclass(frozen=True)
class Record:
    """One campaign with measured errors.

    Attributes
    ----------
    inputs : Inputs
    errors : (n, 6)
        m and rad; NaN = unknown.
    variance : (n, 6)
        Of the errors.
    """

    inputs: Inputs
    errors: Array
    variance: Array


MAX_TIMES = 1_000_000
"""Times of one dataset: 11 days at one a second. The covariance of a prediction alone takes 288 bytes for each."""
PARAMETERS = {"spindle_speed": 1e-3, "feed": 60.0}
"""Factors of the working parameters to the units of the model."""


def read_inputs(ds: xr.Dataset, what: str = "the data") -> Inputs:
    """Return the inputs in an error dataset, a raw dataset or the log of a monitor.

    Raises
    ------
    DatasetError
        No time, more than `MAX_TIMES`, no temperature, or times that do not increase.
    """
    if "time" not in ds.dims or "time" not in ds.coords:
        raise DatasetError(
            f"{what}: expected temperatures over time; found the dims {', '.join(map(str, ds.dims))}",
            code="model.temperatures.dims",
        )
    if ds.sizes["time"] > MAX_TIMES:
        raise DatasetError(
            f"{what}: expected at most {MAX_TIMES} times; found {ds.sizes['time']}. Select fewer first.",
            code="model.times.too_many",
        )
    if "temperature" not in ds or set(ds["temperature"].dims) != {"time", "sensor"}:
        raise DatasetError(
            f"{what}: expected temperature(time, sensor); found none. Add a thermometer to the bench.",
            code="model.temperatures.missing",
        )
    time = np.asarray(ds["time"].values, dtype=float)
    if not time.size:
        raise DatasetError(f"{what}: expected at least one time; found none", code="model.times.none")
    if time.size > 1 and not (np.diff(time) > 0).all():
        raise DatasetError(f"{what}: expected increasing times", code="model.times.not_increasing")
    values = np.asarray(ds["temperature"].transpose("time", "sensor").values, dtype=float)
    names = [str(name) for name in ds["sensor"].values]
    if len(set(names)) < len(names):
        raise DatasetError(
            f"{what}: expected different names of the sensors; found {', '.join(names)}", code="model.sensors.names"
        )
    temperature = {name: since_start(values[:, k]) for k, name in enumerate(names)}
    parameter = {
        name: np.asarray(ds[name].values, dtype=float) * factor
        for name, factor in PARAMETERS.items()
        if name in ds and ds[name].dims == ("time",)
    }
    return Inputs(time, temperature, parameter)


def since_start(values: Array) -> Array:
    """Return values minus the first known one; NaN where unknown."""
    known = np.flatnonzero(np.isfinite(values))
    return values - values[known[0]] if known.size else values


def read_record(ds: xr.Dataset, what: str = "the errors") -> Record:
    """Return the record of an error dataset over time.

    Raises
    ------
    DatasetError
        The dataset has other dimensions, or no temperatures.
    """
    inputs = read_inputs(ds, what)
    if ds["EX"].dims != ("time",):
        dims = ", ".join(map(str, ds["EX"].dims))
        raise DatasetError(
            f"{what}: expected errors over time alone; found ({dims}). Select one position first.",
            code="model.errors.dims",
        )
    errors = np.column_stack([np.asarray(ds[name].values, dtype=float) for name in DOF])
    covariance = ds["covariance"].transpose("time", "dof", "dof_").values
    variance = np.diagonal(covariance, axis1=1, axis2=2).copy()
    return Record(inputs, errors, variance)


def _stated(ds: xr.Dataset, name: str, kind: type[Any]) -> Any:
    """Return what an attribute states in JSON; an empty object or list where it is missing."""
    try:
        found = parse_json(str(ds.attrs[name])) if name in ds.attrs else kind()
    except ValueError as error:
        raise DatasetError(f"attribute '{name}': expected JSON; {error}", code="model.attribute.form") from None
    if not isinstance(found, kind):
        raise DatasetError(
            f"attribute '{name}': expected a JSON {kind.__name__}; found {found!r:.100}", code="model.attribute.form"
        )
    return found


def instruments_of(datasets: Iterable[xr.Dataset]) -> list[Any]:
    """Return the instruments of datasets, each once, so that simulated data remain marked as such."""
    found: list[Any] = []
    for ds in datasets:
        provenance = _stated(ds, "provenance", dict)
        for instrument in provenance.get("instruments") or _stated(ds, "instruments", list):
            if instrument not in found:
                found.append(instrument)
    return found
