"""Numbers in text: decimal sign, signs between thousands, and texts that stand for no value."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np

from errormotion.arrays import Array

NUMBER = re.compile(r"[+-]?(?:[0-9]++(?:\.[0-9]*+)?|\.[0-9]++)(?:[eE][+-]?[0-9]++)?")
"""A decimal number; possessive, so that the time for a long text is proportional to its length."""
_BETWEEN = "[.,' \u00a0\u202f\u2019]"
NUMERIC = re.compile(
    rf"[+-]?(?:[0-9]{{1,3}}(?P<between>{_BETWEEN})[0-9]{{3}}(?:(?P=between)[0-9]{{3}})*+(?:[.,][0-9]*+)?"
    r"|[0-9]++(?:[.,][0-9]*+)?|[.,][0-9]++)(?:[eE][+-]?[0-9]++)?"
)
"""A number with any decimal sign and signs between thousands, to tell it from text."""
NO_VALUE = frozenset(
    [
        "nan",
        "na",
        "n/a",
        "#n/a",
        "#nv",
        "null",
        "none",
        "ol",
        "ovl",
        "ovld",
        "overload",
        "over",
        "inf",
        "+inf",
        "-inf",
        "infinity",
        "error",
        "err",
        "open",
        "overrange",
    ]
)
"""Texts that loggers write in place of a value, in lower case."""
OVERFLOW = 9.9e37
"""Magnitude from which SCPI instruments mean infinity (9.9e37) and no number (9.91e37), SCPI-99, volume 1, 7.2.1."""

_PLAIN = str.maketrans("\u00a0\u202f\u2007\u2019", "   '")
_DASHES = re.compile(r"[-–—*?]+(?:[.,][-–—*?]+)?")
_GROUPS = re.compile(r"[+-]?[1-9][0-9]{0,2}(?:([.,])[0-9]{3})(?:\1[0-9]{3})*")


def no_value(text: str, stated: Iterable[str] = ()) -> bool:
    """Return whether a cell stands for no value: empty, a text such as ``OL`` or ``---.--``, or a stated one."""
    return not text or text.lower() in NO_VALUE or _DASHES.fullmatch(text) is not None or text in stated


def without_overflow(values: Array, stated: Iterable[str] = ()) -> Array:
    """Return numbers with NaN where a number stands for no value: an overflow, or one of the stated numbers."""
    absent = np.abs(values) >= OVERFLOW
    for text in stated:
        if NUMBER.fullmatch(text):
            absent |= values == float(text)
    return np.where(absent, np.nan, values) if absent.any() else values


def plain_spaces(text: str) -> str:
    """Return a text with the usual blank and apostrophe in place of their typographic forms."""
    return text.translate(_PLAIN)


def signs(texts: Iterable[str]) -> tuple[str, str, str]:
    """Return decimal sign and sign between thousands of a sample of cells, and a cell that leaves them open.

    A sign that occurs twice in a cell separates thousands; of two signs the last one is the decimal sign. A single
    comma is the decimal sign, unless every cell with a comma may as well have groups of three digits, such as 1,250.
    """
    commas, points, both = [], [], []
    groups: set[str] = set()
    for text in texts:
        if not NUMERIC.fullmatch(text):
            continue
        groups |= {sign for sign in plain_spaces(text) if sign in " '"}
        if "," in text and "." in text:
            both.append(text)
        elif "," in text:
            commas.append(text)
        elif "." in text:
            points.append(text)
    if both:
        decimal = max(",.", key=both[0].rfind)
        return decimal, "." if decimal == "," else ",", ""
    between = groups.pop() if len(groups) == 1 else ""
    if commas and points:
        # 1,234 beside 0.5: the comma separates thousands if every cell with one has groups of three digits
        if all(_GROUPS.fullmatch(text) for text in commas):
            return ".", ",", ""
        if all(_GROUPS.fullmatch(text) for text in points):
            return ",", ".", ""
        return "", "", commas[0]
    for sign, cells in ((",", commas), (".", points)):
        if any(text.count(sign) > 1 for text in cells):
            return "." if sign == "," else ",", sign, ""
    if commas:
        open_ = all(_GROUPS.fullmatch(text) for text in commas)
        return ",", between, commas[0] if open_ else ""
    return ".", between, ""
