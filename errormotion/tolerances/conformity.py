"""The decision on an error dataset: on each limit that applies to it, and overall.

Figures of merit are computed by the plugin of the method, freedoms are taken from the dataset.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.datasets.results.merit import figures_of, is_planned, of_reference
from errormotion.plugins import FigureOfMerit
from errormotion.tolerances.decision import INSIDE, OPEN, OUTSIDE, WORDS, decide, overall
from errormotion.tolerances.table import Limit, Tolerances

if TYPE_CHECKING:
    import xarray as xr

FIELD_UNITS = {"m": (1e6, "um"), "rad": (648000 / math.pi, "arcsec"), "1": (1.0, "")}

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Row:
    """One limit and the value that determines the decision; SI, k = 2. A missing limit is infinite."""

    name: str
    value: float
    expanded_uncertainty: float
    unit: str
    lower: float
    upper: float
    guard: float
    decision: int
    remark: str = ""


@dataclass(frozen=True)
class Conformity:
    """Decision on one error dataset.

    Attributes
    ----------
    rows : tuple of Row
        A row for each figure and each freedom with limits.
    unused : tuple of str
        Limits that apply to no figure and no freedom of this dataset.
    tolerances : Tolerances
        Limits and rule.
    failure : str
        Why figures could not be computed; empty otherwise.
    """

    rows: tuple[Row, ...]
    unused: tuple[str, ...]
    tolerances: Tolerances
    failure: str = ""

    @property
    def decision(self) -> int | None:
        """INSIDE, OUTSIDE or OPEN; None if no limit applies to this dataset."""
        if not self.rows and not self.failure:
            return None
        return overall([row.decision for row in self.rows] + ([OPEN] if self.failure else []))

    @property
    def verdict(self) -> str:
        """Decision as text; empty if no limit applies to this dataset."""
        return "" if self.decision is None else WORDS[self.tolerances.rule][self.decision]

    def plain(self) -> dict[str, Any]:
        """Return the decision for a JSON file; numbers that are not finite are None."""
        rows = [
            {
                key: None if isinstance(each, float) and not math.isfinite(each) else each
                for key, each in asdict(row).items()
            }
            | {"decision": WORDS[self.tolerances.rule][row.decision]}
            for row in self.rows
        ]
        return {
            "verdict": self.verdict,
            "decision": self.decision,
            "rule": self.tolerances.rule,
            "guard": self.tolerances.guard_text(),
            "limits": rows,
            "unused": list(self.unused),
            "failure": self.failure,
        }

    def lines(self) -> list[str]:
        """Return the decision as lines of text, the overall decision first."""
        if self.decision is None:
            return []
        words = WORDS[self.tolerances.rule]
        counts = [(sum(row.decision == each for row in self.rows), words[each]) for each in (OUTSIDE, OPEN, INSIDE)]
        parts = ", ".join(f"{count} {word}" for count, word in counts if count)
        head = f"Tolerances: {self.verdict} ({self.tolerances.guard_text()})"
        lines = [f"{head}; of {len(self.rows)} limits: {parts}." if parts else f"{head}."]
        if self.failure:
            lines.append(f"The figures of merit could not be computed: {self.failure}")
        order = {OUTSIDE: 0, OPEN: 1, INSIDE: 2}
        return lines + [
            _line(row, words[row.decision]) for row in sorted(self.rows, key=lambda row: order[row.decision])
        ]


def judge(errors: xr.Dataset, tolerances: Tolerances) -> Conformity:
    """Decide on every limit that applies to an error dataset.

    A name in ``figures`` may contain ``*`` for any characters. A freedom is within its limits if all of its known
    points are, and if these are at least the share ``least_known`` of its points; the row states the worst point.
    Points of the reference state, and all that are 0 ± 0, are so by definition and are not counted. Nothing is proved
    by an uncertainty that a note of the dataset doubts.
    """
    failure, figures = "", list[FigureOfMerit]()
    if is_planned(errors):
        return Conformity((), (*tolerances.figures, *tolerances.freedoms), tolerances)
    if tolerances.figures:
        try:
            figures = figures_of(errors)
        except Exception as error:  # error in a foreign plugin
            log.exception("the figures of merit failed")
            failure = f"{type(error).__name__}: {error}"
    stated = judge_figures(figures, tolerances)
    rows, unused = list(stated.rows), [name for name in stated.unused if name not in tolerances.freedoms]
    for name, limit in tolerances.freedoms.items():
        if name in errors.em.names:
            rows.append(_of_freedom(errors, name, limit, tolerances))
        else:
            unused.append(name)
    if tolerances.rule != "simple" and (doubts := errors.em.doubts):
        rows = [_doubted(row, doubts[0]) for row in rows]
    return Conformity(tuple(rows), tuple(unused), tolerances, failure)


def _doubted(row: Row, doubt: str) -> Row:
    """Return a row that proves nothing, since its uncertainty is in doubt."""
    remark = f"the uncertainty is in doubt: {doubt.rstrip('.')}"
    return replace(row, decision=OPEN, remark="; ".join(filter(None, [row.remark, remark])))


def judge_figures(figures: Sequence[FigureOfMerit], tolerances: Tolerances) -> Conformity:
    """Decide on figures of merit only; limits of freedoms are not used."""
    rows, unused = list[Row](), list[str]()
    for pattern, limit in tolerances.figures.items():
        matching = [figure for figure in figures if matches(pattern, figure.name)]
        rows += [_of_figure(figure, limit, tolerances) for figure in matching]
        unused += [] if matching else [pattern]
    return Conformity(tuple(rows), (*unused, *tolerances.freedoms), tolerances)


def matches(pattern: str, name: str) -> bool:
    """Return whether a name matches a pattern, in which ``*`` stands for any characters."""
    first, *rest = pattern.split("*")
    if not rest:
        return name == pattern
    last = rest.pop()
    if not name.startswith(first) or not name.endswith(last) or len(name) < len(first) + len(last):
        return False
    position, end = len(first), len(name) - len(last)
    for part in rest:
        at = name.find(part, position, end)
        if at < 0:
            return False
        position = at + len(part)
    return True


def _of_figure(figure: FigureOfMerit, limit: Limit, tolerances: Tolerances) -> Row:
    return _row(
        figure.name, np.array([figure.value]), np.array([figure.expanded_uncertainty]), figure.unit, limit, tolerances
    )


def _of_freedom(errors: xr.Dataset, name: str, limit: Limit, tolerances: Tolerances) -> Row:
    k = errors.em.names.index(name)
    values = errors.em.estimates().values[..., k]
    U = errors.em.expanded(2.0).values[..., k]
    measured = ~(of_reference(errors) | ((values == 0) & (U == 0)))
    unit = str(errors[name].attrs.get("units", ""))
    row = _row(name, values[measured], U[measured], unit, limit, tolerances)
    known = np.isfinite(values)
    if not known[measured].any() and known.any() and unit == limit.unit:
        return replace(row, remark="only the reference state is known, which is 0 by definition")
    if row.remark or known[measured].all():
        return row
    count, total = int(known[measured].sum()), int(measured.sum())
    remark = f"{count} of {total} points known"
    if row.decision == INSIDE and count < tolerances.least_known * total:
        return replace(row, decision=OPEN, remark=f"{remark}, fewer than {100 * tolerances.least_known:g} %")
    return replace(row, remark=remark)


def _row(name: str, value: Any, U: Any, unit: str, limit: Limit, tolerances: Tolerances) -> Row:
    """Return the decision on values with a common limit, with the worst value."""
    lower, upper = limit.interval
    if unit != limit.unit:
        remark = f"the limit is in {limit.unit}, the value in {unit or 'no unit'}"
        return Row(name, math.nan, math.nan, unit, math.nan, math.nan, math.nan, OPEN, remark)
    known = np.flatnonzero(np.isfinite(value))
    if known.size == 0:
        return Row(name, math.nan, math.nan, unit, lower, upper, math.nan, OPEN, "the value is unknown")
    value, U = value[known], U[known]
    if tolerances.rule != "simple":
        U = np.where(U == 0, np.nan, U)  # no measured value is exact: its uncertainty is not stated
    guard = tolerances.guard_factor * U if tolerances.rule == "iso 14253-1" else np.zeros_like(U)
    decisions = decide(value, U, lower, upper, tolerances.rule, tolerances.guard_factor, tolerances.largest_ratio)
    decision = overall([int(each) for each in np.unique(decisions)])
    deciding = np.flatnonzero(decisions == decision)
    excess = np.maximum(value - upper, lower - value) + np.nan_to_num(guard)
    worst = int(deciding[np.argmax(excess[deciding])])
    remark = "" if math.isfinite(U[worst]) else "the uncertainty is unknown"
    return Row(name, float(value[worst]), float(U[worst]), unit, lower, upper, float(guard[worst]), decision, remark)


def _line(row: Row, word: str) -> str:
    factor, unit = FIELD_UNITS.get(row.unit, (1.0, row.unit))
    limits = [
        f"{text} {each * factor:.4g}"
        for text, each in (("at least", row.lower), ("at most", row.upper))
        if math.isfinite(each)
    ]
    if math.isfinite(row.upper) and row.lower == -row.upper:
        limits = [f"±{row.upper * factor:.4g}"]
    value = "unknown" if math.isnan(row.value) else f"{row.value * factor:.4g}"
    U = "unknown" if math.isnan(row.expanded_uncertainty) else f"{row.expanded_uncertainty * factor:.2g}"
    text = f"{row.name}: {value} {unit}, U = {U} {unit}, limits {' and '.join(limits) or 'unknown'} {unit}: {word}"
    return f"{text} ({row.remark})" if row.remark else text


__all__ = ["INSIDE", "OPEN", "OUTSIDE", "Conformity", "Row", "judge", "judge_figures", "matches"]
