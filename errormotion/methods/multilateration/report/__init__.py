"""Report chapter: errors of a volume."""

from __future__ import annotations

from errormotion.methods.multilateration.report import chapter, view
from errormotion.report.document import Part, Source


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a result over targets; none for other results."""
    return [chapter.part(source, source.key)] if view.is_multilateration(source.errors) else []
