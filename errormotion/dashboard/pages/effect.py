"""Effect analysis: what a compensation took off, from a result without it and one with it."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from errormotion.compensation.effect import Effect, effect, text
from errormotion.compensation.effect.report import write
from errormotion.dashboard.kept import Kept, stamp
from errormotion.dashboard.lab import Choice, Lab
from errormotion.dashboard.pages.page import LONGEST_MESSAGE, Guarded
from errormotion.dashboard.pages.results import REPORT_POLICY, loaded
from errormotion.errors import ErrormotionError

MOST_LISTED = 300
"""Runs that are offered."""

MADE: Kept[Effect] = Kept(4)


class _OfTwo(Guarded):
    async def effect(self) -> Effect:
        """Return the effect that the query asks for.

        Raises
        ------
        ErrormotionError
            There are no such runs, or they cannot be compared.
        """
        return await self.apart_slow(_effect, self.context.lab, self.word("before", 600), self.word("after", 600))


class EffectOfRuns(_OfTwo):
    """The page."""

    async def get(self) -> None:
        """Show the runs to choose from, and the effect of those that are chosen."""
        chosen = {name: self.word(name, 600) for name in ("before", "after")}
        table = await self.apart(self.context.lab.table, Choice())
        found, wrong = None, ""
        try:
            found = await self.effect() if all(chosen.values()) else None
        except ErrormotionError as error:
            wrong = str(error)
        self.show(
            "effect.html.j2",
            rows=[row for row in table.rows if row.method][:MOST_LISTED],
            chosen=chosen,
            query=self.request.query,
            found=_stated(found) if found is not None else None,
            wrong=wrong[:LONGEST_MESSAGE],
        )


class Report(_OfTwo):
    """The report of an effect, in a sandbox."""

    async def get(self) -> None:
        """Send it."""
        found = await self.effect()
        self.set_header("Content-Security-Policy", REPORT_POLICY)
        self.finish(await self.apart_slow(_page, self.context.lab, self.word("after", 600), found))


def _effect(lab: Lab, *keys: str) -> Effect:
    files = [lab.file(key, "errors") for key in keys]
    return MADE.get(tuple(stamp(file) for file in files), lambda: effect(*(loaded(file) for file in files)))


def _page(lab: Lab, after: str, found: Effect) -> bytes:
    with tempfile.TemporaryDirectory() as place:
        return write(found, loaded(lab.file(after, "errors")), Path(place) / "page.html").read_bytes()


def _stated(found: Effect) -> dict[str, Any]:
    """Return what the page says of an effect, as text."""
    return {
        "verdict": text.verdict(found),
        "head": text.HEAD,
        "rows": text.rows(found),
        "figures_head": text.FIGURES_HEAD,
        "figures": text.figure_rows(found),
        "notes": list(found.notes),
    }
