"""Contents of an error dataset for chapters: variables as floats, units of freedoms, notes as text."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.report.text import SECOND_OF_ARC, UM


def field(errors: xr.Dataset, name: str, *dims: str) -> Array:
    """Return a variable as floats in the order of these dims."""
    return np.asarray(errors[name].transpose(*dims).values, dtype=float)


def unit_of(freedom: int) -> tuple[str, float]:
    """Return the field unit of a freedom by its index, and its size in SI."""
    return UM if freedom < 3 else SECOND_OF_ARC


def remarks(errors: xr.Dataset) -> list[str]:
    """Return the sentences of the attribute ``notes``: a JSON list, a sequence or a single text."""
    found = errors.attrs.get("notes", [])
    if isinstance(found, str):
        try:
            found = json.loads(found)
        except (ValueError, RecursionError):
            found = [found]
    if isinstance(found, str) or not isinstance(found, Sequence | np.ndarray):
        found = [found]
    return [str(note) for note in found if str(note).strip() and not isinstance(note, Mapping)]
