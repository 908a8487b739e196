"""Report chapter: errors of a volume."""

from __future__ import annotations

from errormotion.methods.multilateration.report import chapter, view
from errormotion.report.document import Part, Source
from errormotion.report.page.language import texts_of


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a result over targets; none for other results."""
    return [chapter.part(source, source.key)] if view.is_multilateration(source.errors) else []


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of this chapter: English text = text in the language."""
    return texts_of(__name__, language)
