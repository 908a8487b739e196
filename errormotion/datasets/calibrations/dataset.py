"""The common part of calibrations: a dataset with a schema, checked, read, written, and assigned to one sensor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.calibrations import owner
from errormotion.datasets.checks import dims, magnitude_violations, storable_violations
from errormotion.datasets.schemas import Row
from errormotion.datasets.storage.disk import load as load_dataset
from errormotion.datasets.storage.disk import reading, save
from errormotion.errors import DatasetError


class Calibration:
    """A calibration of one sensor; subclasses state the schema.

    Parameters
    ----------
    dataset : Dataset
        With the schema `schema`.

    Raises
    ------
    DatasetError
        The dataset violates its schema.
    """

    schema: ClassVar[str]
    rows: ClassVar[tuple[Row, ...]]
    what: ClassVar[str]
    """Term for messages."""
    kind: ClassVar[str]
    """Kind of the calibrated instrument."""
    hints: ClassVar[Mapping[str, str]] = {}
    """What to do with a file of another schema, by the start of its id; ``{}`` stands for the path."""
    named: ClassVar[bool] = False
    """Whether the dataset gets the name of its file as the attribute ``name``."""

    def __init__(self, dataset: xr.Dataset) -> None:
        messages = self.violations(dataset)
        if messages:
            raise DatasetError(f"The {self.what} breaks its schema ({self.schema}):", messages, code="schema.violated")
        self.dataset = dataset.load()
        self.coefficients = self._values("coefficient")
        self.coefficient_covariance = self._values("coefficient_covariance")
        self._degrees = self._values("degree").astype(int)

    @staticmethod
    def violations(ds: xr.Dataset) -> list[str]:
        """Return every violation of the schema, one sentence each."""
        raise NotImplementedError

    def _values(self, name: str) -> Array:
        row = next(row for row in self.rows if row.name == name)
        return np.asarray(self.dataset[name].transpose(*row.dims).values, dtype=float)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a calibration.

        Raises
        ------
        DatasetError
            The file does not exist, is damaged, or has another schema.
        """
        with reading(path), load_dataset(path) as dataset:
            schema = str(dataset.attrs.get("schema", "none"))
            if schema != cls.schema:
                hint = next((text.format(path) for start, text in cls.hints.items() if schema.startswith(start)), "")
                raise DatasetError(
                    f"{path}: expected a {cls.what} ({cls.schema}); found schema {schema}{hint}",
                    code="schema.other",
                )
            try:
                return cls(dataset.load().assign_attrs({"name": Path(path).stem} if cls.named else {}))
            except DatasetError as error:
                raise DatasetError(
                    f"{path}: the {cls.what} breaks its schema ({schema}):",
                    error.violations,
                    code="schema.violated",
                ) from error

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the calibration to a NetCDF file; after an error no file remains."""
        return save(self.dataset, path, overwrite=overwrite)

    @property
    def serial_number(self) -> str:
        """Serial number of the calibrated sensor; empty if the file does not state it."""
        return owner.serial_number(self.dataset.attrs, self.kind)


def assemble(schema: str, rows: Sequence[Row], variables: Mapping[str, Any], attrs: Mapping[str, Any]) -> xr.Dataset:
    """Return the dataset of a calibration from its values by name, with the dims and units of the schema."""
    data = {}
    for row in rows:
        units = {"units": row.unit} if row.unit else {}
        data[row.name] = (row.dims, np.asarray(variables[row.name]), {**units, "long_name": row.meaning})
    return xr.Dataset(data, attrs={**attrs, "schema": schema})


def table_violations(
    ds: xr.Dataset,
    schema: str,
    rows: Sequence[Row],
    attributes: Mapping[str, str],
    sizes: Mapping[str, int] | None = None,
    may_be_unknown: Sequence[str] = (),
) -> list[str]:
    """Return every violation of the tables of a schema, one sentence each.

    Parameters
    ----------
    ds : Dataset
    schema : str
        Id.
    rows : sequence of Row
        Variables.
    attributes : mapping of str to str
        Required attributes, and their meaning.
    sizes : mapping of str to int, optional
        Dimensions of fixed length.
    may_be_unknown : sequence of str
        Variables that may contain NaN.
    """
    messages = storable_violations(ds)
    if ds.attrs.get("schema") != schema:
        messages.append(f"attribute 'schema': expected '{schema}'; found {ds.attrs.get('schema')!r}")
    messages += [
        f"attribute '{name}': missing; expected {what}" for name, what in attributes.items() if name not in ds.attrs
    ]
    messages += [
        f"dimension {dim}: expected {size}; found {ds.sizes[dim]}"
        for dim, size in (sizes or {}).items()
        if ds.sizes.get(dim, size) != size
    ]
    for row in rows:
        messages += _row_violations(ds, row, row.name in may_be_unknown)
    return messages


def _row_violations(ds: xr.Dataset, row: Row, may_be_unknown: bool) -> list[str]:
    if row.name not in ds.variables:
        return [f"{row.name}({', '.join(row.dims)}): missing; expected {row.meaning}"]
    variable = ds.variables[row.name]
    if set(variable.dims) != set(row.dims):
        return [f"{row.name}: expected dims ({', '.join(row.dims)}); found {dims(variable)}"]
    if variable.size == 0:
        return [f"{row.name}: expected values; found none (a dimension has length 0)"]
    messages = magnitude_violations(row.name, variable, row)
    if not messages and not may_be_unknown and np.isnan(variable.values.astype(float)).any():
        messages = [f"{row.name}: expected numbers; found NaN"]
    return messages
