"""Scans for the pose of the profiler: a pass over a circular pocket at each of several heights of the spindle."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import clock
from errormotion.errors import InstrumentError, MethodError
from errormotion.methods.crossbeam_scan.acquisition.listening import BrokenPassError, Lines, listen
from errormotion.methods.crossbeam_scan.acquisition.moving import Mover, mover
from errormotion.methods.crossbeam_scan.acquisition.programs import Program, pocket_pass
from errormotion.methods.crossbeam_scan.acquisition.scans import FAILURE_LIMIT, prepare_profiler, reopen
from errormotion.methods.crossbeam_scan.acquisition.schedule import program_texts
from errormotion.methods.crossbeam_scan.schema import SCHEMA

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
    from errormotion.plugins import Bench

    Heights = NDArray[np.float32]

log = logging.getLogger(__name__)


def record_pocket(bench: Bench, settings: CrossbeamScanSettings, done: xr.Dataset | None) -> Iterator[xr.Dataset]:
    """Yield scans of a pocket, one chunk along ``scan`` for each lift of the spindle.

    A pass that fails or was interrupted is repeated.

    Parameters
    ----------
    bench : Bench
        With a ``line_profiler``; a ``controller`` where there is one, else the operator is prompted.
    settings : CrossbeamScanSettings
    done : Dataset, optional
        The complete scans of an interrupted run. A virtual machine that was restarted repeats them, without their data.

    Raises
    ------
    MethodError
        The scans are files, or no line is over the pocket.
    InstrumentError
        A pass failed three times.
    """
    profiler = bench.of_kind("line_profiler")
    require_streaming(profiler)
    programs = program_texts(settings)
    move = mover(bench)
    static = _static(bench, settings, programs)
    first = 0 if done is None else int(done.sizes["scan"])
    repeats = False
    if move.virtual:
        if done is not None and clock.restarted(done, move.now()):
            repeats = True
            move.return_to_start(done)
        static.attrs |= move.start_attrs()
    else:
        prepare_profiler(profiler)
    for number in range(0 if repeats else first, len(settings.pocket_lifts)):
        program = pocket_pass(settings, number + 1)
        y, heights, x, counts = _scan(profiler, move, program, settings)
        if number < first:
            continue
        stage = np.zeros((1, y.size, 3))
        stage[0, :, 1], stage[0, :, 2] = y, settings.pocket_lifts[number]
        chunk = static.assign(
            x=("point", x, {"units": "m"}),
            height=(("scan", "profile", "point"), heights[None], {"units": "m"}),
            stage=(("scan", "profile", "direction"), stage, {"units": "m"}),
        )
        chunk.attrs |= counts
        yield chunk


def require_streaming(profiler: Any) -> None:
    """Raise MethodError for a profiler whose scans are files."""
    if hasattr(profiler, "scans"):
        raise MethodError(
            "The scans of a pocket are not read from files: expected a line profiler that streams. A raw dataset of "
            "the variant 'profiler pose' can be identified directly.",
            code="scan.pocket.from_files",
        )


def _static(bench: Bench, settings: CrossbeamScanSettings, programs: dict[str, str]) -> xr.Dataset:
    m = {"units": "m"}
    return xr.Dataset(
        {
            "pocket_centre": ("direction", np.zeros(3), m),
            "pocket_radius": ((), settings.pocket_radius, m),
            "pocket_radius_uncertainty": ((), settings.pocket_radius_uncertainty, m),
        },
        coords={"direction": list("xyz")},
        attrs={
            "schema": SCHEMA,
            "machine": bench.machine,
            "start": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "programs": json.dumps(programs),
        },
    )


def _scan(
    profiler: Any, move: Mover, program: Program, settings: CrossbeamScanSettings
) -> tuple[Array, Heights, Array, dict[str, Any]]:
    """Return y (profile,), heights (profile, point) and x (point,) of a pass, and counts of losses; with retries."""
    for attempt in range(1, FAILURE_LIMIT + 1):
        try:
            return _cut(list(_pass(profiler, move, program, settings)), settings)
        except BrokenPassError as error:
            log.warning("%s: %s", program.name, error)
            if attempt == FAILURE_LIMIT:
                raise InstrumentError(
                    f"{program.name} failed {FAILURE_LIMIT} times. The last line of the last attempt was at "
                    f"{error.position:g} m (nan: no line was received): {error.reason}",
                    code="scan.program.failed",
                ) from error
            reopen(profiler)
    raise InstrumentError(f"{program.name} was not run", code="scan.program.not_run")


def _pass(profiler: Any, move: Mover, program: Program, settings: CrossbeamScanSettings) -> Iterator[Lines]:
    """Yield the lines over the pocket."""
    low, high = program.reach()
    reach = settings.pocket_scan_length / 2 + settings.line_pitch
    window = np.array([settings.pocket_position - reach]), np.array([settings.pocket_position + reach])
    with closing(listen(profiler, move, program, settings, low, high)) as listening:
        for lines in listening:
            part = lines.within(*window)
            if part.encoder.size:
                yield part


def _cut(parts: list[Lines], settings: CrossbeamScanSettings) -> tuple[Array, Heights, Array, dict[str, Any]]:
    """Return the lines on an equidistant grid, the same for every scan; positions without a line are NaN."""
    count = int(settings.pocket_scan_length / settings.line_pitch)
    if not parts:
        raise MethodError(
            f"No line was received over the pocket at {settings.pocket_position:g} m: check pocket_position, "
            f"encoder_pitch ({settings.encoder_pitch:g} m a count) and encoder_zero ({settings.encoder_zero:g} m).",
            code="scan.pocket.no_line",
        )
    y = np.concatenate([part.position for part in parts]) - settings.pocket_position
    heights = np.concatenate([part.heights for part in parts])
    known = np.isfinite(y)
    y, heights = y[known], heights[known]
    pitch = settings.line_pitch
    phase = y[0] - pitch * round(y[0] / pitch)  # of the received lines, so that none is midway between grid points
    index = np.rint((y - phase) / pitch).astype(np.int64) + count // 2
    inside = (index >= 0) & (index < count)
    if np.unique(index[inside]).size < 0.9 * count:
        raise MethodError(
            f"Expected {count} lines {settings.line_pitch * 1e6:g} um apart over the pocket; found "
            f"{np.unique(index[inside]).size} different positions among {y.size} lines. Check line_pitch against the "
            "profiler's trigger, and encoder_pitch.",
            code="scan.pocket.lines_missing",
        )
    gridded: Heights = np.full((count, heights.shape[1]), np.nan, dtype=np.float32)
    gridded[index[inside]] = heights[inside]
    grid: Array = (np.arange(count) - count // 2) * pitch + phase
    grid[index[inside]] = y[inside]
    invalid: dict[str, int] = {}
    for part in parts:
        for reason, points in part.invalid.items():
            invalid[reason] = invalid.get(reason, 0) + points
    return grid, gridded, parts[0].x, {"dropped": sum(part.dropped for part in parts), "invalid": invalid}
