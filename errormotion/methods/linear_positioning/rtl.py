"""Files ``.rtl`` of laser calibration software: targets, and the deviation at each target of each run.

The layout is that of five published programs that read or write such files (docs/reference/positioning-files.md names
them); no description by the manufacturer was found. Sections start with ``NAME::``. ``TARGET DATA::`` contains
``Target-count:`` and, after ``Targets :``, the positions in mm; ``RUNS::`` contains ``Run-count:``; ``DEVIATIONS::``
contains, after ``Run Target Data:``, lines of run, target and deviation. A run is one pass; its lines are in the order
of measurement.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import xarray as xr
from pydantic import AfterValidator, Field

from errormotion.datasets.files.reading import read_bytes
from errormotion.datasets.files.tomlfile import load_model
from errormotion.datasets.tables.encoding import decode
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.units import convert
from errormotion.errors import DatasetError
from errormotion.kinematics.iso import iso_names
from errormotion.methods.linear_positioning.schema import APPROACHES, READINGS, SCHEMA
from errormotion.methods.linear_positioning.settings import FREEDOMS, Coefficient, Freedom, Ratio
from errormotion.plugins import PluginSettings

MAP_SCHEMA = "errormotion.map.rtl/1"
MAX_FILE_SIZE = 4 << 20
"""Bytes."""
MAX_COUNT = 10_000
"""Of targets, and of runs."""

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
    """What a file does not state."""

    schema_: Literal["errormotion.map.rtl/1"] = Field(alias="schema")
    axis: Literal["X", "Y", "Z"] = Field(description="axis that moved")
    freedom: Freedom | None = Field(default=None, description="measured freedom; default the positioning of the axis")
    deviation_unit: Annotated[str, AfterValidator(_known)] = Field(default="um", description="of the deviations")
    scale: Literal[1, -1] = Field(default=1, description="-1 where the deviations are target minus actual")
    machine: str = Field(default="", max_length=200, description="name of the machine; default that of the file")
    length_uncertainty: Ratio | None = Field(default=None, ge=0, description="of the lengths of the instrument")
    machine_expansion: Coefficient | None = Field(
        default=None, ge=0, description="only where the software of the instrument has not corrected the expansion"
    )


def read_rtl(log: Path, map_file: Path) -> xr.Dataset:
    """Return the raw dataset of a file ``.rtl``.

    A run with increasing positions is an approach forward, one with decreasing positions backward; each direction is
    numbered in the order of its runs. Targets that a run has not reached are NaN.

    Raises
    ------
    DatasetError
        The map or the file is wrong; all mistakes are reported together, each with its line.
    """
    stated = load_model(map_file, RtlMap, error=DatasetError)
    mistakes = Mistakes(log)
    sections = _sections(_text(log))
    targets = _targets(sections.get("TARGET DATA", []), mistakes)
    runs = _runs(sections.get("DEVIATIONS", []), len(targets), mistakes)
    passes = _passes(targets, runs, mistakes)
    _check_count(sections.get("RUNS", []), len(runs), mistakes)
    mistakes.raise_any()
    freedom = stated.freedom or FREEDOMS["XYZ".index(stated.axis)]
    _check_owner(log, _stated(sections.get("HEADER", []), "owner"), stated, freedom)
    size = convert(1.0, stated.deviation_unit, "m" if freedom in FREEDOMS[:3] else "rad")
    measured = [k for k, one_direction in enumerate(passes) if one_direction]  # one direction alone is a test as well
    values = np.full((max(map(len, passes)), len(measured), len(targets)), np.nan)
    for k, one_direction in enumerate(passes[k] for k in measured):
        for number, row in enumerate(one_direction):
            values[number, k, list(row)] = [stated.scale * size * value for value in row.values()]
    variables: dict[str, tuple[Any, ...]] = {
        "deviation": (READINGS, values[None]),
        "target_position": ("target", np.array(targets), {"units": "m"}),
    }
    for name, unit in (("length_uncertainty", "1"), ("machine_expansion", "1/K")):
        if (value := getattr(stated, name)) is not None:
            variables[name] = ((), value, {"units": unit})
    missing = int(np.isnan(values).sum())
    attrs = {
        "schema": SCHEMA,
        "axis": stated.axis,
        "machine": stated.machine or _stated(sections.get("USER-TEXT", []), "machine") or "unknown",
        "missing_values": json.dumps({"deviation": missing} if missing else {}),
    }
    return xr.Dataset(
        variables, {"freedom": [iso_names(stated.axis)[freedom]], "approach": [APPROACHES[k] for k in measured]}, attrs
    )


def _check_owner(log: Path, owner: str, stated: RtlMap, freedom: str) -> None:
    """Raise DatasetError if the file contains another quantity than the freedom of the map, or one of a rotary axis.

    The owner names the measurement of the software: Linear, Angular, Straightness, Squareness, Rotary.
    """
    own = "XYZ".index(stated.axis)
    kinds: dict[str, Sequence[str]] = {
        "linear": FREEDOMS[own : own + 1],
        "angular": FREEDOMS[3:],
        "straightness": [each for k, each in enumerate(FREEDOMS[:3]) if k != own],
    }
    names, kind = iso_names(stated.axis), owner.lower()
    if kind in ("rotary", "squareness"):
        raise DatasetError(
            f"{log}: Owner: expected Linear, Angular or Straightness; found {owner}, no error of a linear axis",
            code="rtl.owner.other",
        )
    if kind in kinds and freedom not in kinds[kind]:
        expected = " or ".join(kinds[kind])
        raise DatasetError(
            f"{log}: Owner: found {owner}, but {names[freedom]} in the map; set freedom to {expected}, and its unit",
            code="rtl.owner.other",
        )


LOG_READERS = {MAP_SCHEMA: read_rtl}
LOG_MAPS = {".rtl": RtlMap}
"""Model of the map by the ending of a file."""
"""Readers by the schema of their map."""

Lines = list[tuple[int, str]]


def _text(log: Path) -> str:
    try:
        data = read_bytes(log, MAX_FILE_SIZE)
    except OSError as error:
        raise DatasetError(f"{log} cannot be read: {error.strerror or error}", code="file.unreadable") from None
    return decode(data, "auto", log)[0]


def _sections(text: str) -> dict[str, Lines]:
    """Return the lines of each section with their numbers, without empty lines."""
    sections: dict[str, Lines] = {}
    current: Lines = []
    for number, line in enumerate(text.splitlines(), 1):
        stripped = line.strip()
        if section := _SECTION.fullmatch(stripped):
            current = sections.setdefault(section[1].strip(), [])
        elif stripped:
            current.append((number, stripped))
    return sections


def _stated(lines: Lines, key: str) -> str:
    """Return the text after a key and a colon; empty if there is no such key."""
    for _, line in lines:
        name, colon, value = line.partition(":")
        if colon and name.strip().lower() == key:
            return value.strip()[:200]
    return ""


def _words_after(lines: Lines, key: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the words of the lines from one that starts with a key to the next one with a colon."""
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
    positions: list[float] = []
    for number, words in _words_after(lines, "targets"):
        for word in words:
            value = float(word) if _NUMBER.fullmatch(word) else math.nan
            if not math.isfinite(value):
                mistakes.add(number, f"targets: expected positions in mm; found '{word[:40]}'", "targets")
            positions.append(value * 1e-3)
    stated = _stated(lines, "target-count")
    if not positions or len(positions) > MAX_COUNT:
        mistakes.add(0, f"TARGET DATA:: expected 1 to {MAX_COUNT} positions after 'Targets :'; found {len(positions)}")
    elif stated != str(len(positions)):
        mistakes.add(0, f"Target-count: expected the number of targets, {len(positions)}; found '{stated[:40]}'")
    elif len(set(positions)) < len(positions):
        mistakes.add(0, "Targets: expected different positions; found one of them twice")
    return positions[:MAX_COUNT]


