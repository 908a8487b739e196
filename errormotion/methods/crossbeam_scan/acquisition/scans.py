"""Acquisition of scans: passes over the artefacts during the warm-up, each line with its encoder count.

Every line is stored in the raw dataset before anything is computed from it; scans are cut out later (``cutting``).
A line of NaN, encoder included, marks the start of the warm-up (its time is 0) and each failure of the stream.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import clock
from errormotion.errors import InstrumentError, MethodError
from errormotion.methods.crossbeam_scan.acquisition.listening import BrokenPassError, Lines, listen
from errormotion.methods.crossbeam_scan.acquisition.moving import Mover, mover
from errormotion.methods.crossbeam_scan.acquisition.programs import Program, pass_ends, warm_up_piece
from errormotion.methods.crossbeam_scan.acquisition.schedule import PROGRAM_INTERVAL, Schedule, program_texts, schedule
from errormotion.methods.crossbeam_scan.identification.cutting import interruption
from errormotion.methods.crossbeam_scan.identification.profiler_pose.pose_errors import stated_covariance, stated_pose
from errormotion.methods.crossbeam_scan.schema import SCHEMA

if TYPE_CHECKING:
    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
    from errormotion.plugins import Bench


log = logging.getLogger(__name__)

CHUNK_INTERVAL = 0.4
"""Longest time between two chunks, s; limits the loss of data in a crash."""
CHUNK_LINES = 512
"""Number of lines of a chunk."""
FAILURE_LIMIT = 3
"""Number of successive failed passes after which the campaign ends."""


def record_scans(
    bench: Bench, settings: CrossbeamScanSettings, pose: xr.Dataset | None, done: xr.Dataset | None
) -> Iterator[xr.Dataset]:
    """Yield the scans as recorded, chunk by chunk along ``line``.

    Parameters
    ----------
    bench : Bench
        With a ``line_profiler``; a ``controller`` where there is one, else the operator is prompted.
    settings : CrossbeamScanSettings
    pose : Dataset, optional
        Error dataset of a test that determined the profiler's pose; without it ``settings.profiler_pose`` is used.
    done : Dataset, optional
        The record of an interrupted run. Its last pass is not repeated, and the warm-up has continued: of the overdue
        passes only the last one is made. A virtual machine that was restarted repeats the whole campaign, and the lines
        that are recorded already are omitted: the others are those of a campaign without interruption.

    Raises
    ------
    MethodError
        No pose, no positions, times too close together, or no line is within a scan.
    InstrumentError
        Three successive passes failed.
    """
    profiler = bench.of_kind("line_profiler")
    plan = schedule(settings)
    static = static_part(bench, settings, plan, pose)
    if hasattr(profiler, "scans"):
        from errormotion.methods.crossbeam_scan.acquisition.scan_files import record_files

        return record_files(profiler, settings, plan, static, done)
    return _Campaign(profiler, mover(bench), settings, plan, static, done).chunks()


def expected_lines(settings: CrossbeamScanSettings) -> int:
    """Return the approximate number of lines that a campaign stores: the total of its progress."""
    length = settings.scan_length + 2 * settings.margin
    return (
        (1 + settings.cold_repeats + len(settings.warm_up))
        * len(settings.positions)
        * round(length / settings.line_pitch)
    )


def static_part(bench: Bench, settings: CrossbeamScanSettings, plan: Schedule, pose: xr.Dataset | None) -> xr.Dataset:
    """Return everything of a raw dataset that is known before its first line."""
    m = {"units": "m"}
    matrix, covariance = pose_of(settings, pose)
    return xr.Dataset(
        {
            "position": ("artefact", np.array(settings.positions), m),
            "warm_up": ("cycle", np.array(plan.warm_up), {"units": "s"}),
            "encoder_pitch": ((), settings.encoder_pitch, m),
            "encoder_zero": ((), settings.encoder_zero, m),
            "scan_length": ((), settings.scan_length, m),
            "profiler_pose": (("row", "column"), matrix),
            "pose_covariance": (("p", "p_"), covariance),
            "lever": ("direction", np.array(settings.lever), m),
            "lever_uncertainty": ("direction", np.array(settings.lever_uncertainty), m),
            "height_noise": ((), settings.height_noise, m),
        },
        coords={"direction": list("xyz")},
        attrs={
            "schema": SCHEMA,
            "machine": bench.machine,
            "schedule": plan.to_json(),
            "programs": json.dumps(program_texts(settings)),
        },
    )


def pose_of(settings: CrossbeamScanSettings, pose: xr.Dataset | None) -> tuple[Array, Array]:
    """Return pose (4, 4) of the profiler in the tool frame and its covariance (6, 6), from a test or the settings.

    Raises
    ------
    MethodError
        Neither states it.
    """
    if pose is not None:
        return np.asarray(pose["profiler_pose"].values, float), np.asarray(pose["pose_covariance"].values, float)
    stated = settings.profiler_pose
    if stated is None:
        raise MethodError(
            "The scans need the profiler's pose in the tool frame. Run a test with procedure = 'profiler_pose' before "
            "this one and refer to it by inputs = { pose = 'its name' }; or state the setting 'profiler_pose'.",
            code="scan.pose.missing",
        )
    return np.asarray(stated_pose(stated).as_matrix()), stated_covariance(stated)


class _Campaign:
    """The part of a campaign that is still to be measured."""

    def __init__(
        self,
        profiler: Any,
        move: Mover,
        settings: CrossbeamScanSettings,
        plan: Schedule,
        static: xr.Dataset,
        done: xr.Dataset | None,
    ) -> None:
        self.profiler, self.move, self.settings, self.plan = profiler, move, settings, plan
        self.low, self.high = pass_ends(settings)
        middles, half = np.array(settings.positions), settings.scan_length / 2
        self.scans = middles - half, middles + half
        self.windows = self.scans[0] - settings.margin, self.scans[1] + settings.margin
        self.origin = move.now()
        self.zero: float | None = None  # start of the warm-up on the mover's clock
        self.next = 0
        self.pending = Pending(static)
        if done is None:
            static.attrs["start"] = datetime.now(UTC).isoformat(timespec="milliseconds")
            static.attrs |= move.start_attrs()
        else:
            self._resume(done)

    def _resume(self, done: xr.Dataset) -> None:
        """Determine the passes that were made and the start of the warm-up."""
        cycle, since, of_line = (np.asarray(done[name].values) for name in ("cycle_of_line", "line_time", "line_clock"))
        last = float(np.nanmax(of_line, initial=0.0))
        if self.move.virtual:
            if clock.restarted(done, self.origin):
                log.info("the virtual machine was restarted: %d lines are repeated", done.sizes["line"])
                self.pending.skip = int(done.sizes["line"])
                self.move.return_to_start(done)
                self.origin = float(done.attrs.get(clock.ORIGIN, self.origin))
                return
            self.origin = float(done.attrs[clock.ORIGIN])
        else:
            # After an interruption of unknown duration, the clock continues from the last line.
            age = _age(done)
            self.origin = self.move.now() - (last if math.isnan(age) else age)
        self.pending.x = np.asarray(done["x"].values, dtype=float)
        tried = cycle[since != 0]  # time 0 is the time of the mark
        self.next = int(tried.max()) + 1 if tried.size else 0
        if 0 < self.next <= self.plan.cold and not _complete(done, self.next - 1, self.high - self.settings.margin):
            self.next -= 1  # the machine is still cold: a cold pass can be repeated
        warm = np.flatnonzero(cycle >= self.plan.cold)
        if warm.size:
            self.zero = self.origin + float(of_line[warm[-1]] - since[warm[-1]])
            self._skip_overdue(self.move.now() - self.zero)

    def _skip_overdue(self, now: float) -> None:
        self.next = max(self.next, self.plan.cold)
        while self.next + 1 < self.plan.cycles and self.plan.warm_up[self.next + 1] < now:
            log.warning("pass %d was due during the interruption; it is skipped", self.next)
            self.next += 1

    def chunks(self) -> Iterator[xr.Dataset]:
        """Yield the remaining chunks."""
        broken = 0
        if not self.move.virtual:
            prepare_profiler(self.profiler)
        while self.next < self.plan.cycles:
            if self.next >= self.plan.cold:
                yield from self._warm_up()
            try:
                yield from self._pass()
            except BrokenPassError as error:
                log.warning("pass %d: %s", self.next, error)
                broken += 1
                yield from self._interrupted(error)
                if broken == FAILURE_LIMIT:
                    raise InstrumentError(
                        f"{FAILURE_LIMIT} successive passes failed, the last one is number {self.next}: {error.reason}",
                        code="scan.passes.failed",
                    ) from error
                reopen(self.profiler)
                if self.next < self.plan.cold:
                    continue  # the machine is still cold: repeat the pass
            else:
                broken = 0
            self.next += 1

    def _warm_up(self) -> Iterator[xr.Dataset]:
        """Move the axis until the next pass is due; the first time, yield the mark of the start."""
        item, due = self.plan.before(self.next), self.plan.warm_up[self.next]
        if item is not None and (piece := self._piece(item.program, due)) is not None:
            started = self.move.start(piece)
            if self.zero is None:
                self.zero = started
                if self.next == self.plan.cold:
                    yield from self._mark(0.0, started)
        if self.zero is not None:
            self.move.wait_until(self.zero + due)

    def _piece(self, name: str, due: float) -> Program | None:
        """Return the warm-up moves for the remaining time; None where it is shorter than `PROGRAM_INTERVAL`."""
        planned = self.plan.programs[name]
        if self.zero is None:
            return planned
        remaining = self.zero + due - self.move.now() - PROGRAM_INTERVAL
        if remaining > planned.seconds(self.high) - 2 * PROGRAM_INTERVAL:
            return planned
        if remaining < PROGRAM_INTERVAL:
            return None
        number = int(name.removesuffix(".nc").rpartition("_")[2])
        return warm_up_piece(self.settings, number, remaining, self.high)

    def _pass(self) -> Iterator[xr.Dataset]:
        item = self.plan.of_cycle(self.next)
        ordered = self.move.now()
        zero = ordered - item.start if self.zero is None or self.next < self.plan.cold else self.zero
        received, kept, reach = 0, 0, [np.inf, -np.inf]
        program = self.plan.programs[item.program]
        try:
            with closing(listen(self.profiler, self.move, program, self.settings, self.low, self.high)) as listening:
                for lines in listening:
                    part = lines.within(*self.windows)
                    if lines.within(*self.scans) is not lines:  # missing points outside the scans are not counted
                        part = replace(part, invalid={})
                    received, kept = received + lines.encoder.size, kept + part.encoder.size
                    reach = [
                        np.nanmin(lines.position, initial=reach[0]), np.nanmax(lines.position, initial=reach[1])
                    ]  # fmt: skip
                    self.pending.add(part, self.next, zero, self.origin)
                    if self.pending.due:
                        yield self.pending.chunk()
        except BrokenPassError:
            if received and not kept:
                raise MethodError(self._missed(received, *reach), code="scan.pass.missed") from None
            raise
        if self.pending.lines:
            yield self.pending.chunk()

    def _missed(self, received: int, low: float, high: float) -> str:
        s = self.settings
        return (
            f"Pass {self.next}: {received} lines were received, at positions from {low:.6g} to {high:.6g} m, none of "
            f"them in a scan; the scans are at {', '.join(f'{y:g}' for y in s.positions)} m. Check encoder_pitch "
            f"({s.encoder_pitch:g} m a count, negative where it counts backwards), encoder_zero ({s.encoder_zero:g} m) "
            "and the direction of the axis in which the profiler is triggered."
        )

    def _interrupted(self, error: BrokenPassError) -> Iterator[xr.Dataset]:
        """Yield the received lines, a mark after them, and the reason among the counts of invalid data."""
        text = interruption(self.next, error.position, error.reason)
        if not self.pending.skip:  # otherwise it is counted already
            self.pending.invalid[text] = self.pending.invalid.get(text, 0) + 1
        now = self.move.now()
        zero = self.zero if self.zero is not None and self.next >= self.plan.cold else None
        since = now - zero if zero is not None else self.plan.of_cycle(self.next).end
        yield from self._mark(since, now)

    def _mark(self, since: float, now: float) -> Iterator[xr.Dataset]:
        """Yield a line of NaN, if the number of points of a line is known already."""
        if self.pending.x is None:
            return
        unknown = np.full(1, np.nan)
        line = Lines(
            np.full((1, self.pending.x.size), np.nan, np.float32), unknown, unknown, np.array([now]), self.pending.x,
            0, {},
        )  # fmt: skip
        self.pending.add(line, self.next, now - since, self.origin)
        if self.pending.lines:
            yield self.pending.chunk()


def reopen(profiler: Any) -> None:
    """Reconnect a profiler; if this fails, the next pass fails as well."""
    with suppress(InstrumentError):
        profiler.close()
    try:
        profiler.open()
    except InstrumentError as error:
        log.warning("the profiler does not reconnect: %s", error)


def prepare_profiler(profiler: Any) -> None:
    """Open the stream once at rest, so that the driver is prepared before the axis starts."""
    with suppress(InstrumentError), closing(profiler.stream(block=1)) as stream:
        next(stream, None)


def _age(done: xr.Dataset) -> float:
    """Return the time since the start of an interrupted record, s; NaN if unknown."""
    try:
        return clock.age(done)
    except ValueError as error:
        raise MethodError(
            f"The interrupted record does not state when it started ({error}; expected UTC such as "
            "2025-03-01T08:00:00+00:00) and cannot be resumed. Start a new run.",
            code="run.start.missing",
        ) from error


def _complete(done: xr.Dataset, cycle: int, end: float) -> bool:
    """Return whether a pass has reached the end of its last scan, m."""
    counts = np.asarray(done["encoder"].values, dtype=float)[np.asarray(done["cycle_of_line"].values) == cycle]
    positions = float(done["encoder_zero"]) + float(done["encoder_pitch"]) * counts
    return bool(np.nanmax(positions, initial=-np.inf) >= end - 1e-3)


@dataclass
class Pending:
    """Lines received since the last chunk.

    Attributes
    ----------
    skip : int
        Number of lines that are recorded already; they are omitted, with their counts.
    """

    static: xr.Dataset
    x: Array | None = None
    skip: int = 0
    lines: int = 0
    dropped: int = 0
    invalid: dict[str, int] = field(default_factory=dict)
    _parts: dict[str, list[Any]] = field(default_factory=dict)
    _since: float = field(default_factory=time.monotonic)

    @property
    def due(self) -> bool:
        """Whether there are lines, and the next chunk is due."""
        old = time.monotonic() - self._since >= CHUNK_INTERVAL
        return self.lines >= CHUNK_LINES or (self.lines > 0 and old)

    def add(self, lines: Lines, cycle: int, zero: float, origin: float) -> None:
        """Add lines of a pass; ``zero`` is the start of the warm-up, ``origin`` that of the record, s."""
        self.x = lines.x
        skipped = min(self.skip, lines.encoder.size)
        self.skip -= skipped
        lines = lines.after(skipped)
        size = lines.encoder.size
        if not size:
            return
        columns = {
            "record": lines.heights,
            "encoder": lines.encoder,
            "cycle_of_line": np.full(size, cycle, np.int32),
            "line_time": lines.time - zero,
            "line_clock": lines.time - origin,
        }
        for name, values in columns.items():
            self._parts.setdefault(name, []).append(values)
        self.lines += size
        self.dropped += lines.dropped
        for reason, count in lines.invalid.items():
            self.invalid[reason] = self.invalid.get(reason, 0) + count

    def chunk(self) -> xr.Dataset:
        """Return all pending lines as a dataset."""
        units = {"record": "m", "line_time": "s", "line_clock": "s"}
        variables: dict[str, Any] = {"x": ("point", self.x, {"units": "m"})}
        for name, parts in self._parts.items():
            dims = ("line", "point") if name == "record" else ("line",)
            variables[name] = (dims, np.concatenate(parts), {"units": units[name]} if name in units else {})
        ds = self.static.assign(variables)
        ds.attrs |= {"dropped": self.dropped, "invalid": dict(self.invalid)}
        self._parts, self.lines, self.dropped, self.invalid = {}, 0, 0, {}
        self._since = time.monotonic()
        return ds
