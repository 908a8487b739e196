"""``errormotion compensate program``: writes a corrected NC program."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

import errormotion
from errormotion.cli.commands.compensation.model import dataset_of, source_of
from errormotion.cli.options import quantity
from errormotion.cli.output import show, show_json
from errormotion.cli.page import Page
from errormotion.compensation.correction import Correction, correction
from errormotion.compensation.program import UNCHANGED, ByTool, Offsets, Outcome, ProgramSettings, compensate
from errormotion.compensation.program.reading.offsets import read_parameters
from errormotion.compensation.program.reading.tools import read_table
from errormotion.datasets.storage.disk import reading
from errormotion.datasets.units import Length, Time
from errormotion.errors import DatasetError, ProgramError

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Choice:
    """Options of the command; points in m, quantities as text."""

    temperatures: Path | None
    time: str | None
    tolerance: str
    sampling: str
    parameters: Path | None
    tools: Path | None
    machine_unit: str
    origins: tuple[tuple[str, Triple], ...]
    functional_point: Triple | None
    gauge_point: Triple | None
    start: Triple | None
    unit: str
    block_delete: str | None
    reader: str
    check: bool
    partial: bool
    page: Page | None


def program(part: Path, sources: list[Path], choice: Choice, out: Path | None, as_json: bool) -> None:
    """Write the corrected program, and print a summary.

    Raises
    ------
    DatasetError, ProgramError
        The errors or the program cannot be read, or the motions of the program are not determined. Nothing is written.
    """
    target = out or part.with_name(f"{part.stem}.corrected{part.suffix}")
    if target.exists():
        raise ProgramError(f"{target}: already exists, and is not replaced; give another name", code="file.exists")
    settings = ProgramSettings(
        tolerance=quantity("--tolerance", choice.tolerance, Length),
        step=quantity("--sampling", choice.sampling, Length),
        unit=_one_of("--unit", choice.unit, ("mm", "inch")),
        start=choice.start,
        deleted=None
        if choice.block_delete is None
        else _one_of("--block-delete", choice.block_delete, ("skip", "run")) == "skip",
        route=choice.reader,
        check=choice.check,
    )
    given = [source_of(path) for path in sources]
    errors = [each if isinstance(each, xr.Dataset) else each.dataset for each in given]
    with reading(sources[0]) if len(sources) == 1 else nullcontext():
        found = _correction(given, choice)
    time = None
    if found.timed:
        time = _last(found) if choice.time is None else quantity("--time", choice.time, Time)
    gauge = None if choice.gauge_point is None else np.array(choice.gauge_point)
    by_tool = ByTool(found, gauge, time)
    head = _head(part, sources, errors, settings, time)
    offsets = _offsets(choice)
    with reading(part):
        outcome = compensate(part, target, by_tool, offsets, settings, head=head)
    summary = outcome.summary
    expanded = np.empty((0, 3))
    if len(summary.positions):
        pick = slice(None, None, max(1, len(summary.positions) // 400))
        covariance = by_tool.values(summary.positions[pick], summary.tools[pick], covariance=True).covariance
        assert covariance is not None
        variance = np.diagonal(covariance, axis1=1, axis2=2)
        expanded = 2 * np.sqrt(np.where(variance >= 0, variance, np.nan))
        if choice.page is not None:
            from errormotion.compensation.program.report import write_program_report

            at = np.arange(len(summary.positions))
            uncertainty = np.stack([np.interp(at, at[pick], expanded[:, k] / 2) for k in range(3)], axis=1)
            write_program_report(
                choice.page.file,
                errors[0],
                outcome,
                settings,
                program=part.name,
                uncertainty=uncertainty,
                notes=(*offsets.notes, *outcome.notes, *found.notes),
                form=choice.page.form,
            )
    _show(target, outcome, (*offsets.notes, *outcome.notes, *found.notes), expanded, time, choice, as_json)


def _correction(sources: list[Any], choice: Choice) -> Correction:
    if choice.temperatures is None and not all(isinstance(source, xr.Dataset) for source in sources):
        raise DatasetError(
            "a thermal model needs temperatures: give --temperatures LOG", code="correction.temperatures.missing"
        )
    data = None if choice.temperatures is None else dataset_of(choice.temperatures)
    return correction(sources, choice.functional_point, data=data, partial=choice.partial)


def _last(found: Correction) -> float:
    """Return the last time at which the errors are known, s."""
    return max(float(field.instants.nodes[-1]) for field in found.fields if field.instants is not None)


def _offsets(choice: Choice) -> Offsets:
    unit = _one_of("--machine-unit", choice.machine_unit, ("mm", "inch"))
    offsets = Offsets(unit=unit) if choice.parameters is None else read_parameters(choice.parameters, unit)
    for name, origin in choice.origins:
        offsets = offsets.with_system(name, origin)
    if choice.tools is not None:
        offsets = offsets.with_tools(read_table(choice.tools, unit))
    return offsets


def _head(
    part: Path, sources: list[Path], errors: list[xr.Dataset], settings: ProgramSettings, time: float | None
) -> list[str]:
    lines = [f"{part.name}, corrected by errormotion {errormotion.__version__}"]
    for path, ds in zip(sources, errors, strict=True):
        known = ", ".join(str(ds.attrs[name]) for name in ("component", "machine", "start") if ds.attrs.get(name))
        lines.append(f"errors: {path.name}, {known}")
    if time is not None:
        lines.append(f"errors at {time:.0f} s after the start of their clock")
    lines.append(f"tolerance {1e6 * settings.tolerance:g} um, sampling {1e3 * settings.step:g} mm")
    lines.append(f"original SHA-256 {sha256(part.read_bytes()).hexdigest()[:32]}")
    lines.append("valid only for the work offsets, tools and start position used here")
    return lines


def _show(
    target: Path,
    outcome: Outcome,
    notes: tuple[str, ...],
    expanded: np.ndarray,
    time: float | None,
    choice: Choice,
    as_json: bool,
) -> None:
    summary = outcome.summary
    known = expanded[np.isfinite(expanded).all(axis=1)] if len(expanded) else expanded
    uncertainty = float(known.max()) if len(known) else float("nan")
    if as_json:
        figures: dict[str, Any] = {
            name: getattr(summary, name)
            for name in (
                "read",
                "written",
                "cuts",
                "rapids",
                "divided",
                "largest",
                "largest_line",
                "length",
                "seconds",
                "unfed",
            )
        }
        counted = {name: {"number": count, "first_line": line} for name, (count, line) in summary.unchanged.items()}
        more = {
            name: {"number": value[0], "first_line": value[1]}
            for name, value in (
                ("outside", summary.outside),
                ("uncorrected", summary.uncorrected),
                ("after_end", summary.after_end),
            )
        }
        page = {}
        if choice.page is not None:
            page = {"report": str(choice.page.file), "files": [str(each) for each in choice.page.files]}
        show_json(
            {
                "ok": True,
                "program": str(target),
                "reader": outcome.route,
                "why": outcome.why,
                "checked": outcome.checked,
            }
            | figures
            | {"left": counted, **more, "uncertainty": uncertainty, "time": time, "notes": list(notes)}
            | page
        )
        return
    show(f"{target}: {summary.written} lines for {summary.read}; {summary.divided} of {summary.cuts} cuts divided")
    show(f"  largest correction {1e6 * summary.largest:.1f} um, in line {summary.largest_line}")
    stated = "unknown" if uncertainty != uncertainty else f"{1e6 * uncertainty:.1f} um"
    show(f"  its expanded uncertainty (k = 2): {stated}")
    feed = f"; {summary.unfed} cuts have no feed" if summary.unfed else ""
    show(f"  cuts of {summary.length:.3f} m; {summary.seconds / 60:.1f} min with dwells, at the programmed feed{feed}")
    if outcome.why:
        show(f"  expanded by LinuxCNC's interpreter, because of {outcome.why}")
    if outcome.checked:
        show(f"  LinuxCNC's interpreter reads the new program as planned: {outcome.checked} moves")
    for kind, (count, line) in sorted(summary.unchanged.items()):
        show(f"  not corrected: {count} {UNCHANGED[kind]}, the first in line {line}")
    if summary.uncorrected[0]:
        show(f"  WARNING: {summary.uncorrected[0]} cuts start uncorrected, the first in line {summary.uncorrected[1]}")
    if summary.outside[0]:
        count, line = summary.outside
        show(f"  WARNING: {count} moves outside the measured range, the first in line {line}: corrected as at its edge")
    if summary.after_end[0]:
        count, line = summary.after_end
        show(f"  not corrected: {count} lines after the end of the program, the first is line {line}")
    for note in notes:
        show(f"  note: {note}")
    for path in choice.page.files if choice.page is not None else ():
        show(str(path))


def _one_of(option: str, text: str, allowed: tuple[str, ...]) -> str:
    if text not in allowed:
        raise ProgramError(f"{option} {text}: expected one of {', '.join(allowed)}", code="option.choice")
    return text
