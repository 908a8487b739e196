"""Report chapter: direction and origin of a beam."""

from __future__ import annotations

from errormotion.methods.beam_direction.report import chapter, view
from errormotion.report.document import Part, Source
from errormotion.report.page.language import texts_of


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a result; none for a plan, which contains neither planes nor a bar."""
    return [chapter.part(source, source.key)] if view.is_direction(source.errors) else []


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of this chapter, from English texts to those in the language."""
    return texts_of(__name__, language)
