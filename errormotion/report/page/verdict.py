"""The decision on the tolerances at the top of a report: one sentence, one picture, and the table of all limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup
from matplotlib.figure import Figure as Canvas

from errormotion.report import canvas
from errormotion.report.document import Cell, Figure, Table, estimate, or_dash
from errormotion.report.text import significant, typographic
from errormotion.tolerances.conformity import FIELD_UNITS, Conformity, Row
from errormotion.tolerances.decision import INSIDE, OPEN, OUTSIDE, WORDS, overall

TONES = {INSIDE: "inside", OUTSIDE: "outside", OPEN: "open"}
COLOURS = {INSIDE: canvas.GREEN, OUTSIDE: canvas.VERMILLION, OPEN: canvas.ORANGE}
MAX_BARS = 14
"""Limits in the picture, the deciding ones first; the table contains all."""
MAX_NAME = 34
"""Characters of a name in the picture."""
WIDEST = 250.0
"""Per cent of the limit; larger values are drawn at the edge."""
_ORDER = {OUTSIDE: 0, OPEN: 1, INSIDE: 2}


@dataclass(frozen=True)
class Verdict:
    """The decision on all limits that apply to a report.

    Attributes
    ----------
    word : str
        The decision in the words of its rule.
    tone : str
        ``inside``, ``outside`` or ``open``.
    sentence : str
        The deciding limits.
    picture : Figure, optional
        Value and uncertainty of each limit; None if no value is known.
    table : Table
        All limits.
    """

    word: str
    tone: str
    sentence: str
    picture: Figure | None
    table: Table


def verdict(found: Sequence[Conformity]) -> Verdict | None:
    """Return the decision on several error datasets; None if no limit applies to any."""
    judged = [each for each in found if each.decision is not None]
    if not judged:
        return None
    decision = overall([each.decision for each in judged if each.decision is not None])
    words = WORDS[judged[0].tolerances.rule]
    rows = [row for each in judged for row in each.rows]
    rows.sort(key=lambda row: (_ORDER[row.decision], -share(row) if math.isfinite(share(row)) else 0.0))
    rule = judged[0].tolerances.guard_text()
    return Verdict(
        words[decision],
        TONES[decision],
        _sentence(rows, decision, rule, [each.failure for each in judged if each.failure]),
        _picture(rows),
        _table(rows, words, rule),
    )


def share(row: Row) -> float:
    """Return a value in per cent of its tolerance: 100 at a limit, 0 in the middle of two limits or at zero.

    NaN where the value or the scale is unknown.
    """
    if math.isfinite(row.lower) and math.isfinite(row.upper):
        return abs(200.0 * (row.value - row.lower) / (row.upper - row.lower) - 100.0)
    limit, sense = (row.upper, 1.0) if math.isfinite(row.upper) else (row.lower, -1.0)
    return 100.0 + 100.0 * sense * (row.value - limit) / abs(limit) if limit and math.isfinite(limit) else math.nan


def _field(row: Row) -> tuple[float, str]:
    factor, unit = FIELD_UNITS.get(row.unit, (1.0, row.unit))
    return factor, {"um": "µm"}.get(unit, unit)


def _limits(row: Row) -> str:
    factor, unit = _field(row)
    if math.isfinite(row.upper) and row.lower == -row.upper:
        return f"±{_plain(row.upper * factor)} {unit}".strip()
    found = [
        f"{word} {_plain(each * factor)} {unit}".strip()
        for word, each in (("at least", row.lower), ("at most", row.upper))
        if math.isfinite(each)
    ]
    return " and ".join(found)


def _plain(number: float) -> str:
    return typographic(f"{number:.4g}")


def _value(row: Row) -> Cell:
    factor, unit = _field(row)
    return estimate(
        row.value * factor, row.expanded_uncertainty * factor, reason=row.remark or "the value is unknown", unit=unit
    )


def _in_words(row: Row) -> str:
    cell = _value(row)
    if not math.isfinite(row.value):
        return f"{row.name} is unknown ({row.remark}); limit {_limits(row) or 'in another unit'}"
    uncertainty = f" ± {cell.uncertainty}" if cell.uncertainty else ", uncertainty unknown"
    return f"{row.name} is {cell.text}{uncertainty}; limit {_limits(row)}"


def _sentence(rows: Sequence[Row], decision: int, rule: str, failures: Sequence[str]) -> str:
    """Return the deciding limits in one sentence; the first of ``rows`` decides."""
    n = len(rows)
    if not rows:
        return f"The figures of merit could not be computed: {failures[0]}."
    count = sum(row.decision == decision for row in rows)
    deciding = _in_words(rows[0])
    if decision == INSIDE:
        one = "The limit is kept" if n == 1 else "Both limits are kept" if n == 2 else f"All {n} limits are kept"
        return f"{one} ({rule}). Closest to its limit: {deciding}."
    what = "exceeded" if decision == OUTSIDE else "not decided"
    one = f"The limit is {what}" if n == 1 else f"{count} of {n} limits {'is' if count == 1 else 'are'} {what}"
    return f"{one} ({rule}): {deciding}{', and others' if count > 1 else ''}."


def _picture(rows: Sequence[Row]) -> Figure | None:
    """Return a bar for each limit as a share of it, with the expanded uncertainty and the guard band."""
    drawn = [row for row in rows if math.isfinite(row.value) and math.isfinite(_scale(row)[1])][:MAX_BARS]
    if not drawn:
        return None
    high = 0.23 * len(drawn)
    size = (high + 0.5, canvas.WIDTH)

    def paint(figure: Canvas) -> None:
        left, right = 0.085 * min(max(len(_short(row.name)) for row in drawn), MAX_NAME) + 0.1, 1.55
        axes = figure.add_axes((left / size[1], 0.38 / size[0], (size[1] - left - right) / size[1], high / size[0]))
        places = [_place(row, row.value) for row in drawn]
        reach = min(max(115.0, *(1.08 * abs(each) for each in places)), WIDEST)
        low = -reach if any(math.isfinite(row.lower) and math.isfinite(row.upper) for row in drawn) else 0.0
        for k, (row, place) in enumerate(zip(drawn, places, strict=True)):
            colour = COLOURS[row.decision]
            _band(axes, row, k, low)
            axes.barh(k, min(max(place, -reach), reach), height=0.5, color=colour, alpha=0.55, linewidth=0)
            U = row.expanded_uncertainty * _scale(row)[1]
            if math.isfinite(U):
                axes.errorbar(place, k, xerr=U, color=canvas.BLACK, capsize=2.5, linewidth=1)
            axes.plot(min(max(place, -reach), reach), k, "o", color=colour, markersize=3.6)
            cell = _value(row)
            words = f"{cell.text} ± {cell.uncertainty}" if cell.uncertainty else str(cell.text)
            axes.annotate(
                words, (1.0, k), xycoords=("axes fraction", "data"), xytext=(5, 0), textcoords="offset points",
                va="center", color=colour, annotation_clip=False,
            )  # fmt: skip
        for limit in (-100.0, 100.0):
            if limit >= low:
                axes.axvline(limit, color=canvas.BLACK, linewidth=1.0)
        axes.axvline(0, color="#999999", linewidth=0.5)
        axes.set_yticks(range(len(drawn)), [_short(row.name) for row in drawn])
        axes.set_ylim(len(drawn) - 0.5, -0.5)
        axes.set_xlim(low, reach)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("share of the limit / %")

    spans = "; ".join(f"{row.name} {significant(share(row), 3)} %" for row in drawn)
    more = f" The {MAX_BARS} of {len(rows)} limits that decide are drawn." if len(rows) > len(drawn) else ""
    caption = (
        "Values as a share of their limits (black lines), with expanded uncertainty, k = 2. Green: kept; red: "
        f"exceeded; ochre: not decided. Grey: the guard band of each limit.{more}"
    )
    svg: Markup = canvas.draw(paint, "verdict", *size)
    return Figure(svg, caption, f"Share of each limit: {spans}.")


def _short(name: str) -> str:
    return name if len(name) <= MAX_NAME else f"{name[: MAX_NAME - 1]}…"


def _scale(row: Row) -> tuple[float, float]:
    """Return the origin of a row's axis and per cent for each unit of the value; NaN without a scale."""
    if math.isfinite(row.lower) and math.isfinite(row.upper):
        return (row.lower + row.upper) / 2, 200.0 / (row.upper - row.lower)
    limit, sense = (row.upper, 1.0) if math.isfinite(row.upper) else (row.lower, -1.0)
    if not (limit and math.isfinite(limit)):
        return math.nan, math.nan
    scale = 100.0 * sense / abs(limit)
    return limit - 100.0 / scale, scale


