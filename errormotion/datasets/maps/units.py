"""Units of columns: as programs write them, and as they fit a variable."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

from errormotion.datasets.schemas import Row
from errormotion.datasets.tables.dates import fitting
from errormotion.datasets.tables.table import Table, same
from errormotion.datasets.text.table_reader import unit_of_freedom
from errormotion.datasets.units import convert
from errormotion.errors import DatasetError

_FORMS = """
um: µm, mu, mü, my, micron, microns, mikrometer
mm: millimeter
degC: c, °c, deg c, grad c, celsius
degF: f, °f
s: sek, sec, secs, seconds, sekunden
min: minuten, minutes
h: std, stunden, hours, hrs
ms: msec
day: tage, days, d
/min: u/min, upm, rev/min
deg: °
arcsec: ", '', ´´, arc sec, sec of arc, winkelsekunden
urad: µrad, mikrorad
um/m: µm/m
%: %rh, % rh, %rf, % r.f.
"""
_WRITTEN = {
    form: unit
    for unit, _, forms in (line.partition(": ") for line in _FORMS.strip().splitlines())
    for form in forms.split(", ")
}
"""Units of programs that have another form or no meaning elsewhere, in lower case."""
_UNCLEAR = ("grad",)
"""Units with two meanings: an angle of 1 grad is a degree in German, and a gon elsewhere."""
_ORDER_IS_OPEN = 400
"""Number of dates from which their order is recognised."""


def fitting_unit(text: str, row: Row, freedom: str = "") -> str:
    """Return a unit of a file in a form that is convertible to that of a variable; empty if there is none."""
    plain = same(text).strip()
    decided = unit_of_freedom(row, freedom) if freedom else ""
    goals = (decided,) if decided else row.units or (row.unit or "1",)
    for unit in (_WRITTEN.get(plain.lower(), ""), plain, plain.lower() if plain.isupper() else ""):
        for goal in goals:
            if not unit or is_unclear(unit):
                continue
            if _converts(unit, goal):
                return unit
    return ""


@lru_cache(maxsize=4096)
def _converts(unit: str, goal: str) -> bool:
    try:
        convert(1.0, unit, goal)
    except DatasetError:
        return False
    return True


def stated_unit(table: Table, column: int) -> str:
    """Return the unit of a column in its file; empty if there is none, or a dash in its place."""
    unit = table.units[column] if column < len(table.units) else ""
    return "" if unit in ("-", "--", "1") else unit


def is_unclear(unit: str) -> bool:
    """Return whether a unit has two meanings, so that it must be stated in another form."""
    return unit.lower() in _UNCLEAR


def orders(texts: Sequence[str]) -> list[str]:
    """Return the units with which all dates of a column can be read, the most usual first; empty for other texts."""
    filled = [text for text in texts if text]
    some = filled[:: max(1, len(filled) // _ORDER_IS_OPEN)]
    found = fitting(some)
    if len(found) > 1:  # a day after the 12th shows the order
        days: dict[str, str] = {}
        for text in filled:
            days.setdefault(text[:10], text)
        found = [unit for unit in fitting(list(days.values())) if unit in found]
    return found
