"""Report chapters: positioning of a linear axis after ISO 230-2, diagonals, a moving axis."""

from __future__ import annotations

from errormotion.datasets.results.merit import is_planned
from errormotion.methods.linear_positioning.report import axis, diagonals, moving
from errormotion.report.document import Part, Source
from errormotion.report.page.language import texts_of


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a result; none for a plan, which has no readings."""
    if is_planned(source.errors):
        return []
    kinds = {"distortion": moving.CHAPTER, "squareness": diagonals.CHAPTER}
    chapter = next((kinds[name] for name in kinds if name in source.errors), axis.CHAPTER)
    return [chapter.made(source)]


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of this chapter, from English texts to those in the language."""
    return texts_of(__name__, language)
