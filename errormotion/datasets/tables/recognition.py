"""Where the table is in a file: delimiter, width, header, units, first and last line of numbers."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from errormotion.datasets.tables.numbers import NUMERIC, no_value

Line = tuple[int, list[str]]
"""Number of a line and its fields."""

DELIMITERS = ("\t", ";", "|", ",", " ")
"""In order of preference where several fit."""
SAMPLE = 400
"""Number of lines from which the form of a table is recognised."""
_SHARE = 0.9
"""Share of numbers and dates from which a column is one of numbers."""

# A date, a time of day, or both; which order of day and month it has is left to `dates`.
_CLOCK = (
    r"[0-9]{1,6}[:.][0-9]{2}(?:[:.][0-9]{2}(?:[.,:][0-9]{1,9})?)?"
    r"(?:\s*[AaPp]\.?[Mm]\.?)?(?:Z|[+-][0-9]{2}:?[0-9]{2})?"
)
_DAY = (
    r"(?:[0-9]{1,4}(?P<sign>[-/. ])(?:[0-9]{1,2}|[A-Za-zÄä]{3,9}\.?)(?P=sign)[0-9]{2,4}"
    r"|[A-Za-zÄä]{3,9}\.? [0-9]{1,2},? [0-9]{4})"
)
_DATE = re.compile(rf"{_DAY}(?:(?:\s*[T,]\s*|\s+|[_-]){_CLOCK})?|{_CLOCK.replace('[:.]', ':')}")
_WORDS = (
    "mean average avg min max minimum maximum std stdev sd s sum total count n range median sigma "
    "mittelwert mittel summe anzahl spannweite standardabweichung"
)
_STATISTICS = frozenset(_WORDS.split())
"""First words of lines below a table that are computed from it."""
_BRACKETS = re.compile(r"\(.*\)|\[.*\]|<.*>")
_UNIT = re.compile(
    r"[µμu]m|[mcnk]?m|°[CF]?|deg[CF]?|[CFKsh]|m?s|min|[mµμu]?rad|arcsec|hPa|mbar|k?Pa|%(?: ?r[hH])?|%RH|[1U]?/min|rpm"
    r"|mm/min|m?V|m?A|[kM]?Hz|um/m|µm/m|\"|''"
)


@dataclass(frozen=True)
class Body:
    """Place of a table.

    Attributes
    ----------
    width : int
        Number of fields of a row.
    first, last : int
        Index of the first and the last line of numbers among the lines that were given.
    header, units : int or None
        Index of the line with the names, and with the units.
    numeric : tuple of int
        Fields that contain numbers or dates.
    """

    width: int
    first: int
    last: int
    header: int | None
    units: int | None
    numeric: tuple[int, ...]


def split(line: str, delimiter: str) -> list[str]:
    """Return the fields of a line; csv.Error if quotes are not balanced."""
    if delimiter == " ":
        line = line.strip().replace("\t", " ")
    (fields,) = csv.reader([line], delimiter=delimiter, skipinitialspace=True, strict=True)
    return [field.strip() for field in fields]


def is_data(text: str, missing: Sequence[str] = ()) -> bool:
    """Return whether a cell is a number, a date, a time, or stands for no value."""
    return len(text) < 64 and (
        NUMERIC.fullmatch(text) is not None or no_value(text, missing) or _DATE.fullmatch(text) is not None
    )


def delimiter_of(lines: Sequence[str], missing: Sequence[str] = ()) -> str:
    """Return the delimiter with which most lines of a sample have an equal number of fields, all numbers or dates.

    The header is compared as well: a delimiter that gives it another width is a part of the numbers.
    """
    best, chosen = -1.0, ","
    for delimiter in DELIMITERS:
        rows = []
        for line in lines:
            try:
                rows.append(split(line, delimiter))
            except csv.Error:  # reported when the line is read
                rows.append(line.split(delimiter))
        filled = [row for row in rows if len(row) > 1]
        score = 0.0
        if filled:
            shares = [sum(is_data(text, missing) for text in row) / len(row) for row in filled]
            widths = Counter(len(row) for row, share in zip(filled, shares, strict=True) if share >= 0.5)
            if widths:
                width = widths.most_common(1)[0][0]
                of_width = [k for k, row in enumerate(filled) if len(row) == width]
                score = sum(shares[k] for k in of_width) / len(lines)
                heads = sum(
                    len(row) in (width, width - 1, width + 1) and shares[k] < 0.5 for k, row in enumerate(filled)
                )
                score *= 1.0 if heads else 0.9
        # Blanks also separate the words of a text and the parts of a date above the table.
        if score > best + (0.2 if delimiter == " " and best > 0 else 1e-9):
            best, chosen = score, delimiter
    if chosen == "," and _one_column(lines, missing):
        return "|"
    if best <= 0.3 and sum(is_data(line.strip(), missing) for line in lines) >= best * len(lines):
        return "|"  # one column: a sign that occurs in no number
    return chosen


def _one_column(lines: Sequence[str], missing: Sequence[str]) -> bool:
    """Return whether lines with one comma each are one column of numbers with decimal commas, below a name without."""
    numbers = [line for line in lines if re.fullmatch(r"\s*[+-]?[0-9]+,[0-9]+\s*", line)]
    others = [line for line in lines if line not in numbers]
    return bool(numbers and others) and not any("," in line or is_data(line.strip(), missing) for line in others)


def body_of(rows: Sequence[Line], missing: Sequence[str], header: bool | None, slack: int = 1) -> Body | None:
    """Return the place of the table in lines that are split into fields; None if there are no rows of numbers.

    Parameters
    ----------
    rows : sequence of (int, list of str)
        Lines without empty ones and comments.
    missing : sequence of str
        Texts that stand for no value.
    header : bool, optional
        Whether there is a header, if it is stated.
    slack : int
        Number of fields by which the line of names may differ from the rows.
    """
    sample = _spread(rows)
    shares = [(len(row), [is_data(text, missing) for text in row]) for _, row in sample]
    widths = Counter(size for size, kinds in shares if sum(kinds) > len(kinds) / 2 or sum(kinds) > 2)
    widths = widths or Counter(size for size, kinds in shares if any(kinds))
    if not widths:
        return None
    named = {size for size, kinds in shares if not any(kinds)}

    def weight(size: int) -> tuple[int, int]:
        # A few wide rows count more than many lines of name and value above them; a line of names confirms a width.
        return widths[size] ** 2 * size * (4 if size in named else 1), size

    width = max(widths, key=weight)
    # The rows are the lines with most numbers; a line of names has none, one of statistics a word in their place.
    inside = [
        (sum(kind and text != "" for kind, text in zip(kinds, row, strict=True)), row)
        for (size, kinds), (_, row) in zip(shares, sample, strict=True)
        if size == width
    ]
    most = max(count for count, _ in inside)
    middle = [row for count, row in inside if count >= max(1, most - 1)]
    numeric = []
    for k in range(width):
        cells = [row[k] for row in middle]
        filled = [text for text in cells if not no_value(text, missing)]
        wrong = sum(not is_data(text, missing) for text in filled)
        if len(filled) > wrong and (wrong <= (1 - _SHARE) * len(filled) or wrong == 1 < len(filled) - 1):
            numeric.append(k)
    if not numeric:
        return None

    def is_row(fields: Sequence[str]) -> bool:
        return (
            len(fields) == width
            and all(is_data(fields[k], missing) for k in numeric)
            and any(fields[k] not in ("", "-") for k in numeric)
        )

    def is_damaged(fields: Sequence[str]) -> bool:
        """Whether a line beside the rows is one of them with wrong cells or fields, and no header or text."""
        cells = [fields[k] for k in (numeric if len(fields) == width else range(len(fields))) if fields[k]]
        numbers = [text for text in cells if is_data(text, missing)]
        if not numbers or numbers == [str(k) for k in range(1, len(numbers) + 1)]:
            return False  # also names such as Target, 1, 2, 3
        word = re.sub(r"[^\w]", "", fields[0]).lower()
        if word in _STATISTICS or (0 in numeric and not any(sign.isdigit() for sign in word)):
            return False
        digits = sum(sign.isdigit() for sign in word)
        begins = 0 in numeric and (is_data(fields[0], missing) or 2 * digits >= len(word))
        return begins or len(fields) != width or 2 * len(numbers) > len(cells)

    def is_below_names(above: Sequence[str], fields: Sequence[str]) -> bool:
        """Whether a line with a number is below one that has only names."""
        names = len(above) == len(fields) and not any(NUMERIC.fullmatch(text) for text in above)
        return names and any(NUMERIC.fullmatch(text) for text in fields)

    first = 0 if header is False else next((k for k, (_, row) in enumerate(rows) if is_row(row)), None)
    if first is None:
        return None
    last = next(k for k in range(len(rows) - 1, -1, -1) if k == first or is_row(rows[k][1]))
    while first > (1 if header else 0) and (
        is_damaged(rows[first - 1][1]) or (first > 1 and is_below_names(rows[first - 2][1], rows[first - 1][1]))
    ):
        first -= 1
    while last < len(rows) - 1 and is_damaged(rows[last + 1][1]):
        last += 1
    names, units = (None, None) if header is False else _heads(rows, first, width, slack)
    if header and names is None and first == 0:
        names, first = 0, 1
    return Body(width, first, last, names, units, tuple(numeric))


def is_unit(text: str) -> bool:
    """Return whether a cell below the name of a column is its unit: in brackets, or a usual unit."""
    return _BRACKETS.fullmatch(text) is not None or _UNIT.fullmatch(text) is not None


def _heads(rows: Sequence[Line], first: int, width: int, slack: int) -> tuple[int | None, int | None]:
    """Return the indices of the lines of names and units above the first row of numbers."""
    above = [k for k in range(max(0, first - 3), first) if abs(len(rows[k][1]) - width) <= slack and any(rows[k][1])]
    if not above or above[-1] != first - 1:
        return None, None
    filled = [text for text in rows[first - 1][1] if text]
    units = [text for text in filled if text not in ("-", "1")]
    plain = all(map(is_unit, units)) if units else all(text == "-" for text in filled)
    if len(above) > 1 and above[-2] == first - 2 and plain:
        return first - 2, first - 1
    return first - 1, None


def _spread(rows: Sequence[Line]) -> list[Line]:
    """Return lines from the beginning, the middle and the end, in their order."""
    if len(rows) <= SAMPLE:
        return list(rows)
    third = SAMPLE // 3
    middle = len(rows) // 2
    return [*rows[:third], *rows[middle : middle + third], *rows[-third:]]


def spread(lines: Iterable[str]) -> list[str]:
    """Return a sample of lines that are not empty."""
    filled = [line for line in lines if line.strip()]
    return [line for _, [line] in _spread([(0, [line]) for line in filled])]
