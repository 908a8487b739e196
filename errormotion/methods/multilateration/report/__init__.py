"""Report chapters: errors of a volume, and the uncertainty to expect."""

from __future__ import annotations

from errormotion.methods.multilateration.report.chapter import MEASURED, PLANNED
from errormotion.report.document import Part, Source
from errormotion.report.page.language import texts_of


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a result over targets; none for other results."""
    if source.errors["EX"].dims != ("target",):
        return []
    return [(PLANNED if "target_uncertainty" in source.errors else MEASURED).made(source)]


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of this chapter: English text = text in the language."""
    return texts_of(__name__, language)
