"""Scans from files, converted to the variant "scans as recorded"."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.errors import MethodError

if TYPE_CHECKING:
    from errormotion.methods.crossbeam_scan.acquisition.schedule import Schedule
    from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings


def record_files(
    profiler: Any, settings: CrossbeamScanSettings, plan: Schedule, static: xr.Dataset, done: xr.Dataset | None
) -> Iterator[xr.Dataset]:
    """Yield the scans of files, one chunk along ``line`` for each.

    The files are ordered by cycle, and within a cycle by artefact. The middle of an artefact's first scan is its
    ``position``; y of its further scans refers to the same zero. All scans have the length of the first one. Their
    times are the planned ones.

    Parameters
    ----------
    profiler : ProfileFiles
    settings : CrossbeamScanSettings
    plan : Schedule
    static : Dataset
        See ``acquisition.static_part``.
    done : Dataset, optional
        The record of an interrupted run; files that it contains completely are skipped.

    Raises
    ------
    MethodError
        The number of files is not artefacts times passes, or the points of a line differ between files.
    """
    artefacts = len(settings.positions)
    names = list(profiler.identify().details["files"])
    if len(names) != plan.cycles * artefacts:
        raise MethodError(
            f"Expected {plan.cycles * artefacts} files, ordered by pass and artefact: {plan.cycles} passes "
            f"({plan.cold} cold and {plan.cycles - plan.cold} warm) over {artefacts} artefacts; found {len(names)}. "
            "See the settings 'positions', 'warm_up' and 'cold_repeats'.",
            code="scan.files.count",
        )
    before = 0 if done is None else int(done.sizes["line"])
    zero = np.zeros(artefacts)
    length, first_x = 0.0, None
    read = 0
    for number, scan in enumerate(profiler.scans()):
        cycle, artefact = divmod(number, artefacts)
        y, heights = (scan.y, scan.heights) if scan.y[0] < scan.y[-1] else (scan.y[::-1], scan.heights[::-1])
        if first_x is None:
            first_x, length = scan.x, float(y[-1] - y[0]) * y.size / (y.size - 1)
        if scan.x.shape != first_x.shape or not np.allclose(scan.x, first_x, atol=1e-7, rtol=0):
            raise MethodError(
                f"{scan.path} has {scan.x.size} points from {scan.x[0]:.6f} to {scan.x[-1]:.6f} m on each line; "
                f"expected {first_x.size} from {first_x[0]:.6f} to {first_x[-1]:.6f} m as in the first file.",
                code="scan.files.points",
            )
        if cycle == 0:
            zero[artefact] = (y[0] + y[-1]) / 2
        read += y.size
        if read <= before:
            continue
        new = slice(max(0, y.size - (read - before)), None)
        position = settings.positions[artefact] + y[new] - zero[artefact]
        lines = position.size
        time = np.full(lines, plan.warm_up[cycle] if cycle >= plan.cold else plan.of_cycle(cycle).start)
        yield static.assign(
            x=("point", scan.x, {"units": "m"}),
            scan_length=((), length, {"units": "m"}),
            record=(("line", "point"), heights[new].astype(np.float32), {"units": "m"}),
            encoder=("line", (position - settings.encoder_zero) / settings.encoder_pitch),
            cycle_of_line=("line", np.full(lines, cycle, np.int32)),
            line_time=("line", time, {"units": "s"}),
        )
