"""Figures of merit that several methods have in common."""

from __future__ import annotations

import numpy as np
import xarray as xr

from errormotion.plugins import FigureOfMerit


def last_values(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return the last known value of every error over time, with U (k = 2), m and rad.

    A dataset without ``time`` has none, and so has an error that is unknown at all times.
    """
    if "time" not in errors.dims or errors.sizes["time"] == 0:
        return []
    found = []
    for k, name in enumerate(errors["dof"].values):
        values = np.asarray(errors[str(name)].values, dtype=float)
        known = np.flatnonzero(np.isfinite(values))
        if values.ndim != 1 or known.size == 0:
            continue
        last = int(known[-1])
        variance = float(errors["covariance"].values[last, k, k])
        found.append(
            FigureOfMerit(
                f"{name} after {float(errors['time'].values[last]) / 60:.1f} min",
                float(values[last]),
                float(2.0 * np.sqrt(variance)),
                str(errors[str(name)].attrs["units"]),
            )
        )
    return found
