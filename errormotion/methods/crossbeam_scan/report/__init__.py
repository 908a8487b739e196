"""Report chapters and figures of merit: a campaign of crossbeam scans, and the pose of the profiler."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from errormotion.report.document import Part, Source


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a campaign or of a profiler pose; none for other results."""
    from errormotion.methods.crossbeam_scan.report import chapter, pose, view

    if view.is_campaign(source.errors):
        return [chapter.part(source, source.key)]
    return [pose.part(source, source.key)] if view.is_pose(source.errors) else []


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of these chapters: English text = text in the language."""
    from errormotion.report.page.language import texts_of

    return texts_of(__name__, language)
