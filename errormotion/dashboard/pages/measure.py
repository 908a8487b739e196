"""Measure: choose or edit a campaign, see its plan, start it, follow it, answer it and stop it."""

from __future__ import annotations

from errormotion.dashboard.pages.page import Guarded


class Measure(Guarded):
    """The page."""

    async def get(self) -> None:
        """Show the campaign files and the runs in progress."""
        self.show("measure.html.j2", control=self.context.control)


HANDLERS: tuple[tuple[str, type[Guarded]], ...] = ((r"/measure", Measure),)
"""Addresses of this page."""
