"""The decision whether a measured value is within its limits.

* ISO 14253-1: conformity is proved if the value is inside the limits by at least the guard band, nonconformity if it is
  outside by more than the guard band; otherwise neither is proved. The guard band is ``guard_factor * U``, with U at
  k = 2. At a limit each of the two proofs is wrong with the probability ``Phi(-2 guard_factor)``: 2.3 % for 1, 5 % for
  0.82 (the conformance probability limit of 95 % of the edition of 2017).
* Simple: only the value is compared with the limits (JCGM 106, 8.2.1). At a limit the decision is wrong in half of all
  cases.
* Shared risk: only the value is compared with the limits if U is at most ``largest_ratio`` times half the tolerance, as
  agreed by customer and supplier (JCGM 106, 8.2.2); otherwise there is no decision.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from errormotion.arrays import Array

Rule = Literal["iso 14253-1", "simple", "shared risk"]
INSIDE, OUTSIDE, OPEN = 1, -1, 0
WORDS: dict[str, dict[int, str]] = {
    "iso 14253-1": {INSIDE: "conformity proved", OUTSIDE: "nonconformity proved", OPEN: "neither proved"},
    "simple": {INSIDE: "within limits", OUTSIDE: "outside limits", OPEN: "not decided"},
    "shared risk": {INSIDE: "within limits", OUTSIDE: "outside limits", OPEN: "not decided"},
}
"""The words of each decision; nothing else writes or compares them."""
_DECISIONS = {word: decision for words in WORDS.values() for decision, word in words.items()}


def decision_of(word: str) -> int:
    """Return the decision that a word of any rule states; OPEN for another word, such as one of an earlier version."""
    return _DECISIONS.get(word, OPEN)


def decide(
    value: Array,
    expanded_uncertainty: Array,
    lower: float,
    upper: float,
    rule: Rule = "iso 14253-1",
    guard_factor: float = 1.0,
    largest_ratio: float = 1.0 / 3.0,
) -> Array:
    """Return INSIDE, OUTSIDE or OPEN for each value.

    Parameters
    ----------
    value, expanded_uncertainty : array
        Values and U (k = 2), of the same shape and unit.
    lower, upper : float
        Limits; infinite if missing.
    rule, guard_factor, largest_ratio
        See the docstring of this module.

    Returns
    -------
    array of int
        OPEN if the value, or the uncertainty that the rule needs, is unknown.
    """
    value, U = np.broadcast_arrays(np.asarray(value, dtype=float), np.asarray(expanded_uncertainty, dtype=float))
    g = guard_factor * U if rule == "iso 14253-1" else np.zeros_like(U)
    inside = (value >= lower + g) & (value <= upper - g)
    outside = (value < lower - g) | (value > upper + g)
    found = np.where(inside, INSIDE, np.where(outside, OUTSIDE, OPEN))
    if rule == "shared risk":
        found = np.where(largest_ratio * half_tolerance(lower, upper) >= U, found, OPEN)
    return np.where(np.isfinite(value), found, OPEN)


def half_tolerance(lower: float, upper: float) -> float:
    """Return half the distance between two limits, or the absolute value of a single limit."""
    if np.isfinite(lower) and np.isfinite(upper):
        return 0.5 * (upper - lower)
    return abs(upper) if np.isfinite(upper) else abs(lower)


def overall(decisions: list[int]) -> int:
    """Return the decision on several limits: OUTSIDE if one is, INSIDE if all are, else OPEN."""
    if OUTSIDE in decisions:
        return OUTSIDE
    return INSIDE if decisions and all(each == INSIDE for each in decisions) else OPEN
