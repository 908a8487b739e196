"""Readers of compensation tables as the controls read them, written from the manufacturers' descriptions.

Each returns a function from commanded positions and directions (m, +1 or -1) to the motion of the corrected axis, m.
"""

import re
from collections.abc import Callable, Mapping

import numpy as np

Control = Callable[[np.ndarray, np.ndarray], np.ndarray]


def linuxcnc(files: Mapping[str, str], kind: int = 1) -> Control:
    """Trims are added to the command; the first line without three numbers ends the table."""
    rows = []
    for line in next(iter(files.values())).splitlines():
        try:
            nominal, forward, reverse = map(float, line.split()[:3])
        except ValueError:
            break
        rows.append((nominal, forward, reverse) if kind else (nominal, nominal - forward, nominal - reverse))
    table = np.array(rows) / 1e3
    assert len(table) <= 256
    return lambda y, d: np.where(d > 0, *(np.interp(y, table[:, 0], table[:, k]) for k in (1, 2)))


def _assigned(text: str) -> dict[str, str]:
    lines = [line.split(";")[0].strip() for line in text.splitlines()]
    assert lines[0].startswith("%_N_")
    assert lines[-1] == "M17"
    return dict(line.split("=") for line in lines if "=" in line)


def siemens(files: Mapping[str, str]) -> Control:
    """$AA_ENC_COMP is added to the actual position, $AN_CEC to the setpoint of the output axis; held outside."""
    found = _assigned(next(iter(files.values())))
    if any("ENC_COMP" in name for name in found):
        low, high, step = (float(found[f"$AA_ENC_COMP_{what}[0,Y1]"]) for what in ("MIN", "MAX", "STEP"))
        values = [float(found[f"$AA_ENC_COMP[0,{k},Y1]"]) for k in range(round((high - low) / step) + 1)]
        x = low + step * np.arange(len(values))
        return lambda y, d: -np.interp(1e3 * y, x, values) / 1e3
    tables = {}
    for name, direction in found.items():
        if match := re.fullmatch(r"\$AN_CEC_DIRECTION\[(\d+)]", name):
            t = match[1]
            assert found[f"$AN_CEC_INPUT_AXIS[{t}]"] == "(Y1)"
            assert found[f"$AN_CEC_OUTPUT_AXIS[{t}]"] == "(Z1)"
            low, high, step = (float(found[f"$AN_CEC_{what}[{t}]"]) for what in ("MIN", "MAX", "STEP"))
            values = [float(found[f"$AN_CEC[{t},{k}]"]) for k in range(round((high - low) / step) + 1)]
            tables[int(direction)] = (low + step * np.arange(len(values)), np.array(values))

    def move(y: np.ndarray, d: np.ndarray) -> np.ndarray:
        total = np.zeros(y.size)
        for direction, (x, values) in tables.items():
            total += np.where((direction == 0) | (d == direction), np.interp(1e3 * y, x, values), 0.0)
        return total / 1e3

    return move


def heidenhain(files: Mapping[str, str]) -> Control:
    """Values are errors, taken off the position of the column's axis; BACKLASH is for the negative direction."""
    tables = {}
    for name, text in files.items():
        head, columns, *rows = text.split("[END]")[0].splitlines()
        assert head == f"BEGIN {name.upper()} MM"
        tables[name] = {key: [row.split()[k] for row in rows] for k, key in enumerate(columns.split())}
    assignment = next(table for name, table in tables.items() if name.endswith(".cma"))
    assert assignment["ACTIVE"] == ["*"]
    values = tables[assignment["Y"][0]]
    x = np.array(values["AXISPOS"], dtype=float)
    (key,) = set(values) - {"NR", "AXISPOS", "BACKLASH"}
    forward = np.array(values[key], dtype=float)
    backward = np.array(values.get("BACKLASH", values[key]), dtype=float)
    return lambda y, d: -np.where(d > 0, np.interp(1e3 * y, x, forward), np.interp(1e3 * y, x, backward)) / 1e3


def fanuc(files: Mapping[str, str]) -> Control:
    """Each value, times the magnification, is output in the middle of its section; 0 at the reference point."""
    _, data, _ = next(iter(files.values())).split("%", 2)
    parameters = {int(n): int(p) for n, p in re.findall(r"^N0(36\d\d)A2P(-?\d+)$", data, re.MULTILINE)}
    values = {int(n) - 10000: int(p) for n, p in re.findall(r"^N(1[01]\d{3})P(-?\d+)$", data, re.MULTILINE)}
    reference, first, last = (parameters[number] for number in (3620, 3621, 3622))
    assert sorted(values) == list(range(first, last + 1))
    assert max(map(abs, values.values())) <= 7
    step = parameters[3624] * 1e-6
    unit = parameters[3623] * 1e-6

    def move(y: np.ndarray, d: np.ndarray) -> np.ndarray:
        total = np.zeros(y.size)
        for number, value in values.items():
            middle = (number - reference - 0.5) * step
            total += np.where((middle > 0) & (y > middle), value, 0.0)
            total -= np.where((middle < 0) & (y < middle), value, 0.0)
        return total * unit

    return move


def generic(files: Mapping[str, str]) -> Control:
    """Columns of a CSV file with comments."""
    text = next(content for name, content in files.items() if name.endswith(".csv"))
    names, *rows = [line for line in text.splitlines() if not line.startswith("#")]
    assert names.startswith("position_mm,offset_forward_mm,offset_backward_mm")
    x, forward, backward, _ = np.array([row.split(",") for row in rows], dtype=float).T
    return lambda y, d: np.where(d > 0, np.interp(1e3 * y, x, forward), np.interp(1e3 * y, x, backward)) / 1e3
