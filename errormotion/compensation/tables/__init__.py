"""Compensation tables of controllers: an axis's correction at points along it, in the form that a control reads.

`axis_table` samples a correction along an axis; `export` writes it in a format of the entry point group
``errormotion.table_formats`` and states what rounding and interpolation leave.
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
