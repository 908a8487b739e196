"""The effect of a compensation as sentences and as rows of a table, in the customary units."""

from __future__ import annotations

import math

from errormotion.compensation.effect.analysis import DISPLACEMENT
from errormotion.compensation.effect.magnitude import Interval
from errormotion.compensation.effect.result import OPEN, REDUCED, WORSE, Effect, FigurePair, Part
from errormotion.report.text import DASH
from errormotion.tolerances.conformity import FIELD_UNITS

HEAD = ["", "before", "after", "95 %", "reduction", "95 %", "perfect model", "", "outcome"]
"""Columns of `rows`: root mean squares of the errors, and the reduction."""

FIGURES_HEAD = ["figure", "before", "U (k=2)", "after", "U (k=2)", "", "reduction", "95 %"]


def verdict(found: Effect) -> list[str]:
    """Return the effect of the compensation as sentences, the most important one first."""
    lines = []
    whole = next((part for part in found.parts if part.name == DISPLACEMENT), found.parts[0])
    if not math.isfinite(whole.reduction.value):
        lines.append("No conclusion: the errors before the compensation cannot be distinguished from 0.")
    else:
        gained = whole.reduction.value
        change = f"{percent(gained)} less" if gained >= 0 else f"{percent(-gained)} more"
        lines.append(
            f"{whole.name}: {_size(whole.before.value, whole.unit)} before, {_size(whole.after.value, whole.unit)} "
            f"after, {change} (95 % of the reduction: {span(whole.reduction)})."
        )
    of = {
        outcome: [part.name for part in found.parts if part.outcome == outcome and part.correctable]
        for outcome in (REDUCED, WORSE, OPEN)
    }
    lines += [f"{', '.join(of[WORSE])}: larger with the compensation."] if of[WORSE] else []
    lines += [f"{', '.join(of[OPEN])}: no significant change."] if of[OPEN] else []
    if none_left := [part.name for part in found.parts if part.correctable and part.after.low == 0]:
        lines.append(f"{', '.join(none_left)}: the remaining error is not significant compared with the uncertainty.")
    return lines + limits(found)


def limits(found: Effect) -> list[str]:
    """Return the decisions on limits; empty without limits."""
    judged = (("Before", found.before), ("After", found.after), ("Reduction", found.gained))
    lines = [f"{name}. {line}" for name, each in judged if each is not None for line in each.lines()]
    return lines + [f"Tolerances: the limit '{name}' applies to no figure and no freedom" for name in unused(found)]


def unused(found: Effect) -> list[str]:
    """Return the limits that apply to no figure and no freedom."""
    judged = [each for each in (found.before, found.after, found.gained) if each is not None]
    return [name for name in judged[0].unused if all(name in each.unused for each in judged)] if judged else []


def rows(found: Effect) -> list[list[str]]:
    """Return a row for each part."""
    return [_row(part) for part in found.parts]


def _row(part: Part) -> list[str]:
    factor, unit = FIELD_UNITS[part.unit]
    ends = f"{_number(factor * part.after.low)} to {_number(factor * part.after.high)}"
    return [
        part.name,
        _number(factor * part.before.value),
        _number(factor * part.after.value),
        ends,
        percent(part.reduction.value),
        span(part.reduction),
        _number(factor * part.perfect),
        unit,
        part.outcome,
    ]


def figure_rows(found: Effect) -> list[list[str]]:
    """Return a row for each figure of merit."""
    return [_figure_row(pair) for pair in found.figures]


def _figure_row(pair: FigurePair) -> list[str]:
    factor, unit = FIELD_UNITS.get(pair.unit, (1.0, pair.unit))
    numbers = [_number(factor * each) for each in (*pair.before, *pair.after)]
    known = math.isfinite(pair.reduction.value)
    return [pair.name, *numbers, unit, percent(pair.reduction.value), span(pair.reduction) if known else DASH]


def span(interval: Interval) -> str:
    """Return the ends of an interval of shares, %."""
    if interval.low == -math.inf:
        return "unbounded" if interval.high >= 1 else f"below {percent(interval.high)}"
    return f"{percent(interval.low)} to {percent(interval.high)}"


def percent(fraction: float) -> str:
    """Return a fraction in percent, with one decimal above 95 %."""
    if math.isnan(fraction):
        return DASH
    if fraction < -9.995:
        return "below -1000 %"
    return f"{100 * fraction:.1f} %" if fraction > 0.95 else f"{100 * fraction:.0f} %"


def _number(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else DASH


def _size(value: float, unit: str) -> str:
    factor, field = FIELD_UNITS[unit]
    return f"{_number(factor * value)} {field}"
