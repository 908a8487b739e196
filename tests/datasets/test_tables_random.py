"""Random tables in the forms of many programs are read rightly or refused, never wrongly without a word."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest

from errormotion.datasets.tables.format import Format
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.tables.reading import read_table
from errormotion.errors import DatasetError

FILES = 400
READ = 0.9
"""Smallest share of the files that are read; others, such as 1,250 alone, are refused."""
NAMES = ("Zeit", "X1", "Sensor 2", "Temp", "Pos. X", "Länge", "ch_4", "Weg (roh)", "A", "e1")
ABOVE = ("Program 3.1", "Machine: M7", "Operator\tMeier", "Date: 2026-05-04 10:12", "", "Serial;1234")
UNITS = ("mm", "µm", "°C", "s", "1/min", "")


def number(value: float, digits: int, decimal: str, thousands: str) -> str:
    whole, _, rest = f"{abs(value):.{digits}f}".partition(".")
    groups = []
    while len(whole) > 3 and thousands:
        whole, last = whole[:-3], whole[-3:]
        groups.insert(0, last)
    text = thousands.join([whole, *groups]) + (decimal + rest if rest else "")
    return ("-" if value < 0 and float(f"{value:.{digits}f}") else "") + text


def written(rng: random.Random) -> tuple[bytes, np.ndarray, list[str]]:
    """Return a file, its numbers (n, m) and names of the columns."""
    m, n = rng.randint(2, 7), rng.choice((2, 3, 5, 20, 60))
    decimal = rng.choice(".,")
    delimiter = rng.choice([sign for sign in "\t;,| " if sign != decimal])
    thousands = rng.choice([""] * 4 + [sign for sign in ".,'" if sign not in (decimal, delimiter)])
    digits = [rng.choice((0, 1, 2, 4)) for _ in range(m)]
    scale = [rng.choice((1.0, 50.0, 2000.0)) for _ in range(m)]
    values = np.array([[round(rng.gauss(0, 1) * scale[k], digits[k]) for k in range(m)] for _ in range(n)])
    values[:, 0] = np.arange(n) * 0.5 if digits[0] else np.arange(n)
    cells = [[number(values[i, k], digits[k], decimal, thousands) for k in range(m)] for i in range(n)]
    if delimiter not in " \t" and rng.random() < 0.3:
        for _ in range(rng.randint(1, 3)):
            i, k = rng.randrange(n), rng.randrange(1, m)
            cells[i][k], values[i, k] = (
                rng.choice(("", "OL", "---", "NaN", "9.9E+37" if decimal == "." else "")),
                np.nan,
            )
    names = rng.sample(NAMES, m)
    if delimiter == " ":
        names = [name.replace(" ", "_") for name in names]
    units = [rng.choice(UNITS) for _ in range(m)]
    lines = []
    if rng.random() < 0.4:
        lines += rng.sample(
            ["Program 3.1", "Machine: M7", "Operator\tMeier", "Date: 2026-05-04 10:12", "", "Serial;1234"], 3
        )
    kind = rng.choice(("none", "names", "names and units", "units below"))
    if kind == "names and units" and delimiter != " ":
        names = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]
    if kind != "none":
        lines.append(delimiter.join(names))
    if kind == "units below" and delimiter != " ":
        lines.append(delimiter.join(unit or "-" for unit in units))
    end = delimiter if delimiter in ";," and rng.random() < 0.2 else ""
    lines += [delimiter.join(row) + end for row in cells]
    if kind != "none" and delimiter != " " and rng.random() < 0.2:
        lines += ["", delimiter.join(["Mean", *cells[0][1:]])]
    text = rng.choice(("\n", "\r\n")).join(lines) + rng.choice(("\n", "\r\n", ""))
    return text.encode(rng.choice(("utf-8", "utf-8-sig", "utf-16", "cp1252"))), values, names if kind != "none" else []


def test_random_tables_are_read_rightly_or_refused(tmp_path: Path) -> None:
    read = 0
    for seed in range(FILES):
        data, values, names = written(random.Random(seed))
        path = tmp_path / "table.csv"
        path.write_bytes(data)
        mistakes = Mistakes(path)
        try:
            table = read_table(path, Format.model_validate({}))
            table.report(mistakes)
            found = table.numbers(dict(enumerate(table.titles[: values.shape[1]])), mistakes)
            mistakes.raise_any()
        except DatasetError:
            continue
        read += 1
        shown = f"seed {seed}: {data[:300]!r}"
        if names:
            assert table.titles[: len(names)] == names, shown
        got = np.stack([found[k] for k in range(values.shape[1])], axis=1)
        np.testing.assert_allclose(got, values, rtol=0, atol=1e-9, err_msg=shown)
    assert read >= READ * FILES


@pytest.mark.parametrize("what", ["letter", "cut", "field"])
def test_damaged_rows_are_refused(tmp_path: Path, what: str) -> None:
    """A letter in a number, a file that ends within a row, a missing field: no such row is left out or read in part."""
    refused = tried = 0
    for seed in range(150):
        rng = random.Random(seed)
        data, values, names = written(rng)
        if not names or values.shape[0] < 5 or b"Mean" in data or data.startswith((b"\xff\xfe", b"\xfe\xff")):
            continue
        lines = data.rstrip(b"\r\n").split(b"\n")
        row = len(lines) - rng.randint(1, 3)
        if what == "letter":
            spot = lines[row].rfind(b"1") if b"1" in lines[row] else -1
            if spot < 0:
                continue
            lines[row] = lines[row][:spot] + b"l" + lines[row][spot + 1 :]
        elif what == "cut":
            signs = [k for k, sign in enumerate(lines[-1]) if sign in b"\t;,| "]
            lines[-1] = lines[-1][: rng.choice(signs)]
        else:
            delimiter = next((sign for sign in b"\t;|" if bytes([sign]) in lines[row]), None)
            if delimiter is None:
                continue
            head, _, _ = lines[row].rpartition(bytes([delimiter]))
            lines[row] = head
        path = tmp_path / "table.csv"
        path.write_bytes(b"\n".join(lines) + (b"" if what == "cut" else b"\n"))
        mistakes = Mistakes(path)
        tried += 1
        try:
            table = read_table(path, Format.model_validate({}))
            table.report(mistakes)
            found = table.numbers(dict(enumerate(table.titles[: values.shape[1]])), mistakes)
            mistakes.raise_any()
        except DatasetError:
            refused += 1
            continue
        # Read rightly all the same: a delimiter at the end of the lines, or an empty cell, was cut off.
        got = np.stack([found[k] for k in range(values.shape[1])], axis=1)
        np.testing.assert_allclose(got, values, rtol=0, atol=1e-9, err_msg=f"seed {seed}: {lines[row]!r}")
    assert tried > 10
    assert refused > 0.7 * tried
