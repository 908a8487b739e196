"""Report chapter: a spindle test after ISO 230-3."""

from __future__ import annotations

from errormotion.methods.spindle_drift.report.chapter import CHAPTER
from errormotion.report.document import Part, Source
from errormotion.report.page.language import texts_of


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a drift; none for a detection of beams, which has the chapter of its component."""
    return [CHAPTER.made(source)] if source.errors.attrs.get("component") == "spindle" else []


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of this chapter: English text = text in the language."""
    return texts_of(__name__, language)
