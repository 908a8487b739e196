"""Measurement along diagonals: the instrument is aligned to each diagonal, and every stop is read at rest."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.linear_positioning.acquisition.instruments import Reader, diagonal_reader
from errormotion.methods.linear_positioning.acquisition.measure import Motion, measured_attrs
from errormotion.methods.linear_positioning.diagonals.lines import Line, diagonals_of, distances, lines
from errormotion.methods.linear_positioning.planning.targets import sequence
from errormotion.methods.linear_positioning.schema import APPROACHES, SCHEMA, STOPS

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import LinearPositioningSettings
    from errormotion.plugins import Bench

_M = {"units": "m"}


def measure_diagonals(
    bench: Bench, settings: LinearPositioningSettings, done: xr.Dataset | None
) -> Iterator[xr.Dataset]:
    """Yield one raw dataset for each diagonal, to be joined along ``diagonal``.

    Parameters
    ----------
    bench : Bench
        With a ``controller`` (``move_to``, ``state``) and an ``interferometer`` or a ``laser_tracker`` in line.
    settings : LinearPositioningSettings
    done : Dataset, optional
        Diagonals of an interrupted run, which are not measured again. A virtual machine that was restarted repeats
        them, without their data.

    Raises
    ------
    MethodError
        The bench lacks an instrument, the axes do not reach a stop, or a diagonal has no zero or no reading.
    """
    motion = Motion(bench, settings)
    readers = readers_of(bench, settings)
    first_measured, finished = motion.to_repeat(done, "diagonal")
    for k, (line, stops, reader) in enumerate(zip(lines(settings), distances(settings), readers, strict=True)):
        if k < first_measured:
            continue
        if k < finished:
            _measure(motion, line, stops, reader)
            continue
        first, last = (
            " ".join(f"{a}{v * 1e3:.3f}" for a, v in zip("XYZ", line.point(s), strict=True)) for s in stops[[0, -1]]
        )
        bench.ask(
            f"Align the instrument to diagonal {line.name}, from {first} to {last} mm. Mount its reflector at the tool."
        )
        yield _measure(motion, line, stops, reader)


def readers_of(bench: Bench, settings: LinearPositioningSettings) -> list[Reader]:
    """Return the reader of each diagonal.

    Raises
    ------
    MethodError
        No instrument on the bench can read one of them.
    """
    channels = diagonals_of(settings).channels
    return [diagonal_reader(bench, settings, channels.get(line.name, ""), line.name) for line in lines(settings)]


def _measure(motion: Motion, line: Line, stops: Array, reader: Reader) -> xr.Dataset:
    settings = motion.settings
    start = datetime.now(UTC).isoformat(timespec="seconds")
    x = np.full((settings.runs, 2, stops.size), np.nan)
    for approach in sequence(settings, stops):
        if approach.before is not None:
            motion.move_to(line.point(approach.before))
        motion.move_to(line.point(approach.position))
        motion.wait(settings.settle)
        if (approach.target, approach.direction) == (0, 0) and reader.lost:
            reader.zero()
        if not reader.lost:
            distance = float(stops[approach.target] - stops[0])
            x[approach.run, approach.direction, approach.target] = float(reader.read(distance)[0]) - distance
        motion.wait(settings.dwell - settings.settle)
    if not np.isfinite(x).any():
        raise MethodError(
            f"Diagonal {line.name}: no reading. Check that the beam is not broken.", code="diagonal.no_reading"
        )
    variables: dict[str, Any] = {
        "diagonal_deviation": (STOPS, x[None], _M),
        "stop_point": (("diagonal", "stop", "direction"), np.array([[line.point(float(s)) for s in stops]]), _M),
    }
    coords: dict[str, Any] = {"diagonal": [line.name], "approach": list(APPROACHES), "direction": list("xyz")}
    if settings.functional_point is not None:
        variables["functional_point"] = ("direction", np.array(settings.functional_point), _M)
    return xr.Dataset(variables, coords, {"schema": SCHEMA, **measured_attrs(motion, reader, x, start)})