def _runs(lines: Lines, count: int, mistakes: Mistakes) -> dict[int, dict[int, float]]:
    """Return the deviations by run and target (from 0), both in the order of the file."""
    deviations: dict[int, dict[int, float]] = {}
    for number, words in _words_after(lines, "run target data"):
        if len(words) != 3 or not (_WHOLE.fullmatch(words[0]) and _WHOLE.fullmatch(words[1])):
            shown = " ".join(words)[:40]
            mistakes.add(number, f"expected run, target and deviation; found '{shown}'", "columns")
            continue
        run, target = int(words[0]), int(words[1]) - 1
        value = float(words[2]) if _NUMBER.fullmatch(words[2]) else math.nan
        if not 1 <= run <= MAX_COUNT or not 0 <= target < count:
            mistakes.add(number, f"expected a run from 1 and a target from 1 to {count}; found {run} and {target + 1}")
        elif not math.isfinite(value):
            mistakes.add(number, f"expected a deviation; found '{words[2][:40]}'", "deviation")
        elif target in deviations.setdefault(run, {}):
            mistakes.add(number, f"run {run}: expected each target once; found target {target + 1} twice")
        else:
            deviations[run][target] = value
    if not deviations:
        mistakes.add(0, "DEVIATIONS:: expected lines of run, target and deviation after 'Run Target Data:'; found none")
    return deviations


def _passes(
    targets: list[float], runs: dict[int, dict[int, float]], mistakes: Mistakes
) -> tuple[list[dict[int, float]], list[dict[int, float]]]:
    """Return the runs forward and backward, by the order of their positions."""
    passes: tuple[list[dict[int, float]], list[dict[int, float]]] = ([], [])
    for run, row in sorted(runs.items()):
        steps = np.diff([targets[target] for target in row if target < len(targets)])
        if steps.size == 0 or not ((steps > 0).all() or (steps < 0).all()):
            mistakes.add(0, f"run {run}: expected positions that all increase or all decrease; found both", "order")
        else:
            passes[int(steps[0] < 0)].append(row)
    return passes


def _check_count(lines: Lines, runs: int, mistakes: Mistakes) -> None:
    stated = _stated(lines, "run-count")
    if stated and stated != str(runs):
        mistakes.add(0, f"Run-count: expected the number of runs with deviations, {runs}; found '{stated[:40]}'")
