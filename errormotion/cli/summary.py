"""The few numbers of an error dataset that a person looks at first."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

SHOWN = {"m": (1e6, "um"), "rad": (648000 / np.pi, "arcsec")}


def last_values(errors: xr.Dataset) -> list[dict[str, Any]]:
    """Return value and expanded uncertainty (k = 2) of every freedom at the end of a drift.

    A dataset without ``time`` has no end, and gives an empty list.
    """
    if "time" not in errors.dims or errors.sizes["time"] == 0:
        return []
    found = []
    for k, name in enumerate(errors["dof"].values):
        values = np.asarray(errors[str(name)].values, dtype=float)
        seen = np.flatnonzero(np.isfinite(values))
        if values.ndim != 1 or seen.size == 0:
            continue
        last = int(seen[-1])
        factor, unit = SHOWN[errors[str(name)].attrs["units"]]
        variance = float(errors["covariance"].values[last, k, k])
        found.append(
            {
                "name": str(name),
                "value": float(values[last]) * factor,
                "expanded_uncertainty": 2.0 * np.sqrt(variance) * factor,
                "unit": unit,
                "time_min": float(errors["time"].values[last]) / 60.0,
            }
        )
    return found


def notes_of(errors: xr.Dataset) -> list[str]:
    """Return what the method has to say of a result: what is missing, doubtful or assumed."""
    return [str(note) for note in np.atleast_1d(errors.attrs.get("notes", [])) if str(note)]
