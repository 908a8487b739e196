"""The one validator: every dataset, by the schema that it claims."""

from __future__ import annotations

import xarray as xr

from errormotion.datasets.calibrations import inclination as calibration
from errormotion.datasets.error_dataset import error_violations
from errormotion.datasets.raw import raw_violations, variant_of
from errormotion.datasets.schemas import RAW_SCHEMAS, SCHEMA
from errormotion.datasets.tomlfile import nearest
from errormotion.errors import DatasetError


def violations(ds: xr.Dataset) -> list[str]:
    """Return everything in which a dataset breaks its schema, one sentence each; empty if it follows it.

    Parameters
    ----------
    ds : Dataset
        With the attribute ``schema``. Big variables of a raw dataset are looked at in samples, never loaded whole.
    """
    schema = ds.attrs.get("schema")
    if schema == SCHEMA:
        return error_violations(ds)
    if schema == calibration.SCHEMA:
        return calibration.violations(ds)
    raw = variant_of(ds)
    if raw is not None:
        return raw_violations(ds, raw)
    known = {SCHEMA, calibration.SCHEMA, *(known.id for known in RAW_SCHEMAS)}
    if schema is None:
        return [f"attribute 'schema': missing; expected one of {', '.join(sorted(known))}"]
    return [f"attribute 'schema': '{schema}' is not known; {nearest(str(schema), known)}"]


def validate(ds: xr.Dataset) -> None:
    """Refuse a dataset that breaks its schema.

    Raises
    ------
    DatasetError
        Its ``violations`` hold one sentence for each.
    """
    found = violations(ds)
    if found:
        raise DatasetError(f"The dataset breaks its schema ({ds.attrs.get('schema', 'none given')}):", found)
