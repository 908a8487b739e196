"""Interface of a format of compensation tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol

from errormotion.arrays import Array
from errormotion.plugins import PluginSettings

if TYPE_CHECKING:
    from errormotion.compensation.tables.table import AxisTable

FileText = str | bytes
"""Content of a file; text is written in ASCII."""


class TableSettings(PluginSettings):
    """Base of the settings of a format."""


@dataclass(frozen=True)
class Written:
    """A table as stored in a control.

    Attributes
    ----------
    files : mapping of str to str or bytes
        Content of each file by its name.
    forward, backward : (n,)
        Offsets at the points of the table as in the files, rounded, m; equal if the control does not distinguish
        directions.
    between : {"lines", "steps"}
        Interpolation of the control between two points: straight lines, or the value of the nearest point.
    removed : float
        Constant that the format cannot represent, m: the offsets in the files are the corrections less this one.
    remarks : tuple of str
        Steps at the control, and omitted parts; one sentence each.
    """

    files: Mapping[str, FileText]
    forward: Array
    backward: Array
    between: Literal["lines", "steps"] = "lines"
    removed: float = 0.0
    remarks: tuple[str, ...] = field(default=())


class TableFormat(Protocol):
    """A format: a class in the entry point group ``errormotion.table_formats``, under its ``id``.

    Attributes
    ----------
    id : str
    title : str
        Control and kind of table, for display.
    source : str
        Documents of the format; statements from memory are labelled so.
    Settings : type
        A `TableSettings`.
    """

    id: ClassVar[str]
    title: ClassVar[str]
    source: ClassVar[str]
    Settings: ClassVar[type[TableSettings]]

    def write(self, table: AxisTable, settings: Any) -> Written:
        """Return the files of a table.

        Raises
        ------
        DatasetError
            A table that the control would reject or misinterpret.
        """