def _place(row: Row, value: float) -> float:
    origin, scale = _scale(row)
    return (value - origin) * scale


def _band(axes: object, row: Row, k: int, low: float) -> None:
    """Shade the guard band inside and outside of each limit of a row."""
    if not (math.isfinite(row.guard) and row.guard > 0):
        return
    for limit in (row.lower, row.upper):
        if math.isfinite(limit):
            a, b = sorted((_place(row, limit - row.guard), _place(row, limit + row.guard)))
            axes.barh(k, b - max(a, low), left=max(a, low), height=0.86, color="#9a9a9a", alpha=0.3, linewidth=0)  # type: ignore[attr-defined]


def _table(rows: Sequence[Row], words: dict[int, str], rule: str) -> Table:
    cells: list[list[Cell | str]] = []
    for row in rows:
        factor, unit = _field(row)
        guard = significant(row.guard * factor) if math.isfinite(row.guard) else "—"
        value = _value(row)
        cells.append(
            [
                row.name,
                value,
                _limits(row) or or_dash("—", row.remark or "no limit"),
                or_dash(f"{guard} {unit}" if guard != "—" else guard, row.remark or "no guard band"),
                Cell(words[row.decision], reason=row.remark if math.isfinite(row.value) else ""),
            ]
        )
    return Table(
        f"Decision on each limit: {rule}. After ±: expanded uncertainty, k = 2.",
        ["quantity", "value", "limit", "guard band", "decision"],
        cells,
    )
