"""Scans cut out of a record of lines, one at a time: a campaign may be larger than memory.

A scan consists of the lines at which, by the encoder, the axis was within half a scan length of an artefact. They are
sorted; repeated lines are used once, and lost lines are NaN at their positions.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.errors import MethodError

OVERFLOW = 2.0**32
"""Counts after which an encoder starts again from zero."""


def unwrapped(counts: ArrayLike, middle: float) -> Array:
    """Return encoder counts corrected by whole overflows to be nearest to the count in the middle of the axis."""
    counts = np.asarray(counts, dtype=float)
    return np.asarray(counts - OVERFLOW * np.rint((counts - middle) / OVERFLOW))


Scan = tuple[NDArray[np.float32], Array, Array, float]

log = logging.getLogger(__name__)

GAP = 0.5e-3
"""Longest accepted gap without lines in a scan, m."""
LOST_SHARE = 0.05
"""Largest accepted share of lost lines of a scan."""
END_SHARE = 0.01
"""Largest accepted share of a scan's length that is missing at each end."""
DISORDER_SHARE = 0.05
"""Largest accepted share of lines with a position before that of the previous line."""
MIN_LINES = 16
FINEST_PITCH = 1e-6
"""Smallest plausible distance of two lines, m; a smaller one is caused by a wrong encoder_pitch."""

_INTERRUPTION = re.compile(r"pass (\d+) broke at (\S+) m: (.*)", re.DOTALL)


def interruption(cycle: int, position: float, reason: str) -> str:
    """Return the key of an interrupted pass among the counts of invalid data, as `interruptions` reads it."""
    return f"pass {cycle} broke at {position:.3f} m: {reason}"


@dataclass(frozen=True)
class Interruption:
    """An interrupted pass: its number, the last position (m; NaN where it had not started), and the reason."""

    cycle: int
    position: float
    reason: str


def interruptions(raw: xr.Dataset) -> list[Interruption]:
    """Return the interrupted passes that a raw dataset states."""
    counts = raw.attrs.get("invalid", "{}")
    counts = json.loads(counts) if isinstance(counts, str) else counts
    matches = [_INTERRUPTION.fullmatch(str(text)) for text in counts]
    return [Interruption(int(m[1]), float(m[2]), m[3]) for m in matches if m is not None]


class Scans:
    """The scans of a campaign, each loaded on request, from either variant of the raw dataset.

    Parameters
    ----------
    raw : Dataset
        Schema ``errormotion.raw.crossbeam_scan/1``, variant "scans" or "scans as recorded". Not changed.

    Raises
    ------
    MethodError
        The dataset is of neither variant.

    Attributes
    ----------
    cycles, artefacts : int
    notes : list of str
        Corrections made so far, as sentences.
    """

    def __init__(self, raw: xr.Dataset) -> None:
        if "record" not in raw and not {"height", "y"} <= set(raw.variables):
            raise MethodError(
                "Expected scans: a raw dataset of crossbeam_scan with record(line, point), or with height and y; found "
                f"{', '.join(map(str, raw.data_vars))}.",
                code="scan.record.missing",
            )
        self._raw = raw
        self.notes: list[str] = []
        self.artefacts = int(raw.sizes["artefact"])
        self._x = np.asarray(raw["x"].values, dtype=float)
        self._record = _Record(raw, self._note) if "record" in raw else None
        self.cycles = int(raw.sizes["cycle"]) if self._record is None else self._record.cycles

    def scan(self, cycle: int, artefact: int) -> Scan:
        """Return one scan: height (profile, point) m, x (point,) m, y (profile,) m, and its time, s.

        y is relative to the ``position`` of the artefact and increases. The time of a recorded scan is the mean of its
        lines.

        Raises
        ------
        MethodError
            The scan is missing or incomplete, or its positions are inconsistent.
        """
        if self._record is not None:
            height, y, time = self._record.scan(cycle, artefact)
            return height, self._x, y, time
        part = self._raw.isel(cycle=cycle, artefact=artefact)
        y = np.asarray(part["y"].values, dtype=float)
        height = part["height"].transpose("profile", "point").values
        known = np.isfinite(y)
        if not known.any() or not np.isfinite(height).any():
            raise MethodError("there is no scan: all values are NaN", code="scan.no_values")
        y, height = y[known], height[known]
        if y[0] > y[-1]:
            y, height = y[::-1], height[::-1]
        _refuse_disorder(y)
        return np.ascontiguousarray(height, dtype=np.float32), self._x, y, float(part["time"])

    def _note(self, text: str) -> None:
        if text not in self.notes:
            log.info(text)
            self.notes.append(text)


