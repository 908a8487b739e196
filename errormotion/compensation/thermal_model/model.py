"""A thermal model: its dataset, and its prediction."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.compensation.thermal_model.features import Feature, matrix
from errormotion.compensation.thermal_model.record import instruments_of, read_inputs
from errormotion.datasets import build_errors, provenance
from errormotion.datasets.checks import dims, magnitude_violations, storable_violations
from errormotion.datasets.schemas import DOF, Row
from errormotion.datasets.storage.disk import load as load_dataset
from errormotion.datasets.storage.disk import reading, save
from errormotion.datasets.timing import start_of
from errormotion.errors import DatasetError

SCHEMA = "errormotion.model.thermal/1"
"""Schema of the model as a dataset."""

VERSION = "1"

EXTRAPOLATION = 0.1
"""Distance from the training range of a feature that is still accepted, relative to this range."""

_FREE = (-float("inf"), float("inf"))
_POSITIVE = (0.0, float("inf"))

ROWS = (
    Row("coefficient", ("dof", "feature"), "", *_FREE, "error per unit of each feature; NaN = error unknown"),
    Row("coefficient_covariance", ("dof", "feature", "feature_"), "", *_FREE, "of the coefficients of each error"),
    Row("misfit", ("dof",), "", *_POSITIVE, "standard uncertainty of a prediction, from campaigns that were left out"),
    Row("strength", ("dof",), "", *_POSITIVE, "of the regularisation, from cross-validation"),
    Row("removed", ("dof",), "1", -1e3, 1.0, "removed fraction of the RMS of the error at left-out campaigns"),
    Row("feature_power", ("feature",), "", 1, 2, "power of the working parameter"),
    Row("feature_lag", ("feature",), "s", *_POSITIVE, "lag"),
    Row("feature_time_constant", ("feature",), "s", *_POSITIVE, "of the first-order response; 0: the value itself"),
    Row("feature_parameter", ("feature",), "", 0, 1, "1: a working parameter, 0: a temperature"),
    Row("feature_low", ("feature",), "", *_FREE, "lowest value in training"),
    Row("feature_high", ("feature",), "", *_FREE, "highest value in training"),
)
"""Variables of the model. Temperatures are changes since the start in K, speeds in 1000/min, feeds in m/min."""

ATTRIBUTES = ("schema", "component", "frame", "machine", "reference", "functional_point", "variant", "provenance")


@dataclass(frozen=True)
class Parts:
    """Results of the fit.

    Attributes
    ----------
    features : tuple of Feature
    coefficient : (6, feature)
        m or rad per unit of the feature.
    covariance : (6, feature, feature)
    misfit, strength, removed : (6,)
    low, high : (feature,)
        Range in training.
    """

    features: tuple[Feature, ...]
    coefficient: Array
    covariance: Array
    misfit: Array
    strength: Array
    removed: Array
    low: Array
    high: Array


class ThermalModel:
    """Predicts the six errors of a machine from temperatures and working parameters.

    Attributes
    ----------
    dataset : Dataset
        The model, schema ``errormotion.model.thermal/1``.
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        found = violations(dataset)
        if found:
            raise DatasetError(f"Not a thermal model of schema {SCHEMA}:", found, code="schema.violated")
        self.dataset = dataset

    @classmethod
    def of(cls, parts: Parts, attrs: Mapping[str, Any], where: Mapping[str, Any]) -> ThermalModel:
        """Return the model for the results of a fit, the attributes of its campaigns and a provenance."""
        features = parts.features
        data = {
            "coefficient": (("dof", "feature"), parts.coefficient),
            "coefficient_covariance": (("dof", "feature", "feature_"), parts.covariance),
            "misfit": ("dof", parts.misfit),
            "strength": ("dof", parts.strength),
            "removed": ("dof", parts.removed),
            "feature_power": ("feature", np.array([f.power for f in features], dtype=np.int8)),
            "feature_lag": ("feature", np.array([f.lag for f in features], dtype=float)),
            "feature_time_constant": ("feature", np.array([f.time_constant for f in features], dtype=float)),
            "feature_parameter": ("feature", np.array([f.parameter for f in features], dtype=np.int8)),
            "feature_low": ("feature", parts.low),
            "feature_high": ("feature", parts.high),
        }
        coords = {
            "dof": list(DOF),
            "feature": [f.name for f in features],
            "feature_source": ("feature", [f.source for f in features]),
        }
        dataset = xr.Dataset(data, coords, {"schema": SCHEMA, **attrs, "provenance": json.dumps(where)})
        for row in ROWS:
            if row.unit:
                dataset[row.name].attrs["units"] = row.unit
        return cls(dataset)

    @classmethod
    def load(cls, path: str | Path) -> ThermalModel:
        """Read a model.

        Raises
        ------
        DatasetError
            The file cannot be read, or is not a thermal model.
        """
        with reading(Path(path)), load_dataset(path) as dataset:
            if dataset.attrs.get("schema") != SCHEMA:
                raise DatasetError(
                    f"{path}: expected schema {SCHEMA}; found {dataset.attrs.get('schema', 'none')}",
                    code="schema.other",
                )
            return cls(dataset.load())

    def save(self, path: str | Path) -> None:
        """Write the model as NetCDF; an existing file is not overwritten."""
        save(self.dataset, Path(path))

    @cached_property
    def features(self) -> tuple[Feature, ...]:
        """The features."""
        ds = self.dataset
        return tuple(
            Feature(str(source), bool(parameter), int(power), float(lag), float(constant))
            for source, parameter, power, lag, constant in zip(
                ds["feature_source"].values,
                ds["feature_parameter"].values,
                ds["feature_power"].values,
                ds["feature_lag"].values,
                ds["feature_time_constant"].values,
                strict=True,
            )
        )

    @property
    def sensors(self) -> tuple[str, ...]:
        """Required temperature sensors."""
        return tuple(dict.fromkeys(f.source for f in self.features if not f.parameter))

    def predict(self, data: xr.Dataset) -> xr.Dataset:
        """Return the errors predicted from temperatures and working parameters.

        Parameters
        ----------
        data : Dataset
            With ``temperature(time, sensor)`` and, if the model requires them, ``spindle_speed(time)`` or
            ``feed(time)``: the log of a monitor, a raw dataset or an error dataset. The first time is the reference
            state.

        Returns
        -------
        Dataset
            Error dataset over ``time``; NaN where an input is unknown. ``outside(time)`` is 1 where a feature lies
            outside the training range, ``outside_feature(time, feature)`` for each feature. The uncertainty of the
            coefficients and the misfit are fully correlated in time.

        Raises
        ------
        DatasetError
            A required input is missing.
        """
        inputs = read_inputs(data)
        X = matrix(inputs, self.features)
        n, _p = X.shape
        ds = self.dataset
        coefficient = ds["coefficient"].values
        values = np.where(np.isfinite(coefficient).all(axis=1), X @ np.nan_to_num(coefficient).T, np.nan)
        unknown = ~np.isfinite(X).all(axis=1)
        values[unknown] = np.nan
        influence, names, kinds = self._influence(np.nan_to_num(X))
        own_hash = provenance.hash_dataset(ds)
        covariance = np.einsum("stj,stk->tjk", influence, influence)
        span = ds["feature_high"].values - ds["feature_low"].values
        features_outside = (ds["feature_high"].values + EXTRAPOLATION * span < X) | (
            ds["feature_low"].values - EXTRAPOLATION * span > X
        )
        outside = features_outside.any(axis=1).astype(np.int8)
        extras = {
            "outside": xr.DataArray(
                outside, dims="time", attrs={"units": "1", "long_name": "1: outside the training range"}
            ),
            "outside_feature": xr.DataArray(
                features_outside.astype(np.int8),
                dims=("time", "feature"),
                coords={"feature": [f.name for f in self.features]},
            ),
        }
        result = build_errors(
            values,
            covariance,
            dims=("time",),
            coords={"time": ("time", inputs.time, {"units": "s"}), **_inputs(data)},
            component=str(ds.attrs["component"]),
            machine=str(data.attrs.get("machine", ds.attrs["machine"])),
            frame=str(ds.attrs["frame"]),
            functional_point=ds.attrs["functional_point"],
            reference=f"state at {inputs.time[0]:g} s",
            method="thermal_model",
            method_version=VERSION,
            provenance=provenance.make(
                {"variant": ds.attrs["variant"]},
                None,
                instruments_of([data, ds]),
                steps=[{"model": own_hash}],
            ),
            influence=influence,
            sources=names,
            source_groups=kinds,
            extras=extras,
            start=start_of(data),
            source_ids=self._identities(names, kinds, own_hash),
            reference_interval=(float(inputs.time[0]), float(inputs.time[0])),
            lever_axes=str(ds.attrs.get("lever_axes", "")),
        )
        notes = [f"{int(unknown.sum())} of {n} times have no prediction: an input is unknown"] if unknown.any() else []
        if outside.any():
            which = ", ".join(self.features[k].name for k in np.flatnonzero(features_outside.any(axis=0)))
            notes.append(f"{int(outside.sum())} of {n} times are outside the training range: {which}")
        if notes:
            result.attrs["notes"] = notes
        return result

    def _identities(self, names: list[str], kinds: list[str], own_hash: str) -> dict[str, str]:
        """Return the identities of the parts of the coefficients, which are common to all predictions of one model.

        The misfit has none. The parts are eigenvectors, whose sense is arbitrary: it is part of the identity.
        """
        found = {}
        covariance = self.dataset["coefficient_covariance"].values
        for name, kind in zip(names, kinds, strict=True):
            if kind == "coefficients":
                freedom, number = name.split()[-2:]
                vectors = np.linalg.eigh(covariance[DOF.index(freedom)])[1]
                found[name] = provenance.identity(own_hash, part=name, along=vectors[:, int(number) - 1])
        return found

    def _influence(self, X: Array) -> tuple[Array, list[str], list[str]]:
        """Return the effects of one standard uncertainty of coefficients and misfit, (source, n, 6)."""
        ds = self.dataset
        n, p = X.shape
        columns, names, kinds = [], [], []
        for k, freedom in enumerate(DOF):
            covariance = ds["coefficient_covariance"].values[k]
            if not np.isfinite(covariance).all():
                continue
            values, vectors = np.linalg.eigh(covariance)
            for number in range(p):
                column = np.zeros((n, 6))
                column[:, k] = X @ vectors[:, number] * np.sqrt(max(values[number], 0.0))
                columns.append(column)
                names.append(f"coefficients of {freedom} {number + 1}")
                kinds.append("coefficients")
            column = np.zeros((n, 6))
            column[:, k] = float(ds["misfit"].values[k])
            columns.append(column)
            names.append(f"misfit of {freedom}")
            kinds.append("misfit")
        return np.array(columns), names, kinds


