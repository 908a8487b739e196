"""Results of a plan: the map of the uncertainty over the volume, as set and best, and the chosen targets."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.figure import Figure as Canvas

from errormotion.arrays import Array
from errormotion.report import canvas
from errormotion.report.document import Block, Cell, Figure, Table, Text, or_dash
from errormotion.report.drawings import maps
from errormotion.report.text import finite, fixed, integer

_LEVELS = 3
_SAME = 1e-7  # m


def blocks(errors: xr.Dataset, key: str) -> list[Block]:
    """Return the map, its summary, and the targets to measure; an empty list if the plan has no map."""
    if "map_uncertainty" not in errors or errors["map_uncertainty"].dims != ("setup", "place"):
        return []
    position = np.asarray(errors["map_position"].values, float)
    sigma = np.asarray(errors["map_uncertainty"].values, float)
    chosen = np.asarray(errors["chosen"].values == 1) if "chosen" in errors else np.zeros(len(position), bool)
    found: list[Block] = [_map(position, sigma, chosen, key), _table(sigma, errors)]
    if chosen.any():
        found.append(_targets(position[chosen]))
    if "best_layout" in errors.attrs:
        words = "The best layout, as settings of a campaign, is the attribute best_layout of the plan's dataset"
        found.append(Text(f"{words}; the setting planning.write writes it to a file.", "plain"))
    return found


def _levels(z: Array) -> Array:
    """Return the lowest, a middle and the highest of the heights."""
    known = z[np.append(True, np.diff(z) > _SAME)]
    kept = np.unique(np.linspace(0, len(known) - 1, min(len(known), _LEVELS)).round().astype(int))
    return np.asarray(known[kept], dtype=np.float64)


def _map(position: Array, sigma: Array, chosen: np.ndarray, key: str) -> Block:
    levels = _levels(np.sort(position[:, 2]))
    um = 1e6 * sigma
    top, low = finite(np.max, um), finite(np.min, um)
    if not np.isfinite(top):
        return Text("No map is drawn: the uncertainty is unknown.", "note")
    scale = maps.scale_of(um, 12, colormaps["viridis_r"])

    def paint(figure: Canvas) -> None:
        panels = figure.subplots(2, len(levels), sharex=True, sharey=True, squeeze=False)
        figure.subplots_adjust(left=0.085, right=0.87, top=0.94, bottom=0.1, wspace=0.08, hspace=0.22)
        for row, (name, values) in enumerate(zip(("as set", "best"), um, strict=True)):
            for axes, z in zip(panels[row], levels, strict=True):
                here = np.abs(position[:, 2] - z) < _SAME
                x, y = 1e3 * position[here, 0], 1e3 * position[here, 1]
                known = np.isfinite(values[here])
                axes.scatter(x[known], y[known], c=scale.to_rgba(values[here][known]), s=90, marker="s", linewidths=0)
                axes.plot(x[~known], y[~known], "x", color=canvas.BLACK, markersize=4)
                if row == 1:
                    mark = here & chosen
                    axes.plot(1e3 * position[mark, 0], 1e3 * position[mark, 1], "o", color=canvas.VERMILLION,
                              markersize=3.2, fillstyle="none")  # fmt: skip
                axes.set_title(f"{name}, Z = {1e3 * z:.0f} mm")
                axes.margins(0.12)
        for axes in panels[-1]:
            axes.set_xlabel("X / mm")
        for axes in panels[:, 0]:
            axes.set_ylabel("Y / mm")
        maps.colour_bar(panels[0, -1], scale, (0.89, 0.1, 0.018, 0.8), "u / µm")

    marks = " Circles: targets to measure." if chosen.any() else ""
    caption = (
        "Predicted standard uncertainty, three coordinates together, by the readings only, in sections of the "
        f"volume: with the layout as set, and with the best one.{marks}"
    )
    alt = f"Predicted uncertainty between {fixed(low, 2)} and {fixed(top, 2)} µm at {integer(len(position))} positions."
    return Figure(canvas.draw(paint, key, 4.4), caption, alt)


def _table(sigma: Array, errors: xr.Dataset) -> Table:
    rows: list[list[Cell | str]] = []
    for name, values in zip(("as set", "best"), sigma, strict=True):
        figures = (finite(np.max, values), finite(np.mean, values), finite(np.min, values))
        rows.append([name, *(or_dash(fixed(1e6 * v, 2), "unknown") for v in figures)])
    gain = float(errors["gain"]) if "gain" in errors else float("nan")
    words = f" Gain (minimised uncertainty as set / best): {fixed(gain, 2)}." if np.isfinite(gain) else ""
    return Table(
        f"Predicted standard uncertainty over the volume in µm.{words}", ["layout", "largest", "mean", "smallest"], rows
    )


def _targets(position: Array) -> Table:
    rows: list[list[Cell | str]] = [
        [integer(k), *(fixed(1e3 * v, 1) for v in row)] for k, row in enumerate(position, 1)
    ]
    return Table("Targets to measure: axis positions.", ["target", "X / mm", "Y / mm", "Z / mm"], rows)
