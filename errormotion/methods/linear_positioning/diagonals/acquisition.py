"""Measurement along diagonals: the instrument is aligned to each of them, and every stop is read at rest."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.linear_positioning.acquisition.instruments import Reader, along_line
from errormotion.methods.linear_positioning.acquisition.measure import Motion
from errormotion.methods.linear_positioning.diagonals.lines import Line, diagonals_of, distances, lines
from errormotion.methods.linear_positioning.planning.targets import sequence
from errormotion.methods.linear_positioning.schema import APPROACHES, SCHEMA, STOPS

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Settings
    from errormotion.plugins import Bench

_M = {"units": "m"}


def measure_diagonals(bench: Bench, settings: Settings, done: xr.Dataset | None) -> Iterator[xr.Dataset]:
    """Yield one raw dataset for each diagonal, to be joined along ``diagonal``.

    Parameters
    ----------
    bench : Bench
        With a ``controller`` (``move_to``, ``state``) and an ``interferometer`` or a ``laser_tracker`` in line.
    settings : Settings
    done : Dataset, optional
        Diagonals of an interrupted run, which are not measured again.

    Raises
    ------
    MethodError
        No instrument that can do it; axes that do not arrive; no zero at the start of a diagonal.
    """
    motion = Motion(bench, settings)
    channels = diagonals_of(settings).channels
    readers = [along_line(bench, settings, channels.get(line.name, ""), line.name) for line in lines(settings)]
    finished = 0 if done is None else int(done.sizes["diagonal"])
    for k, (line, places, reader) in enumerate(zip(lines(settings), distances(settings), readers, strict=True)):
        if k < finished:
            continue
        first, last = (
            " ".join(f"{a}{v * 1e3:.3f}" for a, v in zip("XYZ", line.point(s), strict=True)) for s in places[[0, -1]]
        )
        bench.ask(
            f"Align the instrument to diagonal {line.name}, from {first} to {last} mm; its reflector is at the tool."
        )
        yield _measure(bench, settings, motion, line, places, reader)


def _measure(bench: Bench, settings: Settings, motion: Motion, line: Line, places: Array, reader: Reader) -> xr.Dataset:
    start = datetime.now(UTC).isoformat(timespec="seconds")
    x = np.full((settings.runs, 2, places.size), np.nan)
    fresh = True
    for each in sequence(settings, places):
        if each.before is not None:
            motion.go(line.point(each.before))
        motion.go(line.point(each.place))
        motion.wait(settings.settle)
        if (each.target, each.approach) == (0, 0) and (fresh or reader.lost):
            reader.zero()
            fresh = False
        if not (fresh or reader.lost):
            way = float(places[each.target] - places[0])
            x[each.run, each.approach, each.target] = float(reader.read(way)[0]) - way
        motion.wait(settings.dwell - settings.settle)
    if not np.isfinite(x).any():
        raise MethodError(f"Diagonal {line.name}: no reading. Is the beam broken?")
    missing = int(np.isnan(x).sum())
    variables: dict[str, Any] = {
        "diagonal_deviation": (STOPS, x[None], _M),
        "stop_point": (("diagonal", "stop", "direction"), np.array([[line.point(float(s)) for s in places]]), _M),
    }
    coords: dict[str, Any] = {"diagonal": [line.name], "approach": list(APPROACHES), "direction": list("xyz")}
    if settings.functional_point is not None:
        variables["functional_point"] = ("direction", np.array(settings.functional_point), _M)
    attrs = {
        "schema": SCHEMA,
        "machine": bench.machine,
        "instrument": reader.id,
        "start": start,
        "dropped": 0,
        "invalid": {"beam broken": missing} if missing else {},
    }
    return xr.Dataset(variables, coords, attrs)
