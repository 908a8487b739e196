"""Report chapter: direction and origin of a beam."""

from __future__ import annotations

from errormotion.methods.beam_direction.report import chapter, view
from errormotion.report.document import Part, Source


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a result; none for a plan, which has neither planes nor a bar."""
    return [chapter.part(source, source.key)] if view.is_direction(source.errors) else []
