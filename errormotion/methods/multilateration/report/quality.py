"""Readings of a network: stations, residuals, outliers and excluded targets."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure as Canvas

from errormotion.methods.multilateration.report.network import left_out as use_of
from errormotion.methods.multilateration.report.network import residuals
from errormotion.report import canvas
from errormotion.report.document import Block, Figure, Source, Text
from errormotion.report.text import finite, fixed, integer, listed

_MAX_DRAWN, _MAX_NAMED, _MAX_STATIONS = 1500, 40, 24


def drawing(source: Source, key: str) -> list[Block]:
    """Return the residuals by station, with outliers marked."""
    net, residual = source.errors, residuals(source)
    given, noise, stations = np.isfinite(residual), float(net["noise"]), net["station"].values.tolist()
    if not given.any():
        return [Text("The result contains no residuals.", "note")]
    shown = list(range(min(len(stations), _MAX_STATIONS)))
    kept = given & (use_of(net) == 0)
    top = 1e6 * finite(np.max, np.abs(residual[kept])) if kept.any() else 1.0
    top = 1.15 * max(top, 1e6 * 2.2 * noise if np.isfinite(noise) else 0.0)
    wild = int((given & ~kept & (np.abs(1e6 * residual) > top)).sum())

    def paint(figure: Canvas) -> None:
        axes = figure.subplots()
        figure.subplots_adjust(left=0.075, right=0.985, top=0.95, bottom=0.2)
        if np.isfinite(noise):
            axes.axhspan(-2e6 * noise, 2e6 * noise, color=canvas.SKY, alpha=0.15, linewidth=0)
        for column, j in enumerate(shown):
            colour = canvas.COLOURS[j % len(canvas.COLOURS)]
            across = column + 0.1 + 0.8 * (np.arange(net.sizes["target"]) + 0.5) / net.sizes["target"]
            used = np.flatnonzero(kept[j])
            if used.size > _MAX_DRAWN:
                used = used[:: -(-used.size // _MAX_DRAWN)]
            axes.plot(across[used], 1e6 * residual[j, used], ".", color=colour, markersize=3, markeredgewidth=0)
            out = np.flatnonzero(given[j] & ~kept[j])
            axes.plot(across[out], np.clip(1e6 * residual[j, out], -top, top), "x", color=canvas.BLACK, markersize=5)
        axes.set_ylim(-1.04 * top, 1.04 * top)
        axes.set_xlim(0, len(shown))
        axes.set_xticks([k + 0.5 for k in range(len(shown))], [stations[j] for j in shown])
        axes.tick_params(axis="x", length=0)
        axes.grid(visible=False, axis="x")
        axes.set_ylabel("residual / µm")
        axes.set_xlabel("station, with its targets in order")

    out = int((given & ~kept)[shown].sum())
    words = "" if not out else " Crosses: ignored" + (", at the edge if beyond it." if wild else ".")
    fewer = (
        f" The first {_MAX_STATIONS} of {len(stations)} stations are drawn." if len(stations) > _MAX_STATIONS else ""
    )
    band = " Band: twice the noise of a reading." if np.isfinite(noise) else ""
    caption = f"Residuals by station: reading minus the distance of the network.{band}{words}{fewer}"
    alt = f"Residuals of {len(shown)} stations; the largest used is {fixed(top / 1.15, 2)} µm."
    return [Figure(canvas.draw(paint, key, 2.2), caption, alt)]


def left_out(source: Source, key: str) -> list[Block]:  # noqa: ARG001 - texts have no identifiers
    """Return the lists of outliers and of excluded targets, and the number of missing readings."""
    net, residual, use, found = source.errors, residuals(source), use_of(source.errors), list[Block]()
    stations, targets = (net[dim].values.tolist() for dim in ("station", "target"))
    wrong = np.argwhere((use == 1).T)
    if len(wrong):
        names = []
        for i, j in wrong[:_MAX_NAMED]:
            by = 1e6 * residual[j, i]
            names.append(
                f"{stations[j]} to {targets[i]}" + (f" ({fixed(by, 1, signed=True)} µm)" if np.isfinite(by) else "")
            )
        more = f", and {integer(len(wrong) - _MAX_NAMED)} more" if len(wrong) > _MAX_NAMED else ""
        found.append(Text(f"Outliers, ignored: {listed(names)}{more}.", "warning"))
    excluded = np.flatnonzero((use == 2).any(axis=0))
    if excluded.size:
        names = [targets[i] for i in excluded[:_MAX_NAMED]]
        more = f", and {integer(excluded.size - _MAX_NAMED)} more" if excluded.size > _MAX_NAMED else ""
        words = "Targets excluded, with contradictory readings of which the wrong one is not determined"
        found.append(Text(f"{words}: {listed(names)}{more}.", "warning"))
    lost = int((~np.isfinite(residual) & (use == 0)).sum())
    if np.isfinite(residual).any() and lost:
        missing = f"{integer(lost)} of {integer(residual.size)} readings are missing"
        found.append(Text(f"{missing}: the beam was interrupted, or the target was not visited.", "plain"))
    return found
