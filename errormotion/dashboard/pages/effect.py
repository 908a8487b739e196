"""Page Effect: reduction of the errors by a compensation, from results without and with it."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from errormotion.compensation.effect import Effect, effect, text
from errormotion.compensation.effect.report import write
from errormotion.dashboard.cache import Cache, stamp
from errormotion.dashboard.lab import Choice, Lab
from errormotion.dashboard.pages.page import MAX_MESSAGE, Guarded
from errormotion.dashboard.pages.results import REPORT_POLICY, loaded
from errormotion.errors import ErrormotionError

MAX_LISTED = 300
"""Number of runs in the list."""

EFFECTS: Cache[Effect] = Cache(4)


class _OfTwo(Guarded):
    async def effect(self) -> Effect:
        """Return the effect of the query.

        Raises
        ------
        ErrormotionError
            The runs do not exist, or cannot be compared.
        """
        return await self.in_slow_thread(_effect, self.context.lab, self.value("before", 600), self.value("after", 600))


class EffectOfRuns(_OfTwo):
    """The page."""

    async def get(self) -> None:
        """Show the list of runs, and the effect of the selected ones."""
        chosen = {name: self.value(name, 600) for name in ("before", "after")}
        table = await self.in_thread(self.context.lab.table, Choice())
        found, wrong = None, ""
        try:
            found = await self.effect() if all(chosen.values()) else None
        except ErrormotionError as error:
            wrong = str(error)
        await self.show(
            "effect.html.j2",
            rows=[row for row in table.rows if row.method][:MAX_LISTED],
            chosen=chosen,
            query=self.request.query,
            found=_stated(found) if found is not None else None,
            wrong=wrong[:MAX_MESSAGE],
        )


class Report(_OfTwo):
    """Report of an effect, in a sandbox."""

    async def get(self) -> None:
        """Send the report."""
        found = await self.effect()
        self.set_header("Content-Security-Policy", REPORT_POLICY)
        self.finish(await self.in_slow_thread(_page, self.context.lab, self.value("after", 600), found))


def _effect(lab: Lab, *keys: str) -> Effect:
    files = [lab.file(key, "errors") for key in keys]
    return EFFECTS.get(tuple(stamp(file) for file in files), lambda: effect(*(loaded(file) for file in files)))


def _page(lab: Lab, after: str, found: Effect) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        return write(found, loaded(lab.file(after, "errors")), Path(folder) / "page.html").read_bytes()


def _stated(found: Effect) -> dict[str, Any]:
    """Return the results of an effect as text for the page."""
    return {
        "verdict": text.verdict(found),
        "head": text.HEAD,
        "rows": text.rows(found),
        "figures_head": text.FIGURES_HEAD,
        "figures": text.figure_rows(found),
        "notes": list(found.notes),
    }
