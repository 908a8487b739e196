"""Files ``.rtl`` of laser calibration software: targets, and the deviation at each target of each run.

The layout is that of five published programs that read or write such files (docs/reference/positioning-files.md names
them); no description by the maker was found. Sections start with ``NAME::``. ``TARGET DATA::`` holds ``Target-count:``
and, behind ``Targets :``, the positions in mm; ``RUNS::`` holds ``Run-count:``; ``DEVIATIONS::`` holds, behind ``Run
Target Data:``, lines of run, target and deviation. A run is one pass; its lines are in the order in which it was
measured.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import xarray as xr
from pydantic import AfterValidator, Field

from errormotion.datasets.files.reading import read_bytes
from errormotion.datasets.files.tomlfile import load_model
from errormotion.datasets.text.mistakes import Mistakes
from errormotion.datasets.units import convert
from errormotion.errors import DatasetError
from errormotion.kinematics.iso import iso_names
from errormotion.methods.linear_positioning.schema import APPROACHES, READINGS, SCHEMA
from errormotion.methods.linear_positioning.settings import FREEDOMS, Coefficient, Freedom, Ratio
from errormotion.plugins import PluginSettings

MAP_SCHEMA = "errormotion.map.rtl/1"
LONGEST = 4 << 20
"""Largest file, bytes."""
MOST = 10_000
"""Largest number of targets, and of runs."""

_SECTION = re.compile(r"([A-Z][A-Z0-9 -]{0,40})::")
_NUMBER = re.compile(r"[+-]?(?:[0-9]{1,12}(?:\.[0-9]{0,12})?|\.[0-9]{1,12})(?:[eE][+-]?[0-9]{1,2})?")
_WHOLE = re.compile(r"[0-9]{1,5}")


def _known(unit: str) -> str:
    for base in ("m", "rad"):
        try:
            convert(1.0, unit, base)
        except DatasetError:
            continue
        return unit
    raise ValueError(f"expected a unit of length or angle; found '{unit}'")


class RtlMap(PluginSettings):
    """What a file does not state by itself."""

    schema_: Literal["errormotion.map.rtl/1"] = Field(alias="schema")
    axis: Literal["X", "Y", "Z"] = Field(description="axis that moved")
    freedom: Freedom | None = Field(default=None, description="what was read; default the positioning of the axis")
    deviation_unit: Annotated[str, AfterValidator(_known)] = Field(default="um", description="of the deviations")
    scale: Literal[1, -1] = Field(default=1, description="-1 where the deviations are target minus actual")
    machine: str = Field(default="", max_length=200, description="default as the file states it")
    length_uncertainty: Ratio | None = Field(default=None, ge=0, description="of the lengths of the instrument")
    machine_expansion: Coefficient | None = Field(
        default=None, ge=0, description="only where the software of the instrument has not corrected the expansion"
    )


def read_rtl(log: Path, map_file: Path) -> xr.Dataset:
    """Return the raw dataset of a file ``.rtl``.

    A run whose lines rise in position is an approach forward, one whose lines fall one backward; they are numbered in
    their order. Targets that a run has not reached are NaN.

    Raises
    ------
    DatasetError
        The map or the file is wrong; all mistakes are reported together, each with its line.
    """
    given = load_model(map_file, RtlMap, error=DatasetError)
    mistakes = Mistakes(log)
    sections = _sections(_text(log))
    targets = _targets(sections.get("TARGET DATA", []), mistakes)
    runs = _runs(sections.get("DEVIATIONS", []), len(targets), mistakes)
    passes = _passes(targets, runs, mistakes)
    _check_count(sections.get("RUNS", []), len(runs), mistakes)
    mistakes.raise_any()
    freedom = given.freedom or FREEDOMS["XYZ".index(given.axis)]
    size = convert(1.0, given.deviation_unit, "m" if freedom in FREEDOMS[:3] else "rad")
    values = np.full((max(map(len, passes)), 2, len(targets)), np.nan)
    for k, of in enumerate(passes):
        for number, row in enumerate(of):
            values[number, k, list(row)] = [given.scale * size * value for value in row.values()]
    variables: dict[str, tuple[Any, ...]] = {
        "deviation": (READINGS, values[None]),
        "target_position": ("target", np.array(targets), {"units": "m"}),
    }
    for name, unit in (("length_uncertainty", "1"), ("machine_expansion", "1/K")):
        if (stated := getattr(given, name)) is not None:
            variables[name] = ((), stated, {"units": unit})
    missing = int(np.isnan(values).sum())
    machine = given.machine or _stated(sections.get("USER-TEXT", []), "machine") or "unknown"
    attrs = {
        "schema": SCHEMA,
        "axis": given.axis,
        "machine": machine,
        "missing_values": json.dumps({"deviation": missing} if missing else {}),
    }
    return xr.Dataset(variables, {"freedom": [iso_names(given.axis)[freedom]], "approach": list(APPROACHES)}, attrs)


LOG_READERS = {MAP_SCHEMA: read_rtl}
"""Formats of maps that the method reads."""

Lines = list[tuple[int, str]]


def _text(log: Path) -> str:
    try:
        data = read_bytes(log, LONGEST)
    except OSError as error:
        raise DatasetError(f"{log} cannot be read: {error.strerror or error}") from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")  # only the user's text may have other letters than ASCII


def _sections(text: str) -> dict[str, Lines]:
    """Return the lines of each section with their numbers; empty lines are left out."""
    found: dict[str, Lines] = {}
    here: Lines = []
    for number, line in enumerate(text.splitlines(), 1):
        stripped = line.strip()
        if section := _SECTION.fullmatch(stripped):
            here = found.setdefault(section[1].strip(), [])
        elif stripped:
            here.append((number, stripped))
    return found


def _stated(lines: Lines, key: str) -> str:
    """Return what follows a key and a colon; empty where it is not there."""
    for _, line in lines:
        name, colon, value = line.partition(":")
        if colon and name.strip().lower() == key:
            return value.strip()[:200]
    return ""


def _behind(lines: Lines, key: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the words of the lines between a line that starts with a key and the next one with a colon."""
    inside = False
    for number, line in lines:
        name, colon, rest = line.partition(":")
        if colon:
            inside = name.strip().lower() == key
            if inside and rest.split():
                yield number, rest.split()
        elif inside:
            yield number, line.split()