class _Record:
    """A record of lines, from which scans are cut out."""

    def __init__(self, raw: xr.Dataset, note: Any) -> None:
        self._note = note
        self._raw = raw
        self._record = raw["record"].transpose("line", "point")
        self._positions = np.asarray(raw["position"].values, dtype=float)
        self._length = float(raw["scan_length"])
        counts = np.asarray(raw["encoder"].values, dtype=float)
        pitch, zero = float(raw["encoder_pitch"]), float(raw["encoder_zero"])
        corrected = unwrapped(counts, (float(self._positions.mean()) - zero) / pitch)
        jumped = np.isfinite(counts) & (corrected != counts)
        if jumped.any():
            note(f"The encoder's count overflowed ({OVERFLOW:.0f}) in {int(jumped.sum())} lines; this was corrected.")
        self._axis = zero + pitch * corrected  # position of the axis at each line, m
        self._cycle = np.asarray(raw["cycle_of_line"].values).astype(np.int64)
        self._time = np.asarray(raw["line_time"].values, dtype=float)
        planned = int(raw.sizes["cycle"]) if "warm_up" in raw else 0
        self.cycles = max(planned, int(self._cycle.max(initial=-1)) + 1)
        self._broken = {stop.cycle: stop for stop in interruptions(raw)}
        self._check_units()

    def _check_units(self) -> None:
        """Raise MethodError if no line is in a scan, or the lines are implausibly close together or far apart."""
        known = self._axis[np.isfinite(self._axis)]
        inside = (np.abs(known[:, None] - self._positions) <= self._length / 2).any(axis=1)
        step = float(np.median(np.abs(np.diff(known)))) if known.size > 1 else np.nan
        where = ", ".join(f"{y:g}" for y in self._positions)
        pitch = float(self._raw["encoder_pitch"])
        if inside.any() and not (step < FINEST_PITCH or step > self._length / MIN_LINES):
            return
        found = (
            f"{step * 1e6:.3g} um from line to line"
            if inside.any()
            else f"none of {known.size} lines there; they are at {known.min(initial=np.inf):.6g} to "
            f"{known.max(initial=-np.inf):.6g} m"
        )
        raise MethodError(
            f"Expected lines at the artefacts ({where} m), tens of micrometres apart; found {found}. Check "
            f"encoder_pitch ({pitch:g} m a count: metres, not millimetres) and encoder_zero.",
            code="scan.lines.elsewhere",
        )

    def scan(self, cycle: int, artefact: int) -> tuple[NDArray[np.float32], Array, float]:
        middle = self._positions[artefact]
        attempts = list(self._attempts(cycle, middle))
        if not attempts:
            raise MethodError(self._missing(cycle, "the scan has no lines"), code="scan.lines.missing")
        rows, y = max(reversed(attempts), key=lambda attempt: float(np.ptp(attempt[1])))
        at = f"Pass {cycle} at {middle:g} m"
        order, y = self._ordered(y, at)
        rows = rows[order]
        self._check_complete(y, cycle)
        height = self._load(rows)
        time = float(np.mean(self._time[rows]))
        height, y, lost = _with_lost_lines(height, y)
        if lost:
            self._note(f"{at}: {lost} of {y.size} lines are lost and NaN.")
        return height, y, time

    def _attempts(self, cycle: int, middle: float) -> Iterator[tuple[NDArray[np.int64], Array]]:
        """Yield, for each time that the axis passed, the lines within the scan (n,) and their positions y (n,), m."""
        lines = np.flatnonzero((self._cycle == cycle) & np.isfinite(self._axis))
        if not lines.size:
            return
        steps = np.diff(self._axis[lines])
        forwards = 1.0 if np.count_nonzero(steps > 0) >= steps.size / 2 else -1.0
        back = np.flatnonzero(steps * forwards < -self._length / 2) + 1
        for low, high in pairwise([0, *back.tolist(), lines.size]):
            rows = lines[low:high]
            y = self._axis[rows] - middle
            inside = np.abs(y) <= self._length / 2
            if inside.any():
                yield rows[inside], y[inside]

    def _ordered(self, y: Array, at: str) -> tuple[NDArray[np.int64], Array]:
        """Return the order in which y increases, each position once, and y in that order."""
        steps = np.diff(y)
        if np.count_nonzero(steps < 0) > steps.size / 2:
            backwards = np.arange(y.size)[::-1]
            order, sorted_y = self._ordered(y[::-1], at)
            return backwards[order], sorted_y
        behind = int(np.count_nonzero(steps < 0))
        if behind > DISORDER_SHARE * y.size:
            _refuse_disorder(y)
        order = np.argsort(y, kind="stable")
        first = np.concatenate([[True], np.diff(y[order]) > FINEST_PITCH / 10])
        if behind:
            self._note(f"{at}: {behind} lines were before the previous one; all lines were sorted.")
        if not first.all():
            self._note(f"{at}: {int(np.count_nonzero(~first))} lines were repeated.")
        order = order[first]
        return order, y[order]

    def _check_complete(self, y: Array, cycle: int) -> None:
        if y.size < MIN_LINES:
            raise MethodError(self._missing(cycle, f"the scan has {y.size} lines only"), code="scan.lines.missing")
        pitch = float(np.median(np.diff(y)))
        low, high = -self._length / 2, self._length / 2
        missing = max(y[0] - low, high - y[-1]) - pitch
        if missing > END_SHARE * self._length:
            part = float(np.ptp(y)) / self._length
            raise MethodError(
                self._missing(cycle, f"the scan is {part:.0%} complete, from {y[0]:+.4f} to {y[-1]:+.4f} m"),
                code="scan.lines.missing",
            )
        gap = int(np.argmax(np.diff(y)))
        if y[gap + 1] - y[gap] > GAP + pitch:
            raise MethodError(
                f"lines are lost over {(y[gap + 1] - y[gap]) * 1e3:.2f} mm at {y[gap]:+.4f} m from the artefact",
                code="scan.lines.missing",
            )
        lost = 1 - y.size * pitch / (np.ptp(y) + pitch)
        if lost > LOST_SHARE:
            raise MethodError(
                f"{lost:.0%} of its lines are lost; expected at most {LOST_SHARE:.0%}", code="scan.lines.missing"
            )

    def _missing(self, cycle: int, what: str) -> str:
        """Return why a scan is missing or incomplete."""
        broken = self._broken.get(cycle)
        if broken is not None:
            where = f" at {broken.position:.3f} m" if np.isfinite(broken.position) else " before its first line"
            return f"{what}: pass {cycle} broke{where} ({broken.reason})"
        if not np.any(self._cycle == cycle):
            return f"pass {cycle} was not made"
        if cycle == int(self._cycle.max()):
            return f"{what}: the record ends in pass {cycle}"
        reach = float(np.nanmax(self._axis[self._cycle == cycle], initial=-np.inf))
        if reach < self._positions.max() + self._length * (0.5 - END_SHARE):
            return f"{what}: pass {cycle} was cut off at {reach:.3f} m"
        return f"{what} in pass {cycle}"

    def _load(self, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return lines of the record, read in one block."""
        first = int(rows.min())
        block = self._record.isel(line=slice(first, int(rows.max()) + 1)).values
        if rows.size == len(block) and rows[0] == first and np.all(np.diff(rows) == 1):
            return np.ascontiguousarray(block, dtype=np.float32)
        return np.ascontiguousarray(block[rows - first], dtype=np.float32)


def _with_lost_lines(height: NDArray[np.float32], y: Array) -> tuple[NDArray[np.float32], Array, int]:
    """Insert a line of NaN for each lost line; return heights, y, and the number of lost lines."""
    steps = np.diff(y)
    pitch = float(np.median(steps))
    missing = np.maximum(np.rint(steps / pitch).astype(np.int64) - 1, 0)
    lost = int(missing.sum())
    if not lost:
        return height, y, 0
    rows = np.concatenate([[0], np.cumsum(1 + missing)])
    full = np.full((rows[-1] + 1, height.shape[1]), np.nan, dtype=np.float32)
    full[rows] = height
    return full, np.interp(np.arange(full.shape[0]), rows, y), lost


def _refuse_disorder(y: Array) -> None:
    steps = np.diff(y)
    behind = int(np.count_nonzero(steps <= 0))
    if behind:
        k = int(np.argmax(steps <= 0))
        raise MethodError(
            f"expected y to increase from line to line; {behind} of {y.size} lines are at or before the position of "
            f"the previous line, the first one at {y[k + 1]:.6f} m after {y[k]:.6f} m. Check the encoder signal for "
            "noise, and whether the axis stopped or reversed.",
            code="scan.lines.backwards",
        )
