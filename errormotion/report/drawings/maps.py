"""Maps in vector graphics: coloured cells and filled contours; a diverging scale has zero in its middle."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Colormap, LinearSegmentedColormap, ListedColormap
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from matplotlib.ticker import MaxNLocator

from errormotion.arrays import Array
from errormotion.report.canvas import BLUE, VERMILLION

#: Blue below zero, white at zero, vermillion above: distinguishable with any colour vision.
DIVERGING = LinearSegmentedColormap.from_list(
    "diverging", ["#00305A", BLUE, "#9CCBE8", "#FFFFFF", "#F5BE98", VERMILLION, "#6B2A00"]
)


def scale_of(values: Array, most: int, colours: Colormap = DIVERGING) -> ScalarMappable:
    """Return a scale of about ``most`` bands with round limits over the finite values.

    A diverging scale has its middle at zero, is symmetric, and shows only the used bands.
    """
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (-1.0, 1.0)
    centred = colours is DIVERGING
    if centred:
        low, high = min(low, 0.0), max(high, 0.0)
    if not high > low:
        low, high = low - 0.5 * max(abs(low), 1e-9), high + 0.5 * max(abs(high), 1e-9)
    bounds = np.asarray(MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high), dtype=float)
    middles = (bounds[1:] + bounds[:-1]) / 2
    farthest = np.abs(bounds).max()
    share = 0.5 + 0.5 * middles / farthest if centred else (middles - bounds[0]) / (bounds[-1] - bounds[0])
    used = ListedColormap(colours(share))
    return ScalarMappable(BoundaryNorm(bounds, used.N), used)


def cells(axes: Axes, x: Array, y: Array, values: Array, scale: ScalarMappable) -> None:
    """Draw a cell for each value; NaN is empty.

    Equal neighbours in a row are joined to one rectangle, and all rectangles of one colour to one path: a map of
    40 x 40 cells has about 50 kB.

    Parameters
    ----------
    x, y : (u,), (v,)
        Centres of the cells, increasing.
    values : (v, u)
    scale : ScalarMappable
        From `scale_of`.
    """
    bounds = np.asarray(scale.norm.boundaries)  # type: ignore[attr-defined]
    band = np.clip(np.searchsorted(bounds, values, side="right") - 1, 0, bounds.size - 2)
    band = np.where(np.isfinite(values), band, -1)
    across, up = edges(x), edges(y)
    for number in np.unique(band[band >= 0]):
        rectangles = []
        for row in range(y.size):
            inside = np.concatenate([[False], band[row] == number, [False]])
            low, high = up[row], up[row + 1]
            for left, right in across[np.flatnonzero(inside[1:] != inside[:-1]).reshape(-1, 2)]:
                rectangles.append([(left, low), (right, low), (right, high), (left, high), (left, low)])
        codes = [Path.MOVETO, *[Path.LINETO] * 3, Path.CLOSEPOLY] * len(rectangles)
        colour = scale.to_rgba((bounds[number] + bounds[number + 1]) / 2)
        # The thin outline hides gaps between the rectangles.
        axes.add_patch(PathPatch(Path(np.concatenate(rectangles), codes), facecolor=colour, edgecolor=colour, lw=0.3))
    axes.set_xlim(across[0], across[-1])
    axes.set_ylim(up[0], up[-1])


def contours(axes: Axes, x: Array, y: Array, values: Array, scale: ScalarMappable) -> None:
    """Draw filled contours between the values of a coarse grid.

    Parameters
    ----------
    x, y : (u,), (v,)
        Increasing.
    values : (v, u)
        Triangles with a NaN are empty.
    scale : ScalarMappable
        From `scale_of`.
    """
    masked = np.ma.masked_invalid(values)
    bounds = np.asarray(scale.norm.boundaries)  # type: ignore[attr-defined]
    axes.contourf(x, y, masked, levels=bounds, cmap=scale.cmap, norm=scale.norm, corner_mask=True)
    inside = bounds[(bounds > masked.min()) & (bounds < masked.max())]
    for levels, colour, width in ((inside, "#ffffff", 0.4), (inside[inside == 0], "#444444", 0.8)):
        if levels.size:  # the white lines also hide gaps between the bands
            axes.contour(x, y, masked, levels=levels, colors=colour, linewidths=width, corner_mask=True)


def edges(middles: Array) -> Array:
    """Return the bounds (n + 1,) of cells from their increasing centres (n,)."""
    if middles.size < 2:
        half = 0.5 if not middles.size or middles[0] == 0 else 0.05 * abs(float(middles[0]))
        return np.concatenate([middles - half, middles + half])
    between = (middles[1:] + middles[:-1]) / 2
    return np.concatenate([[2 * middles[0] - between[0]], between, [2 * middles[-1] - between[-1]]])


def colour_bar(axes: Axes, scale: ScalarMappable, place: tuple[float, float, float, float], label: str) -> None:
    """Draw a colour bar at ``place`` (left, bottom, width, height), fractions of the figure."""
    figure = axes.figure
    bar = figure.colorbar(scale, cax=figure.add_axes(place), spacing="proportional", drawedges=False)
    bar.outline.set_linewidth(0.4)
    bounds = np.asarray(scale.norm.boundaries)  # type: ignore[attr-defined]
    every = max(1, int(np.ceil((bounds.size - 1) / 8)))
    zero = int(np.argmin(np.abs(bounds)))
    bar.set_ticks([float(bounds[i]) for i in range(bounds.size) if (i - zero) % every == 0])
    bar.minorticks_off()
    bar.ax.tick_params(labelsize=7, width=0.4, length=2)
    bar.ax.set_title(label, fontsize=7.5, fontweight="normal", loc="left", pad=5.5)