def _inputs(data: xr.Dataset) -> dict[str, Any]:
    coords: dict[str, Any] = {
        "sensor": [str(name) for name in data["sensor"].values],
        "temperature": (
            ("time", "sensor"),
            data["temperature"].transpose("time", "sensor").values,
            {"units": "degC"},
        ),
    }
    for name, unit in (("spindle_speed", "1/min"), ("feed", "m/s")):
        if name in data and data[name].dims == ("time",):
            coords[name] = ("time", np.asarray(data[name].values, dtype=float), {"units": unit})
    return coords


def violations(dataset: xr.Dataset) -> list[str]:
    """Return all violations of the model's schema, one sentence each."""
    if dataset.attrs.get("schema") != SCHEMA:
        return [f"attribute 'schema': expected {SCHEMA}; found {dataset.attrs.get('schema', 'none')}"]
    found = storable_violations(dataset)
    found += [f"attribute '{name}': missing" for name in ATTRIBUTES if name not in dataset.attrs]
    for row in ROWS:
        if row.name not in dataset.variables:
            found.append(f"{row.name}({', '.join(row.dims)}): missing; expected: {row.meaning}")
        elif set(dataset[row.name].dims) != set(row.dims):
            found.append(
                f"{row.name}: expected dims ({', '.join(row.dims)}); found {dims(dataset.variables[row.name])}"
            )
        else:
            found += magnitude_violations(row.name, dataset.variables[row.name], row)
    for dim in ("dof", "feature"):
        labels = [str(each) for each in dataset[dim].values.ravel()] if dim in dataset.coords else []
        if len(labels) != dataset.sizes.get(dim) or len({*labels}) < len(labels):
            found.append(f"{dim}: expected one unique label for each element")
        elif dim == "dof" and tuple(labels) != DOF:
            found.append(f"dof: expected {' '.join(DOF)}; found {' '.join(labels)}")
    point: Any = dataset.attrs.get("functional_point")
    if np.shape(point) != (3,) or np.asarray(point).dtype.kind not in "fiu":
        found.append(f"attribute 'functional_point': expected three coordinates in m; found {point!r:.100}")
    campaigns: Any = dataset.attrs.get("campaigns", 0)
    if np.ndim(campaigns) or np.asarray(campaigns).dtype.kind not in "fiu":
        found.append(f"attribute 'campaigns': expected a number; found {campaigns!r:.100}")
    if "feature_source" not in dataset.coords:
        found.append("feature_source(feature): missing; expected: sensor or working parameter of each feature")
    return found