def _targets(lines: Lines, mistakes: Mistakes) -> list[float]:
    """Return the positions of the targets, m."""
    found: list[float] = []
    for number, words in _behind(lines, "targets"):
        for word in words:
            value = float(word) if _NUMBER.fullmatch(word) else math.nan
            if not math.isfinite(value):
                mistakes.add(number, f"targets: expected positions in mm; found '{word[:40]}'", "targets")
            found.append(value * 1e-3)
    stated = _stated(lines, "target-count")
    if not found or len(found) > MOST:
        mistakes.add(0, f"TARGET DATA:: expected 1 to {MOST} positions behind 'Targets :'; found {len(found)}")
    elif stated != str(len(found)):
        mistakes.add(0, f"Target-count: expected the number of targets, {len(found)}; found '{stated[:40]}'")
    elif len(set(found)) < len(found):
        mistakes.add(0, "Targets: expected positions that differ; found one twice")
    return found[:MOST]


def _runs(lines: Lines, count: int, mistakes: Mistakes) -> dict[int, dict[int, float]]:
    """Return the deviations by run and target, both in the order of the file; targets count from 0."""
    found: dict[int, dict[int, float]] = {}
    for number, words in _behind(lines, "run target data"):
        if len(words) != 3 or not (_WHOLE.fullmatch(words[0]) and _WHOLE.fullmatch(words[1])):
            shown = " ".join(words)[:40]
            mistakes.add(number, f"expected run, target and deviation; found '{shown}'", "columns")
            continue
        run, target = int(words[0]), int(words[1]) - 1
        value = float(words[2]) if _NUMBER.fullmatch(words[2]) else math.nan
        if not 1 <= run <= MOST or not 0 <= target < count:
            mistakes.add(number, f"expected a run from 1 and a target from 1 to {count}; found {run} and {target + 1}")
        elif not math.isfinite(value):
            mistakes.add(number, f"expected a deviation; found '{words[2][:40]}'", "deviation")
        elif target in found.setdefault(run, {}):
            mistakes.add(number, f"run {run} has target {target + 1} twice")
        else:
            found[run][target] = value
    if not found:
        mistakes.add(
            0, "DEVIATIONS:: expected lines of run, target and deviation behind 'Run Target Data:'; found none"
        )
    return found


def _passes(
    targets: list[float], runs: dict[int, dict[int, float]], mistakes: Mistakes
) -> tuple[list[dict[int, float]], list[dict[int, float]]]:
    """Return the runs forward and backward, by the order of their positions."""
    passes: tuple[list[dict[int, float]], list[dict[int, float]]] = ([], [])
    for run, row in sorted(runs.items()):
        steps = np.diff([targets[target] for target in row if target < len(targets)])
        if steps.size == 0 or not ((steps > 0).all() or (steps < 0).all()):
            mistakes.add(0, f"run {run}: expected positions that rise or fall from line to line; found others", "order")
        else:
            passes[int(steps[0] < 0)].append(row)
    return passes


def _check_count(lines: Lines, found: int, mistakes: Mistakes) -> None:
    stated = _stated(lines, "run-count")
    if stated and stated != str(found):
        mistakes.add(0, f"Run-count: expected the number of runs with deviations, {found}; found '{stated[:40]}'")
