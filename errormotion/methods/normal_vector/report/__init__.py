"""Report chapter: probed balls during a warm-up."""

from __future__ import annotations

from errormotion.methods.normal_vector.report.chapter import CHAPTER
from errormotion.report.document import Part, Source
from errormotion.report.page.language import texts_of


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a result over time; none for other results."""
    return [CHAPTER.made(source)] if source.errors["EX"].dims == ("time",) else []


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of this chapter: English text = text in the language."""
    return texts_of(__name__, language)
