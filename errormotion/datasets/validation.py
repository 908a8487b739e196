"""The one validator: every dataset, by the schema that it claims."""

from __future__ import annotations

import xarray as xr

from errormotion import plugins
from errormotion.datasets.error_dataset import error_violations
from errormotion.datasets.raw import raw_violations, variant_of
from errormotion.datasets.schemas import SCHEMA, known_schemas
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
    raw = variant_of(ds)
    if raw is not None:
        return raw_violations(ds, raw)
    owner = plugins.owner_of_schema(str(schema))
    if owner is not None:
        return list(owner.violations(ds))
    known = known_schemas()
    if schema is None:
        return [f"attribute 'schema': missing; expected one of {', '.join(sorted(known))}"]
    return [f"attribute 'schema': '{schema}' is unknown; {nearest(str(schema), known)}"]


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
