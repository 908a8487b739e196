"""Instants: the attribute ``start`` of datasets, ISO 8601 with an offset from UTC."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import xarray as xr

from errormotion.errors import DatasetError

SWITCHING = 1.0
"""Time that a control needs to switch a compensation, s."""


def later(start: str, seconds: float) -> str:
    """Return the instant some seconds after another one, in UTC to the microsecond; empty if ``start`` is empty.

    Raises
    ------
    DatasetError
        ``start`` is not an instant with an offset from UTC.
    """
    if not start:
        return ""
    try:
        instant = datetime.fromisoformat(start)
    except (TypeError, ValueError):
        instant = datetime.min
    if instant.tzinfo is None:
        raise DatasetError(
            f"start: expected an instant such as 2026-03-01T08:00:00+00:00; found '{start}'", code="time.start.form"
        )
    return (instant.astimezone(UTC) + timedelta(seconds=seconds)).isoformat()


def between(start: str, end: str) -> float:
    """Return the seconds from one instant to another; DatasetError as of `later`."""
    first, last = (datetime.fromisoformat(later(each, 0.0) or "x") for each in (start, end))
    return (last - first).total_seconds()


def start_of(ds: xr.Dataset, seconds: float = 0.0) -> str:
    """Return the instant some seconds after the attribute ``start`` of a dataset, in UTC.

    Empty if the dataset states no start, or one without an offset from UTC.
    """
    try:
        return later(str(ds.attrs.get("start", "")), seconds)
    except DatasetError:
        return ""
