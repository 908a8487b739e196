"""The validator of all datasets, according to their attribute ``schema``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import xarray as xr

from errormotion import plugins
from errormotion.datasets.files.tomlfile import nearest
from errormotion.datasets.raw import raw_violations, variant_of
from errormotion.datasets.results.checks import error_violations
from errormotion.datasets.schemas import SCHEMA, RawSchema, known_schemas
from errormotion.errors import DatasetError, ErrormotionError, MethodError


def violations(ds: xr.Dataset, tables: Sequence[RawSchema] = ()) -> list[str]:
    """Return every violation of the schema of a dataset, one sentence each.

    Parameters
    ----------
    ds : Dataset
        With the attribute ``schema``. Large variables of a raw dataset are checked in samples.
    tables : sequence of RawSchema, optional
        Raw schemas that precede those of the installed plugins, for a plugin that is not installed.
    """
    schema = ds.attrs.get("schema")
    if schema == SCHEMA:
        return error_violations(ds)
    raw = variant_of(ds, tables)
    if raw is not None:
        return raw_violations(ds, raw)
    owner = plugins.owner_of_schema(str(schema))
    if owner is not None:
        return list(owner.violations(ds))
    known = known_schemas()
    if schema is None:
        return [f"attribute 'schema': missing; expected one of {', '.join(sorted(known))}"]
    return [f"attribute 'schema': '{schema}' is unknown; {nearest(str(schema), known)}"]


@contextmanager
def explained(path: str | Path, ds: xr.Dataset) -> Iterator[None]:
    """Report the violations of the schema of a file if its evaluation fails.

    Raises
    ------
    DatasetError
        The evaluation ended with an error of Python, and the dataset breaks its schema; a sentence for each violation.
    """
    try:
        yield
    except ErrormotionError:
        raise
    except Exception as error:
        messages = violations(ds)
        if not messages:
            raise
        raise DatasetError(
            f"{path}: breaks its schema ({ds.attrs.get('schema', 'none given')}):", messages, code="schema.violated"
        ) from error


def validate(ds: xr.Dataset, tables: Sequence[RawSchema] = ()) -> None:
    """Refuse a dataset that breaks its schema; ``tables`` as in `violations`.

    Raises
    ------
    DatasetError
        Its attribute ``violations`` contains one sentence for each violation.
    """
    messages = violations(ds, tables)
    if messages:
        raise DatasetError(
            f"The dataset breaks its schema ({ds.attrs.get('schema', 'none given')}):", messages, code="schema.violated"
        )


def checked_raw(raw: xr.Dataset, method: plugins.Method) -> xr.Dataset:
    """Return a raw dataset that follows the raw schema of a method; without an attribute ``schema`` it gets this one.

    Raises
    ------
    DatasetError
        It breaks its schema; see `validate`.
    MethodError
        It has the schema of another method.
    """
    schema = method.needs.raw_schema
    schema_found = raw.attrs.get("schema", schema)
    now = plugins.present_schema(str(schema_found), method)
    validate(raw.assign_attrs(schema=now), tuple(method.raw_schemas))
    if now != schema:
        raise MethodError(
            f"{method.info.id} reads raw data of schema {schema}; found {schema_found}.", code="schema.other"
        )
    return raw.assign_attrs(schema=schema_found)
