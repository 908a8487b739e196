"""Report chapter: the log of a monitor."""

from __future__ import annotations

from dataclasses import replace

from errormotion.campaign.monitor.report import chapter
from errormotion.report.document import Part, Source


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a log."""
    return [replace(chapter.part(source, source.key), kind="Log", stated=False)]
