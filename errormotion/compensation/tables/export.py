"""A table in the files of a control, and its errors of rounding and interpolation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from errormotion.compensation.tables.contract import FileText, TableFormat, TableSettings
from errormotion.compensation.tables.table import AxisTable, applied
from errormotion.errors import DatasetError


@dataclass(frozen=True)
class Exported:
    """Files of a table, and its errors.

    Attributes
    ----------
    files : mapping of str to str or bytes
    rounding : float
        Largest difference at the points of the table between the files and the correction, m.
    interpolation : float
        Largest difference over the measured range, including rounding, m.
    uncertainty : float
        Largest standard uncertainty of the correction over the measured range, m; NaN = unknown.
    largest : float
        Largest offset in the files, m.
    points : int
    remarks : tuple of str
        Notes and remarks for the user.
    """

    files: Mapping[str, FileText]
    rounding: float
    interpolation: float
    uncertainty: float
    largest: float
    points: int
    remarks: tuple[str, ...]

    def save(self, folder: Path) -> list[Path]:
        """Write the files into a folder, and return their paths.

        Raises
        ------
        DatasetError
            A file exists; then no file is written.
        """
        paths = {folder / name: content for name, content in self.files.items()}
        if existing := [str(path) for path in paths if path.exists()]:
            raise DatasetError(
                f"{existing[0]} already exists: choose another folder (--out), or remove the file",
                code="table.file.exists",
            )
        folder.mkdir(parents=True, exist_ok=True)
        for path, content in paths.items():
            with path.open("xb") as file:
                file.write(content if isinstance(content, bytes) else content.encode("ascii", "replace"))
        return list(paths)


def export(table: AxisTable, form: TableFormat, settings: TableSettings | None = None) -> Exported:
    """Return the files of a table in a format.

    Raises
    ------
    DatasetError
        A table that the control would reject.
    """
    written = form.write(table, form.Settings() if settings is None else settings)
    rounding, between = [], []
    directions = (
        (table.forward, table.fine_forward, written.forward),
        (table.backward, table.fine_backward, written.backward),
    )
    for exact, fine, stored in directions:
        rounding.append(np.abs(stored + written.removed - exact).max())
        control = applied(table.fine, table.positions, stored, written.between)
        between.append(np.abs(control + written.removed - fine).max())
    return Exported(
        written.files,
        float(max(rounding)),
        float(max(between)),
        float(table.fine_uncertainty.max()),
        float(max(np.abs(written.forward).max(), np.abs(written.backward).max())),
        table.positions.size,
        (*table.notes, *written.remarks),
    )
