"""The page that a command writes, and what is written beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from errormotion.errors import DatasetError

if TYPE_CHECKING:
    from errormotion.report import Form


@dataclass(frozen=True)
class Page:
    """A page: its file, and its form."""

    file: Path
    form: Form

    @property
    def files(self) -> list[Path]:
        """All files that are written."""
        return [self.file, *self.form.beside(self.file)]


def page_of(file: Path | None, pdf: bool, paper: str | None, language: str | None) -> Page | None:
    """Return the page that the options of a command ask for; None where none is asked for.

    Raises
    ------
    DatasetError
        The name is not that of a page, or the form of a page is given without the page.
    """
    if file is None:
        given = [name for name, value in (("--pdf", pdf), ("--paper", paper), ("--language", language)) if value]
        if given:
            raise DatasetError(f"{', '.join(given)}: form of a page, and no page is asked for; add --report PAGE.html")
        return None
    if file.suffix != ".html":
        raise DatasetError(f"{file}: expected a name that ends in .html (a page)")
    from errormotion.report import Form

    return Page(file, Form(language or "", paper or "", ("pdf",) if pdf else ()))
