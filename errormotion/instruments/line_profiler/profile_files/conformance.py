"""File of a scan for the conformance kit."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import xarray as xr

from errormotion.instruments.temporary import temporary_folder


@cache
def scan_file() -> Path:
    """Return a temporary file with a scan of 350 profiles; three heights are unknown."""
    folder = temporary_folder()
    x, y = 12.5e-6 * np.arange(60), 25e-6 * np.arange(350)
    heights = 1e-3 * np.sin(np.add.outer(700.0 * y, 5000.0 * x))
    heights[10:13, 7] = np.nan
    scan = xr.Dataset(
        {"height": (("profile", "point"), heights, {"units": "m"})},
        {"x": ("point", x, {"units": "m"}), "y": ("profile", y, {"units": "m"})},
    )
    scan.to_netcdf(folder / "scan.nc", engine="h5netcdf")
    return folder / "scan.nc"
