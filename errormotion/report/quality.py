"""Data quality: valid and missing samples, and gaps."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from errormotion.report.document import Block, Text
from errormotion.report.fields import remarks
from errormotion.report.text import fixed, integer, listed, minutes, percent


def gaps(valid: np.ndarray, time: np.ndarray) -> tuple[int, float]:
    """Return the number of gaps and the duration of the longest one in the unit of time.

    Parameters
    ----------
    valid : ndarray of bool, (n,)
        Whether an instant has a valid sample.
    time : ndarray, (n,)
    """
    if valid.size < 2 or valid.all():
        return 0, 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[True], valid, [True]]).astype(np.int8)))
    starts, ends = edges[::2], edges[1::2]
    step = float(np.median(np.diff(time)))
    longest = max(time[stop - 1] - time[start] for start, stop in zip(starts, ends, strict=True))
    return len(starts), float(longest) + step


def notes(errors: xr.Dataset) -> list[Block]:
    """Return the notes of the method."""
    return [Text(note, "warning") for note in remarks(errors)]


def sentences(errors: xr.Dataset, raw: xr.Dataset | None) -> list[Block]:
    """Return the completeness: instants, gaps in time, and the counts in the raw dataset."""
    blocks: list[Block] = []
    time = np.asarray(errors["time"].values, float) if "time" in errors.coords else np.array([])
    if time.size > 2:
        step = np.diff(time)
        interval = float(np.median(step))
        missing = np.flatnonzero(step > 1.5 * interval)
        words = f"{integer(time.size)} instants, one every {fixed(interval, 3).rstrip('0').rstrip('.,')} s"
        if missing.size:
            words += f"; the time axis has {len(missing)} gap(s), the longest {minutes(float(step[missing].max()))}"
        blocks.append(Text(f"{words}."))
    seen = [name for name in ("EX", "EY", "EZ", "EA", "EB", "EC") if np.isfinite(errors[name].values).any()]
    shares: dict[float, list[str]] = {}
    for name in seen:
        shares.setdefault(float(np.isfinite(errors[name].values).mean()), []).append(name)
    for share, names in shares.items():
        if share < 1:
            kind = "plain" if share > 0.999 else "warning"
            places = "instants" if errors["EX"].dims == ("time",) else "places"
            blocks.append(Text(f"{listed(names)}: determined at {percent(share)} of the {places}.", kind))
    counted = counts(errors, raw)
    if counted:
        words = ", ".join(f"{name} {number}" for name, number in counted.items())
        blocks.append(Text(f"Counts of the measurement: {words}."))
    return blocks


def counts(errors: xr.Dataset, raw: xr.Dataset | None) -> dict[str, str]:
    """Return the counts of dropped and invalid samples in result and raw dataset, by name."""
    found = {}
    attributes = {} if raw is None else raw.attrs
    for name in ("dropped", "dropped_samples", "invalid_samples"):
        if name in attributes:
            found[name.removesuffix("_samples") + " samples"] = integer(float(attributes[name]))
        elif name in errors:
            values = np.atleast_1d(np.asarray(errors[name].values, float))
            found[name.removesuffix("_samples") + " samples"] = " + ".join(integer(value) for value in values)
    for reason, number in _reasons(attributes.get("invalid")).items():
        found[f"invalid because of {str(reason).replace('_', ' ')}"] = integer(float(number))
    return found


def _reasons(invalid: Any) -> Mapping[str, Any]:
    """Return counts by reason, from a mapping or its JSON text."""
    if isinstance(invalid, str):
        try:
            invalid = json.loads(invalid)
        except (ValueError, RecursionError):
            return {}
    return invalid if isinstance(invalid, Mapping) else {}
