"""What drawings of a chapter have in common: panels in a grid, picked curves and their colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import matplotlib
import numpy as np
import xarray as xr
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D

from errormotion.arrays import Array
from errormotion.datasets.results.places import Scale, coordinate_of, place_of, scale_of
from errormotion.report import canvas
from errormotion.report.elements.quantities import Of, Quantity, spans
from errormotion.report.text import fixed, signs

Panel = str | Of | Sequence[str | Of]
"""What one panel shows: a quantity, or several in one unit."""

_LEFT, _BETWEEN, _END = 0.52, 0.5, 0.1
_HEAD, _GAP, _FOOT, _LEGEND = 0.26, 0.3, 0.44, 0.2
_LABEL = 0.17
"""Room for the label of an abscissa between two rows, inch."""
_LETTER = 4.6
"""Width of a letter of a legend, points."""


def quantities(panel: Panel, ds: xr.Dataset) -> list[Quantity]:
    """Return the quantities of a panel that the dataset contains."""
    stated = [panel] if isinstance(panel, str | Of) else list(panel)
    found = (each.read(ds) if isinstance(each, Of) else Of(each).read(ds) for each in stated)
    return [each for each in found if each is not None]


def sorted_along(ds: xr.Dataset, dim: str) -> tuple[Scale, np.ndarray]:
    """Return the scale of a dim with increasing values, and the order of its places."""
    scale = scale_of(ds, dim)
    order = np.argsort(scale.values, kind="stable")
    return scale._replace(
        label=scale.label.replace("_", " "),
        values=scale.values[order],
        texts=[scale.texts[k] for k in order] if scale.texts else [],
    ), order


def evenly(indices: Sequence[int], most: int) -> list[int]:
    """Return at most this number of indices, with the first and the last."""
    if not len(indices):
        return []
    return [int(indices[k]) for k in np.unique(np.linspace(0, len(indices) - 1, most).round().astype(int))]


Look = tuple[str, tuple[float, ...] | None]
"""Colour and dashes of a curve."""


def looks(ds: xr.Dataset, others: Sequence[str], count: int) -> list[Look]:
    """Return the look of each curve: from light to dark along a scale, legible in grey; else different ones."""
    if len(others) == 1 and scale_of(ds, others[0]).joined and count > 1:
        ramp = matplotlib.colormaps["viridis_r"]
        return [(matplotlib.colors.to_hex(ramp(place)), None) for place in np.linspace(0.22, 1.0, count)]
    return [look(k) for k in range(count)]


def look(number: int) -> Look:
    """Return the look of a curve by its number."""
    dash, colour = divmod(number, len(canvas.COLOURS))
    return canvas.COLOURS[colour], canvas.DASHES[dash % len(canvas.DASHES)]


def name_of(ds: xr.Dataset, others: Sequence[str], index: int) -> str:
    """Return the place of a curve along the other dims; without the name of the only one, which the legend states."""
    at = np.unravel_index(index, [ds.sizes[dim] for dim in others]) if others else ()
    text = place_of(ds, others, at)
    if len(others) == 1 and text.startswith(f"{(name := coordinate_of(ds, others[0]))} "):
        return text.removeprefix(f"{name} ")
    return text


def stated_spans(found: Sequence[Quantity]) -> str:
    """Return the lowest and highest value of each quantity as text, for readers who cannot see the drawing."""
    words = []
    for each in found:
        low, high = spans(each)
        span = f"{fixed(low, 2)} to {fixed(high, 2)} {each.unit}".strip() if np.isfinite(low) else "not observed"
        words.append(f"{each.name} {span}")
    return "; ".join(words)


def grid(
    paints: Sequence[Callable[[Axes], None]],
    key: str,
    *,
    columns: int,
    tall: float,
    down: bool = False,
    right: float = 0.0,
    label: str = "",
    legend: Sequence[tuple[str, Look]] = (),
    frames: bool = True,
) -> Markup:
    """Return the drawing of panels in a grid.

    Parameters
    ----------
    paints : sequence of callable
        Each draws one panel.
    key : str
        Makes the identifiers of the drawing unique.
    columns : int
    tall : float
        Height of a panel, inch.
    down : bool
        Whether panels follow one another downwards and not to the right.
    right : float
        Room on the right of each panel, inch.
    label : str
        Of the abscissa, below the lowest panels.
    legend : sequence of (name, look)
    frames : bool
        Whether the panels have axes of their own.
    """
    rows = -(-len(paints) // columns)
    left, between = (_LEFT, _BETWEEN) if frames else (0.1, 0.15)
    wide = (canvas.WIDTH - left - (columns - 1) * between - _END - columns * right) / columns
    each = max(1, int(72 * canvas.WIDTH / (_LETTER * max((len(name) for name, _ in legend), default=1) + 30)))
    lines = -(-len(legend) // each)
    foot = (_FOOT if label else 0.25 if frames else 0.08) + _LEGEND * lines
    gap = _GAP if frames else 0.32
    high = _HEAD + rows * tall + (rows - 1) * gap + foot

    def paint(figure: Canvas) -> None:
        for k, draw in enumerate(paints):
            row, column = (k % rows, k // rows) if down else divmod(k, columns)
            x, y = left + column * (wide + between + right), high - _HEAD - (row + 1) * tall - row * gap
            axes = figure.add_axes((x / canvas.WIDTH, y / high, wide / canvas.WIDTH, tall / high))
            draw(axes)
            lowest = row == rows - 1 or (not down and k + columns >= len(paints))
            if label and lowest:
                axes.set_xlabel(signs(label))
            elif label:
                axes.tick_params(labelbottom=False)
        if legend:
            handles = [
                Line2D([], [], color=colour, linewidth=1.4, linestyle=(0, dash) if dash else "-")
                for _, (colour, dash) in legend
            ]
            figure.legend(
                handles, [name for name, _ in legend], loc="lower center", ncols=min(each, len(legend)),
                handlelength=1.2, handletextpad=0.4, columnspacing=1.0, borderaxespad=0.1,
            )  # fmt: skip

    return canvas.draw(paint, key, high)


def beside(axes: Axes) -> tuple[float, float]:
    """Return the place of the label of an ordinate at the left edge of the drawing, in parts of the panel."""
    wide = axes.get_position().width * axes.figure.get_figwidth()  # type: ignore[union-attr]
    return -(_LEFT - 0.12) / wide, 0.5


def empty(axes: Axes) -> None:
    """Mark a panel without known values."""
    axes.text(0.5, 0.5, "not observed", transform=axes.transAxes, ha="center", va="center", color="#555555")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(visible=False)


def points(axes: Axes, x: Array, values: Array, expanded: Array | None, colour: str) -> None:
    """Draw points with bars of the expanded uncertainty."""
    known = np.isfinite(values)
    bars = None if expanded is None else np.where(np.isfinite(expanded), expanded, 0.0)[known]
    if known.any():
        axes.errorbar(
            x[known], values[known], bars, fmt="o", markersize=2.1, color=colour, elinewidth=0.7, markeredgewidth=0
        )
