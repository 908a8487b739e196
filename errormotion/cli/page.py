"""The files that a command writes: a page, its further forms beside it, and datasets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from errormotion.errors import DatasetError

if TYPE_CHECKING:
    from errormotion.report import Form


@dataclass(frozen=True)
class Page:
    """A page: its file and its form."""

    file: Path
    form: Form

    @property
    def files(self) -> list[Path]:
        """All files that are written."""
        return [self.file, *self.form.beside(self.file)]


def page_of(file: Path | None, pdf: bool, paper: str | None, language: str | None) -> Page | None:
    """Return the page that the options of a command request, or None.

    Raises
    ------
    DatasetError
        The name does not end in .html, or a form of the page is requested without a page.
    """
    if file is None:
        given = [name for name, value in (("--pdf", pdf), ("--paper", paper), ("--language", language)) if value]
        if given:
            raise DatasetError(
                f"{', '.join(given)}: allowed with a page only; add --report PAGE.html", code="option.page.missing"
            )
        return None
    from errormotion.report.write import Form, page_file

    return Page(page_file(file), Form(language or "", paper or "", ("pdf",) if pdf else ()))


def new_files(page: Page | None, *others: Path | None) -> list[Path]:
    """Return the files that a command writes: those that are given, and those of its page.

    Raises
    ------
    DatasetError
        One of them already exists.
    """
    files = [*(each for each in others if each is not None), *(page.files if page is not None else ())]
    for path in files:
        if path.exists():
            raise DatasetError(
                f"{path}: already exists, and a result is never overwritten; give another name", code="file.exists"
            )
    return files


def new_dataset(out: Path) -> None:
    """Check the name of a dataset that a command writes.

    Raises
    ------
    DatasetError
        The name does not end in .nc, or the file already exists.
    """
    if out.suffix != ".nc":
        raise DatasetError(f"{out}: expected a name that ends in .nc (NetCDF-4 file)", code="file.name.ending")
    new_files(None, out)
