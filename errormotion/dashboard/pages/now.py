"""Page Now: present readings of the instruments of the bench, and those of the last hours."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from datetime import datetime
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from tornado.web import HTTPError

from errormotion.dashboard.figures import live_item
from errormotion.dashboard.pages.page import Guarded
from errormotion.dashboard.watch import SPAN, Present, Watch
from errormotion.kinematics.description import MachineDescription

SPANS = (("10 min", 600), ("1 h", 3600), ("8 h", int(SPAN)))
"""Possible time spans of the history, s."""
SHOWN = 8
"""Number of curves that are selected initially."""
_SENT: WeakKeyDictionary[Present, str] = WeakKeyDictionary()


class _OfTheBench(Guarded):
    def watch(self) -> Watch:
        """Return the watch of this server; HTTPError 404 without a bench."""
        if self.context.watch is None:
            raise HTTPError(404, reason="The dashboard was started without a bench")
        return self.context.watch


class Now(_OfTheBench):
    """The page; `Values` provides its values."""

    async def get(self) -> None:
        """Send the page without values."""
        watch = self.watch()
        names = list(watch.units.items())
        groups: dict[str, list[str]] = {}
        for name, unit in names:
            groups.setdefault(unit, []).append(name)
        outline = machine_outline(watch.plan.description)
        await self.show("now.html.j2", bench=watch.plan.name, groups=groups, spans=SPANS, shown=SHOWN, outline=outline)


class Values(_OfTheBench):
    """Present readings of the bench, as JSON."""

    def get(self) -> None:
        """Send the readings; the document is computed once for all clients."""
        present = self.watch().present()
        if present not in _SENT:
            _SENT[present] = json.dumps(_plain(present), ensure_ascii=False)
        self.set_header("Content-Type", "application/json")
        self.finish(_SENT[present])


class Figure(_OfTheBench):
    """Axes of the history, as JSON for BokehJS; `History` provides their data."""

    async def get(self) -> None:
        """Send axes for the selected quantities."""
        units, names = self.watch().units, self.get_query_arguments("name")
        chosen = {name: units[name] for name in dict.fromkeys(names) if name in units}
        if not chosen:
            raise HTTPError(400, reason="None of these quantities is known")
        await self.send({"item": await self.in_thread(live_item, chosen)})


class History(_OfTheBench):
    """Selected quantities over the last hours, as JSON: reduced, null if unknown."""

    async def get(self) -> None:
        """Send the curves."""
        watch, names = self.watch(), self.get_query_arguments("name")
        text = self.value("span") or str(SPANS[0][1])
        if text not in {str(span) for _, span in SPANS} or len(names) > len(watch.units):
            raise HTTPError(400, reason="Unknown span, or too many names")
        self.set_header("Content-Type", "application/json")
        self.finish(await self.in_thread(_curves, watch, names, float(text)))


def machine_outline(machine: MachineDescription | None) -> dict[str, Any] | None:
    """Return data for the drawing of a machine: travel of X, Y, Z in mm, axes of workpiece and tool side, spindle.

    None without a description, or if the travel of one of these axes is unknown.
    """
    if machine is None or any(axis not in machine.travel for axis in "XYZ"):
        return None
    return {
        "travel": [[1e3 * end for end in machine.travel[axis]] for axis in "XYZ"],
        "table": [axis for axis in "XYZ" if axis not in machine.tool_axes],
        "head": list(machine.tool_axes),
        "spindle": "XYZ".index(machine.spindle_axis),
    }


def _curves(watch: Watch, names: list[str], seconds: float) -> str:
    """Return quantities over the last seconds as a JSON document: times in ms since 1970, UTC, and values."""
    found = {}
    for name, (times, values) in watch.history(names, seconds).items():
        y = [each if math.isfinite(each) else None for each in np.round(values, 6).tolist()]
        found[name] = {"x": np.rint(1e3 * times).astype(np.int64).tolist(), "y": y}
    return json.dumps(found, ensure_ascii=False)


def _plain(present: Present) -> dict[str, Any]:
    """Return the readings for a JSON document: NaN becomes null, times are in ISO 8601."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(each) for key, each in value.items()}
        if isinstance(value, list | tuple):
            return [plain(each) for each in value]
        if isinstance(value, datetime):
            return value.isoformat(timespec="milliseconds")
        return _known(value) if isinstance(value, float) else value

    return dict(plain(asdict(present)))


def _known(value: float) -> float | None:
    return round(float(value), 6) if math.isfinite(value) else None
