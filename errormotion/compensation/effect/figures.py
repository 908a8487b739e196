"""Figures of merit of two results side by side, with the reduction of each.

The figures are those of the plugin that made a result. The covariance of two figures follows from the effects of their
common sources if the plugin states them. If it does not, and the results have common sources, the interval is that of
the least favourable correlation.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping, Sequence

import xarray as xr

from errormotion.compensation.effect.magnitude import Interval
from errormotion.compensation.effect.result import FigurePair
from errormotion.datasets.results.merit import figures_of
from errormotion.plugins import FigureOfMerit

ERRORS = ("m", "rad")
"""Units of the figures that a compensation reduces."""

K = 1.959964
"""Coverage factor of 95 %."""

UNKNOWN = (math.nan, math.nan)

log = logging.getLogger(__name__)


def paired(before: xr.Dataset, after: xr.Dataset) -> tuple[tuple[FigurePair, ...], list[str]]:
    """Return the figures of both results, and messages about those that could not be computed."""
    failures: list[str] = []
    found = []
    for name, errors in (("before", before), ("after", after)):
        try:
            found.append(figures_of(errors))
        except Exception as error:  # of a foreign plugin
            log.exception("figures of merit of '%s' failed", name)
            failures.append(f"The figures of '{name}' could not be computed: {type(error).__name__}: {error}")
            found.append([])
    first, second = found
    keys = _identities(before), _identities(after)
    shares = bool(set(keys[0].values()) & set(keys[1].values()))
    partners = _partners(first, second)
    pairs = [_pair(figure, partners.get(figure.name), keys, shares) for figure in first]
    taken = {each.name for each in partners.values()}
    pairs += [
        FigurePair(each.name, each.unit, UNKNOWN, (each.value, each.expanded_uncertainty), Interval(*[math.nan] * 3))
        for each in second
        if each.name not in taken
    ]
    return tuple(pairs), failures


def _identities(errors: xr.Dataset) -> dict[str, str]:
    """Return the identity of each source that has one, by its name."""
    if "source_id" not in errors.coords or "source" not in errors.coords:
        return {}
    both = zip(map(str, errors["source"].values), map(str, errors["source_id"].values), strict=True)
    return {name: identity for name, identity in both if identity}


def _partners(first: Sequence[FigureOfMerit], second: Sequence[FigureOfMerit]) -> dict[str, FigureOfMerit]:
    """Return the figure of the second result for each of the first: of equal name, else apart from numbers."""
    same = {each.name: each for each in second}
    found = {each.name: same[each.name] for each in first if each.name in same}
    rest = [each for each in second if each.name not in found]
    alone = [each for each in first if each.name not in found]
    for each in alone:
        like = [other for other in rest if _form(other.name) == _form(each.name)]
        if len(like) == 1 and sum(_form(other.name) == _form(each.name) for other in alone) == 1:
            found[each.name] = like[0]
    return found


def _form(name: str) -> str:
    return re.sub(r"\d+(\.\d+)?", "#", name)


def _pair(
    a: FigureOfMerit, b: FigureOfMerit | None, keys: tuple[Mapping[str, str], Mapping[str, str]], shares: bool
) -> FigurePair:
    if b is None or a.unit != b.unit:
        return FigurePair(a.name, a.unit, (a.value, a.expanded_uncertainty), UNKNOWN, Interval(*[math.nan] * 3))
    name = a.name if a.name == b.name else f"{a.name} / {b.name}"
    reduction = Interval(math.nan, math.nan, math.nan)
    if a.unit in ERRORS:
        u = a.expanded_uncertainty / 2, b.expanded_uncertainty / 2
        covariance = _covariance(a, b, keys) if shares else 0.0
        reduction = reduction_of((a.value, u[0]), (b.value, u[1]), covariance)
    return FigurePair(name, a.unit, (a.value, a.expanded_uncertainty), (b.value, b.expanded_uncertainty), reduction)


def _covariance(a: FigureOfMerit, b: FigureOfMerit, keys: tuple[Mapping[str, str], Mapping[str, str]]) -> float | None:
    """Return the covariance by the common sources; None if the plugin does not state their effects."""
    if a.influence is None or b.influence is None:
        return None
    of_a = {keys[0][name]: value for name, value in a.influence.items() if name in keys[0]}
    of_b = {keys[1][name]: value for name, value in b.influence.items() if name in keys[1]}
    return sum(value * of_b[key] for key, value in of_a.items() if key in of_b)


def reduction_of(before: tuple[float, float], after: tuple[float, float], covariance: float | None = 0.0) -> Interval:
    """Return 1 less the ratio of the absolute values of two figures, with its interval of 95 % (Fieller 1954).

    Parameters
    ----------
    before, after : (float, float)
        Value and standard uncertainty.
    covariance : float or None
        Of both; None: unknown, then the one of the widest interval.
    """
    (b, ub), (a, ua) = before, after
    if not all(map(math.isfinite, (a, b, ua, ub))) or b == 0:
        return Interval(math.nan, math.nan, math.nan)
    ratio = a / b
    worst = math.copysign(ua * ub, -ratio) if covariance is None else covariance
    # (a - r b)^2 <= K^2 (ua^2 - 2 r c + r^2 ub^2): a quadratic in r
    A, B, C = b**2 - (K * ub) ** 2, -2 * (a * b - K**2 * worst), a**2 - (K * ua) ** 2
    if A <= 0:  # the figure before cannot be distinguished from 0
        return Interval(1 - abs(ratio), -math.inf, 1.0)
    root = math.sqrt(max(B**2 - 4 * A * C, 0.0))
    low, high = (-B - root) / (2 * A), (-B + root) / (2 * A)
    least = 0.0 if low <= 0 <= high else min(abs(low), abs(high))
    return Interval(1 - abs(ratio), 1 - max(abs(low), abs(high)), 1 - least)
