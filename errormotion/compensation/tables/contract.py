"""What a format of compensation tables is."""

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
    """A table as a control would hold it.

    Attributes
    ----------
    files : mapping of str to str or bytes
        Name of each file, and its content.
    forward, backward : (n,)
        Offsets at the points of the table as they are in the files, rounded, m; alike where the control knows one
        direction.
    between : {"lines", "steps"}
        What the control does between two points: straight lines, or the value of the nearest point.
    removed : float
        Constant that the format cannot hold, m: the offsets in the files are the corrections less this one.
    remarks : tuple of str
        What is to be done at the control, and what was left out; one sentence each.
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
        Control and kind of table, for people.
    source : str
        Where the format is described; what is from memory is labelled so.
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
            A table that the control would refuse, or hold wrongly.
        """
