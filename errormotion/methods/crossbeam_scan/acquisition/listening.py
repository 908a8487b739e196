"""Lines of a profiler during a pass, with positions and times, until the pass ends or the stream fails."""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.methods.crossbeam_scan.identification.cutting import unwrapped

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.crossbeam_scan.acquisition.moving import Mover
    from errormotion.methods.crossbeam_scan.acquisition.programs import Program
    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings


BLOCK_LINES = 64
"""Largest number of lines requested in one call."""


class BrokenPassError(InstrumentError):
    """The stream failed in a pass; the lines before the failure have been delivered."""

    code = "scan.pass.broken"

    def __init__(self, reason: str, position: float) -> None:
        self.reason, self.position = reason, position
        super().__init__(reason)


@dataclass(frozen=True)
class Lines:
    """Lines of one pass.

    Attributes
    ----------
    heights : ndarray, float32, (line, point)
        m.
    encoder, position, time : ndarray, (line,)
        Count and position (m) of the axis, NaN where the line was lost; time of the line, s on the mover's clock.
    x : ndarray, (point,)
        m.
    dropped : int
        Lines lost in transfer.
    invalid : mapping of str to int
        Number of points without a value, by reason.
    """

    heights: NDArray[np.float32]
    encoder: Array
    position: Array
    time: Array
    x: Array
    dropped: int
    invalid: Mapping[str, int]

    def within(self, low: Array, high: Array) -> Lines:
        """Return the lines between positions (m, one or several pairs); a lost line is kept with its neighbour."""
        position = filled(self.position)[:, None]
        kept = ((position >= low) & (position <= high)).any(axis=1)
        if kept.all():
            return self
        part: dict[str, Any] = {name: getattr(self, name)[kept] for name in ("heights", "encoder", "position", "time")}
        if not kept.any():
            part |= {"dropped": 0, "invalid": {}}
        return replace(self, **part)

    def after(self, count: int) -> Lines:
        """Return the lines without the first ``count``."""
        names = ("heights", "encoder", "position", "time")
        return replace(self, **{name: getattr(self, name)[count:] for name in names}) if count else self


def listen(
    profiler: Any, mover: Mover, program: Program, settings: CrossbeamScanSettings, low: float, high: float
) -> Generator[Lines]:
    """Start a pass and yield its lines until the axis is past its last scan.

    Parameters
    ----------
    profiler : instrument of kind ``line_profiler``
    mover : Mover
    program : Program
        The pass.
    settings : CrossbeamScanSettings
    low, high : float
        Ends of the motion with the measuring feed, m; ``margin`` after the last scan is included.

    Raises
    ------
    BrokenPassError
        The stream stopped in the pass or did not start, or the profiler failed.
    """
    size = max(1, min(BLOCK_LINES, int(settings.margin / settings.line_pitch / 2)))
    middle = ((low + high) / 2 - settings.encoder_zero) / settings.encoder_pitch
    passing, last = False, math.nan
    mover.start(program, listening=True)
    while True:
        try:
            with closing(profiler.stream(block=size)) as stream:
                for block in stream:
                    lines = _located(block, middle, mover.now(), settings)
                    reached = np.nanmax(lines.position, initial=-np.inf)
                    # Lines from the move to the start do not belong to the pass: the axis dwells there.
                    passing = passing or bool(
                        np.any((lines.position > low + settings.margin / 4) & (lines.position < high))
                    )
                    last = reached if math.isfinite(reached) else last
                    yield lines
                    if passing and last >= high - settings.margin:
                        return
            raise BrokenPassError("the profiler's stream has ended", last)
        except InstrumentTimeoutError as error:
            if passing or not mover.may_still_move():
                raise BrokenPassError(str(error), last) from error
        except BrokenPassError:
            raise
        except InstrumentError as error:
            raise BrokenPassError(str(error), last) from error


def _located(block: Any, middle: float, now: float, settings: CrossbeamScanSettings) -> Lines:
    encoder = unwrapped(block.encoder, middle)
    position = settings.encoder_zero + settings.encoder_pitch * encoder
    known = filled(position)
    age = np.abs(known[-1] - known) / settings.measuring_feed
    return Lines(
        heights=block.heights.astype(np.float32),
        encoder=encoder,
        position=position,
        time=now - np.where(np.isfinite(age), age, 0.0),
        x=np.asarray(block.x, dtype=float),
        dropped=int(block.dropped),
        invalid=block.invalid,
    )


def filled(values: Array) -> Array:
    """Return values with each NaN interpolated between its neighbours, or equal to the nearest one at an end."""
    known = np.isfinite(values)
    if known.all() or not known.any():
        return values
    index = np.arange(values.size)
    return np.interp(index, index[known], values[known])
