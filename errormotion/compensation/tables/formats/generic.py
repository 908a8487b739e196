"""CSV and NetCDF, for controls without a specific format."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import xarray as xr

from errormotion.compensation.tables.contract import FileText, TableSettings, Written
from errormotion.compensation.tables.table import AxisTable

DECIMALS = 6
"""Of a value in mm."""


class GenericTable:
    """The format."""

    id: ClassVar[str] = "generic"
    title: ClassVar[str] = "CSV and NetCDF"
    source: ClassVar[str] = "this project"
    Settings: ClassVar[type[TableSettings]] = TableSettings

    def write(self, table: AxisTable, settings: TableSettings) -> Written:  # noqa: ARG002 - there are none
        """Return a CSV file in mm and a NetCDF file in m."""
        columns = [table.positions, table.forward, table.backward, table.uncertainty]
        rows = [",".join(f"{1e3 * value + 0.0:.{DECIMALS}f}" for value in row) for row in zip(*columns, strict=True)]
        sign = f"sign: offset = correction, added to the command of {table.component}"
        names = "position_mm,offset_forward_mm,offset_backward_mm,standard_uncertainty_mm"
        text = "\n".join([*(f"# {line}" for line in (*table.comments, sign, "unit: mm")), names, *rows]) + "\n"
        held = [np.round(1e3 * offset, DECIMALS) / 1e3 for offset in (table.forward, table.backward)]
        files: dict[str, FileText] = {f"{table.name}.csv": text, f"{table.name}.nc": _netcdf(table, sign)}
        return Written(files, held[0], held[1])


def _netcdf(table: AxisTable, sign: str) -> bytes:
    metres = {"units": "m"}
    found = xr.Dataset(
        {
            "offset_forward": ("position", table.forward, metres),
            "offset_backward": ("position", table.backward, metres),
            "standard_uncertainty": ("position", table.uncertainty, metres),
        },
        {"position": ("position", table.positions, metres)},
        {"axis": table.axis, "component": table.component, "comments": "\n".join([*table.comments, sign])},
    )
    return bytes(found.to_netcdf(engine="h5netcdf"))
