"""Results of a plan: the map of the uncertainty over the volume, as set and best, and the chosen targets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.figure import Figure as Canvas

from errormotion.arrays import Array
from errormotion.report import canvas
from errormotion.report.document import Block, Figure, Source, Text
from errormotion.report.drawings import maps
from errormotion.report.elements import Column, Own, Sentence, Table
from errormotion.report.text import finite, fixed, integer

_LEVELS = 3
_SAME = 1e-7  # m


def drawing(source: Source, key: str) -> list[Block]:
    """Return the map; nothing if the plan has none."""
    errors = source.errors
    if "map_uncertainty" not in errors or errors["map_uncertainty"].dims != ("setup", "place"):
        return []
    position = np.asarray(errors["map_position"].values, float)
    chosen = np.asarray(errors["chosen"].values == 1) if "chosen" in errors else np.zeros(len(position), bool)
    return [_map(position, np.asarray(errors["map_uncertainty"].values, float), chosen, key)]


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


def _setups(errors: xr.Dataset) -> xr.Dataset | None:
    """Return the plan with the names of its layouts; None without a map."""
    if "map_uncertainty" not in errors:
        return None
    return errors.assign_coords(setup=["as set", "best"]).assign(
        map_uncertainty=errors["map_uncertainty"].assign_attrs(units="m")
    )


def _chosen(errors: xr.Dataset) -> xr.Dataset | None:
    """Return the places to measure; None if the plan chooses none."""
    if "chosen" not in errors or "map_position" not in errors:
        return None
    return errors.isel(place=np.flatnonzero(errors["chosen"].values == 1))


def _number(errors: xr.Dataset, dims: Sequence[str], index: Sequence[int]) -> str:  # noqa: ARG001 - one dim
    return integer(index[0] + 1)


PARTS = (
    Own(drawing),
    Table(
        "Predicted standard uncertainty over the volume.",
        tuple(
            Column("map_uncertainty", "none", "um", head=head, format=".2", signed=False, reduce=how, reason="unknown")
            for head, how in (("largest", "highest"), ("mean", "mean"), ("smallest", "lowest"))
        ),
        over="setup",
        head="layout",
        of=_setups,
    ),
    Sentence(
        "Gain (minimised uncertainty as set / best): {gain}.",
        {"gain": lambda errors: fixed(float(errors["gain"]), 2) if "gain" in errors else None},
    ),
    Table(
        "Targets to measure: axis positions.",
        tuple(
            Column("map_position", "none", "mm", {"direction": axis}, head=axis.upper(), format=".1", signed=False)
            for axis in "xyz"
        ),
        over="place",
        head="target",
        of=_chosen,
        place=_number,
    ),
    Sentence(
        "The best layout, as settings of a campaign, is the attribute best_layout of the plan's dataset; the setting "
        "planning.write writes it to a file.",
        when=lambda errors: "best_layout" in errors.attrs,
    ),
)
STATIONS = Table(
    "Positions of the tracker as set (drawn above), and the best within the boxes.",
    tuple(
        Column(name, "none", "mm", {"direction": axis}, head=axis, format=".0", signed=False, reason="unknown")
        for name in ("station_place", "best_place")
        for axis in "xyz"
    ),
    over="station",
    of=lambda net: net if np.isfinite(net["best_place"]).any() else None,
    groups=(("", 1), ("as set", 3), ("best", 3)),
    absent="The plan contains no better positions.",
)
