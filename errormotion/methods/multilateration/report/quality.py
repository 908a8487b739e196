"""Readings of a network: stations, residuals, outliers and excluded targets."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure as Canvas

from errormotion.methods.multilateration.report.view import Network
from errormotion.report import canvas
from errormotion.report.document import Block, Cell, Figure, Table, Text, estimate, or_dash
from errormotion.report.text import finite, fixed, integer, listed

_MAX_DRAWN, _MAX_NAMED, _MAX_STATIONS = 1500, 40, 24


def stations(net: Network) -> Block:
    """Return the table of stations: position, dead path, readings."""
    if not net.stations:
        return Text("The result contains no stations.", "note")
    rows: list[list[Cell | str]] = []
    unknown = "not part of this result"
    read = np.isfinite(net.residual).any()
    for j, name in enumerate(net.stations):
        position = [
            estimate(1e3 * v, 2e3 * u, reason=unknown, digits=7, signed=False)
            for v, u in zip(net.station[j], net.station_u[j], strict=True)
        ]
        path = estimate(1e3 * net.dead_path[j], 2e3 * net.dead_path_u[j], reason=unknown, digits=7, signed=False)
        off = or_dash(fixed(1e3 * float(np.linalg.norm(net.station[j] - net.station_nominal[j])), 1), unknown)
        used = np.isfinite(net.residual[j]) & (net.left_out[j] == 0)
        rms = float(np.sqrt(finite(np.mean, net.residual[j, used] ** 2)))
        count = integer(int(used.sum())) if read else Cell("—", reason=unknown)
        rows.append([name, *position, path, off, count, or_dash(fixed(1e6 * rms, 2), unknown)])
    return Table(
        "Positions of the tracker and dead paths (zero offsets of its counter), with expanded uncertainty, "
        "k = 2. Deviation: distance from the approximate position. Residual: root mean square.",
        ["station", "x / mm", "y / mm", "z / mm", "dead path / mm", "deviation / mm", "used", "residual / µm"],
        rows,
        [("", 1), ("position", 3), ("", 1), ("", 1), ("readings", 2)],
    )


def planned(errors: xr.Dataset, net: Network) -> Block:
    """Return the table of a plan's stations, as set and best."""
    if "best_place" not in errors or errors["best_place"].dims != ("station", "direction"):
        return Text("The plan contains no better positions.", "note")
    best = np.asarray(errors["best_place"].values, float)
    rows: list[list[Cell | str]] = [
        [name, *(or_dash(fixed(1e3 * v, 0), "unknown") for v in (*own, *better))]
        for name, own, better in zip(net.stations, net.station, best, strict=True)
    ]
    return Table(
        "Positions of the tracker as set (drawn above), and the best within the boxes.",
        ["station", *2 * ("x / mm", "y / mm", "z / mm")],
        rows,
        [("", 1), ("as set", 3), ("best", 3)],
    )


def residuals(net: Network, key: str) -> Block:
    """Return the residuals by station, with outliers marked."""
    given = np.isfinite(net.residual)
    if not given.any():
        return Text("The result contains no residuals.", "note")
    shown = list(range(min(len(net.stations), _MAX_STATIONS)))
    kept = given & (net.left_out == 0)
    top = 1e6 * finite(np.max, np.abs(net.residual[kept])) if kept.any() else 1.0
    top = 1.15 * max(top, 1e6 * 2.2 * net.noise if np.isfinite(net.noise) else 0.0)
    wild = int((given & ~kept & (np.abs(1e6 * net.residual) > top)).sum())

    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        figure.subplots_adjust(left=0.075, right=0.985, top=0.95, bottom=0.2)
        if np.isfinite(net.noise):
            axes.axhspan(-2e6 * net.noise, 2e6 * net.noise, color=canvas.SKY, alpha=0.15, linewidth=0)
        for column, j in enumerate(shown):
            colour = canvas.COLOURS[j % len(canvas.COLOURS)]
            across = column + 0.1 + 0.8 * (np.arange(len(net.targets)) + 0.5) / len(net.targets)
            used = np.flatnonzero(kept[j])
            if used.size > _MAX_DRAWN:
                used = used[:: -(-used.size // _MAX_DRAWN)]
            axes.plot(across[used], 1e6 * net.residual[j, used], ".", color=colour, markersize=3, markeredgewidth=0)
            out = np.flatnonzero(given[j] & ~kept[j])
            axes.plot(
                across[out], np.clip(1e6 * net.residual[j, out], -top, top), "x", color=canvas.BLACK, markersize=5
            )
        axes.set_ylim(-1.04 * top, 1.04 * top)
        axes.set_xlim(0, len(shown))
        axes.set_xticks([k + 0.5 for k in range(len(shown))], [net.stations[j] for j in shown])
        axes.tick_params(axis="x", length=0)
        axes.grid(visible=False, axis="x")
        axes.set_ylabel("residual / µm")
        axes.set_xlabel("station, with its targets in order")

    out = int((given & ~kept)[shown].sum())
    words = "" if not out else " Crosses: ignored" + (", at the edge if beyond it." if wild else ".")
    fewer = (
        f" The first {_MAX_STATIONS} of {len(net.stations)} stations are drawn."
        if len(net.stations) > _MAX_STATIONS
        else ""
    )
    band = " Band: twice the noise of a reading." if np.isfinite(net.noise) else ""
    caption = f"Residuals by station: reading minus the distance of the network.{band}{words}{fewer}"
    alt = f"Residuals of {len(shown)} stations; the largest used is {fixed(top / 1.15, 2)} µm."
    return Figure(canvas.draw(paint, key, 2.2), caption, alt)


def left_out(net: Network) -> list[Block]:
    """Return the lists of outliers and of excluded targets, and the number of missing readings."""
    found: list[Block] = []
    wrong = np.argwhere((net.left_out == 1).T)
    if len(wrong):
        names = []
        for i, j in wrong[:_MAX_NAMED]:
            by = 1e6 * net.residual[j, i]
            names.append(net.named(j, i) + (f" ({fixed(by, 1, signed=True)} µm)" if np.isfinite(by) else ""))
        more = f", and {integer(len(wrong) - _MAX_NAMED)} more" if len(wrong) > _MAX_NAMED else ""
        found.append(Text(f"Outliers, ignored: {listed(names)}{more}.", "warning"))
    excluded = np.flatnonzero((net.left_out == 2).any(axis=0))
    if excluded.size:
        names = [net.targets[i] for i in excluded[:_MAX_NAMED]]
        more = f", and {integer(excluded.size - _MAX_NAMED)} more" if excluded.size > _MAX_NAMED else ""
        words = "Targets excluded, with contradictory readings of which the wrong one is not determined"
        found.append(Text(f"{words}: {listed(names)}{more}.", "warning"))
    lost = int((~np.isfinite(net.residual) & (net.left_out == 0)).sum())
    if np.isfinite(net.residual).any() and lost:
        missing = f"{integer(lost)} of {integer(net.residual.size)} readings are missing"
        found.append(Text(f"{missing}: the beam was interrupted, or the target was not visited.", "plain"))
    return found
