"""Compensation tables of controls: the correction at points along an axis, in the file format of a control.

`axis_table` samples a correction along an axis; `export` writes it in a format of the entry point group
``errormotion.table_formats`` and states the errors of rounding and interpolation.
"""

from errormotion.compensation.tables.contract import FileText, TableFormat, TableSettings, Written
from errormotion.compensation.tables.export import Exported, export
from errormotion.compensation.tables.registry import available, get
from errormotion.compensation.tables.table import AxisTable, axis_table

__all__ = [
    "AxisTable",
    "Exported",
    "FileText",
    "TableFormat",
    "TableSettings",
    "Written",
    "available",
    "axis_table",
    "export",
    "get",
]
