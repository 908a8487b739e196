"""Drawings of a chapter as data: curves over a dim, polar plots over an angle, maps over two dims."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from errormotion.arrays import Array
from errormotion.datasets.results.places import Scale, in_field_units, scale_of
from errormotion.report import canvas
from errormotion.report.document import Block, Figure, Source, noted
from errormotion.report.drawings import maps
from errormotion.report.elements import panels
from errormotion.report.elements.panels import Panel
from errormotion.report.elements.quantities import UNITS, Of, Quantity
from errormotion.report.elements.tables import filled
from errormotion.report.text import listed, significant, signs

_BANDS = "Bands: expanded uncertainty, k = 2."
_SMOOTH = "Points and curves: values and smoothed values; bars and bands: expanded uncertainty, k = 2."
_BARS = "Points and bars: values and expanded uncertainty, k = 2."


@dataclass(frozen=True)
class Curves:
    """Quantities over one dim, a panel each, with bands of the expanded uncertainty (k = 2).

    Attributes
    ----------
    caption : str
        `{name}` is replaced by an attribute of the dataset, ``{over}`` by the dim.
    variables : sequence
        One panel each: the name of a variable or freedom, an `Of`, or several of one unit. By default the errors. Those
        over other dims than the first are left out.
    over : str
        Dim of the abscissa; by default the time, else the longest dim of the first quantity.
    band : bool
        Whether the uncertainty is drawn.
    columns : int
        Panels beside one another; by default 2 for more than one panel.
    most : int
        Curves in one panel along further dims, which are evenly selected. Those in the reference state (all 0) are
        left out.
    smooth : (str, str)
        A variable of smoothed values over the further dims, an abscissa and ``dof``, and the dim of this abscissa. It
        is drawn as the curve; the values are then points.
    at : str
        A variable over the dims of the quantities with the exact place of each point, in the SI unit of the abscissa.
        If the dim has no scale, it is the abscissa.
    absent : str
        A note in place of the drawing if nothing is known.
    """

    caption: str = "Error motions over {over}, actual minus commanded."
    variables: Sequence[Panel] = ()
    over: str = ""
    band: bool = True
    columns: int = 0
    most: int = 5
    smooth: tuple[str, str] | None = None
    at: str = ""
    absent: str = ""

    def blocks(self, source: Source, key: str) -> list[Block]:
        """Return the drawing; a note or nothing without known values."""
        ds = source.errors
        found = [panels.quantities(panel, ds) for panel in self.variables or ds.em.names]
        found = [each for each in found if each]
        flat = [quantity for each in found for quantity in each]
        if not any(each.known.any() for each in flat):
            return noted(self.absent)
        dims = [str(dim) for dim in flat[0].values.dims]
        found = [[each for each in panel if set(each.values.dims) == set(dims)] for panel in found]
        found, flat = [panel for panel in found if panel], [each for panel in found for each in panel]
        along = self.over or max(dims, key=lambda dim: (dim == "time", ds.sizes[dim]), default="")
        if along not in dims:
            return []
        others = [dim for dim in dims if dim != along]
        known = _known(flat, along, others)
        picks = panels.evenly(np.flatnonzero(known).tolist(), self.most)
        scale, order = panels.sorted_along(ds, along)
        own, scale = _exact(ds, self.at, along, others, order, scale)
        looks = panels.looks(ds, others, len(picks))
        smooth = _smoothed(ds, self.smooth, others)
        columns = self.columns or (1 if len(found) == 1 else 2)

        def paint(axes: Axes, panel: list[Quantity]) -> None:
            unit = panel[0].unit
            title = panel[0].name if len(panel) == 1 else ""
            axes.set_title(f"{title} / {unit}" if columns > 2 and unit else title)
            axes.set_ylabel("" if columns > 2 else unit)
            if not any(each.known.any() for each in panel):
                panels.empty(axes)
                return
            axes.axhline(0, color="#888888", linewidth=0.6)
            for number, each in enumerate(panel):
                values, expanded = (_curves(part, each.size, along, others, order) for part in (each.values, each.u))
                assert values is not None
                for own_look, pick in zip(looks, picks, strict=True):
                    colour, dash = panels.look(number) if len(panel) > 1 else own_look
                    band = 2 * expanded[pick] if expanded is not None and self.band else None
                    name = panels.name_of(ds, others, pick) or each.name
                    if smooth is not None and (curve := smooth(each, pick)) is not None:
                        canvas.curve(axes, *curve, colour=colour, dash=dash, name=name)
                    elif scale.joined and scale.values.size > 1:
                        x = scale.values if own is None else own[pick]
                        canvas.curve(axes, x, values[pick], band, colour=colour, dash=dash, name=name)
                        continue
                    panels.points(axes, scale.values if own is None else own[pick], values[pick], band, colour)
            _ticks(axes, scale)
            limits = [
                (each.name, source.limits[each.of][0] / each.size, source.limits[each.of][1] / each.size)
                for each in panel
                if each.of in source.limits
            ]
            if limits:
                canvas.limit_lines(axes, limits)

        legend: list[tuple[str, panels.Look]] = []
        if others and len(picks) > 1:
            legend = [(panels.name_of(ds, others, pick), each) for pick, each in zip(picks, looks, strict=True)]
        elif any(len(panel) > 1 for panel in found):
            widest = max(found, key=len)
            legend = [(each.name, panels.look(k)) for k, each in enumerate(widest)]
        tall = 1.7 if len(found) == 1 else 1.2 if columns < 3 else 1.42
        svg = panels.grid(
            [partial(paint, panel=panel) for panel in found], key, columns=columns,
            tall=tall, down=columns == 2, label=scale.label, legend=legend,
        )  # fmt: skip
        spoken = along.replace("_", " ")
        caption = filled(self.caption.replace("{over}", spoken), ds)
        if self.band and any(each.u is not None for each in flat):
            caption += f" {_SMOOTH if smooth is not None else _BANDS if scale.joined else _BARS}"
        if others and len(picks) < int(known.sum()):
            caption += f" Shown: {len(picks)} of {int(known.sum())} curves over {listed(others)}."
        return [Figure(svg, caption, f"Curves over {spoken}: {panels.stated_spans(flat)}.")]


@dataclass(frozen=True)
class PolarPlot:
    """Quantities over an angle on circles, enlarged, with bands of the expanded uncertainty (k = 2).

    Attributes
    ----------
    caption : str
        `{name}` is replaced by an attribute of the dataset.
    variables : sequence
        One circle each, as in `Curves`; by default the errors. Unknown quantities are left out.
    over : str
        The dim of the angle, rad.
    columns : int
        Circles beside one another.
    absent : str
        A note in place of the drawing if nothing is known.
    """

    caption: str = "Error motions over {over}, enlarged."
    variables: Sequence[Panel] = ()
    over: str = "angle"
    columns: int = 3
    absent: str = ""

    def blocks(self, source: Source, key: str) -> list[Block]:
        """Return the drawing; a note or nothing without known values over the angle."""
        ds = source.errors
        found = [panels.quantities(panel, ds) for panel in self.variables or ds.em.names]
        shown = [each for each in found if each and each[0].values.dims == (self.over,) and each[0].known.any()]
        if not shown or self.over not in ds.coords:
            return noted(self.absent)
        angle = np.asarray(ds[self.over].values, dtype=float)
        columns = min(self.columns, len(shown))
        tall = min((canvas.WIDTH - 0.2) / columns - 0.15, 2.7)
        svg = panels.grid(
            [partial(_circle, angle=angle, panel=panel) for panel in shown],
            key,
            columns=columns,
            tall=tall,
            frames=False,
        )
        flat = [quantity for each in shown for quantity in each]
        caption = (
            f"{filled(self.caption.replace('{over}', self.over), ds)} Dark circle: zero; the distance of two circles "
            f"is stated below each plot. {_BANDS}"
        )
        return [Figure(svg, caption, f"Polar plots: {panels.stated_spans(flat)}.")]


_INNER = 0.4
"""Radius of the lowest value relative to that of the highest."""
_RINGS = 5


def _circle(axes: Axes, angle: Array, panel: Sequence[Quantity]) -> None:
    """Draw quantities over an angle on circles; positive values are outside of the dark circle."""
    values = [np.asarray(each.values.values, dtype=float) / each.size for each in panel]
    bands = [
        np.zeros_like(value) if each.u is None else np.nan_to_num(2 * np.asarray(each.u.values) / each.size)
        for each, value in zip(panel, values, strict=True)
    ]
    low = min(0.0, *(float(np.nanmin(v - b)) for v, b in zip(values, bands, strict=True)))
    high = max(0.0, *(float(np.nanmax(v + b)) for v, b in zip(values, bands, strict=True)))
    step = _step((high - low) / _RINGS)
    levels = step * np.arange(math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9) + 1)
    if levels.size < 2:
        levels = np.array([-step, 0.0, step])

    def at(value: Any, turn: Any) -> tuple[Any, Any]:
        r = _INNER + (1 - _INNER) * (value - levels[0]) / (levels[-1] - levels[0])
        return r * np.cos(turn), r * np.sin(turn)

    axes.set_axis_off()
    axes.set(aspect="equal", xlim=(-1.25, 1.25), ylim=(-1.3, 1.2))
    axes.set_title(", ".join(each.name for each in panel))
    whole = np.linspace(0, 2 * np.pi, 181)
    for level in levels:
        zero = abs(level) < 0.5 * step
        axes.plot(
            *at(np.full(whole.size, level), whole), color="#555555" if zero else "#d8d8d8",
            linewidth=0.8 if zero else 0.5, label="_nolegend_",
        )  # fmt: skip
    for quarter, turn in enumerate(np.pi / 2 * np.arange(4)):
        axes.plot(*at(levels[[0, -1]], np.full(2, turn)), color="#d8d8d8", linewidth=0.5, label="_nolegend_")
        axes.text(
            1.11 * math.cos(turn),
            1.11 * math.sin(turn),
            f"{90 * quarter}°",
            fontsize=6.5,
            color="#555555",
            ha="center",
            va="center",
        )
    closed = _closed(angle)
    for number, (value, band) in enumerate(zip(values, bands, strict=True)):
        colour = canvas.COLOURS[number % len(canvas.COLOURS)]
        turn, v, b = (np.append(each, each[0]) if closed else each for each in (angle, value, band))
        inner, outer = at(v - b, turn), at(v + b, turn)
        for k in np.flatnonzero(np.isfinite(v[1:]) & np.isfinite(v[:-1])):
            corners = [[part[0][j], part[1][j]] for part, j in ((inner, k), (inner, k + 1), (outer, k + 1), (outer, k))]
            axes.fill(*np.array(corners).T, color=colour, alpha=0.22, linewidth=0)
        axes.plot(
            *at(v, turn), color=colour, linewidth=1.1, marker="o", markersize=1.6, markeredgewidth=0, label="_nolegend_"
        )
    axes.text(
        0, -1.27, f"{significant(step, 1)} {panel[0].unit}", fontsize=6.5, color="#555555", ha="center", va="center"
    )


def _step(least: float) -> float:
    """Return the smallest of 1, 2 and 5 times a power of ten that is not smaller than a value."""
    if not (math.isfinite(least) and least > 0):
        return 1.0
    power = 10.0 ** math.floor(math.log10(least))
    return next(power * k for k in (1, 2, 5, 10) if power * k >= least * (1 - 1e-9))


def _closed(angle: Array) -> bool:
    """Return whether angles cover one revolution, so that the last value is a neighbour of the first."""
    rest = 2 * np.pi - float(np.ptp(angle))
    return angle.size > 2 and 0 <= rest <= 1.5 * float(np.diff(np.sort(angle)).max())


@dataclass(frozen=True)
class Map:
    """Quantities over two dims as filled contours or coloured cells, a panel each.

    Attributes
    ----------
    caption : str
        `{name}` is replaced by an attribute of the dataset.
    x, y : str
        Dims of abscissa and ordinate, both with a scale.
    variables : sequence
        One panel each: the name of a variable or freedom, or an `Of`. By default the errors.
    form : str
        ``contours``: between the values, which are dots; ``cells``: a coloured cell for each value.
    columns : int
        Panels beside one another.
    tall : float
        Height of a panel, inch.
    absent : str
        A note in place of the drawing if nothing is known, or a dim has a single place.
    """

    caption: str
    x: str
    y: str
    variables: Sequence[str | Of] = ()
    form: str = "contours"
    columns: int = 3
    tall: float = 1.42
    absent: str = ""

    def blocks(self, source: Source, key: str) -> list[Block]:
        """Return the drawing; a note or nothing without known values over both dims."""
        ds = source.errors
        found = [each for panel in self.variables or ds.em.names for each in panels.quantities(panel, ds)]
        known = any(each.known.any() for each in found)
        if not known or min(ds.sizes.get(self.x, 0), ds.sizes.get(self.y, 0)) < 2:
            return noted(self.absent)
        (x, across), (y, up) = panels.sorted_along(ds, self.x), panels.sorted_along(ds, self.y)
        if (np.diff(x.values) <= 0).any() or (np.diff(y.values) <= 0).any():
            return noted(self.absent)
        columns = min(self.columns, len(found))

        def paint(axes: Axes, each: Quantity, first: bool) -> None:
            axes.set_title(f"{each.name} / {each.unit}" if each.unit else each.name)
            if first:
                axes.set_ylabel(signs(y.label))
                axes.yaxis.set_label_coords(*panels.beside(axes))
            values = (
                np.asarray(each.values.transpose(self.y, self.x).values, dtype=float)[np.ix_(up, across)] / each.size
            )
            if not np.isfinite(values).any():
                panels.empty(axes)
                return
            scale = maps.scale_of(values, 10)
            (maps.contours if self.form == "contours" else maps.cells)(axes, x.values, y.values, values, scale)
            if self.form == "contours":
                _dots(axes, x.values, y.values, np.isfinite(values))
            axes.grid(visible=False)
            left, bottom, width, height = axes.get_position().bounds
            wide = axes.figure.get_figwidth()  # type: ignore[union-attr]
            maps.colour_bar(axes, scale, (left + width + 0.06 / wide, bottom, 0.08 / wide, height), each.unit)

        paints: list[Callable[[Axes], None]] = [
            partial(paint, each=each, first=k % columns == 0) for k, each in enumerate(found)
        ]
        svg = panels.grid(paints, key, columns=columns, tall=self.tall, right=0.48, label=x.label)
        caption = filled(self.caption, ds)
        if self.form == "contours":
            caption += " Dots: the measured values; between them the values are interpolated linearly."
            if not all(each.known.all() for each in found):
                caption += " Crosses: no value; the area up to the neighbouring values is blank."
        caption += " White and the dark line: zero." if self.form == "contours" else " White: zero."
        return [Figure(svg, caption, f"Maps over {self.x} and {self.y}: {panels.stated_spans(found)}.")]


def _dots(axes: Axes, x: Array, y: Array, known: np.ndarray) -> None:
    """Mark places with and without a value, (y, x)."""
    across, up = np.meshgrid(x, y)
    axes.plot(
        across[known],
        up[known],
        "o",
        markersize=1.5,
        color="#333333",
        markeredgewidth=0,
        clip_on=False,
        zorder=5,
        label="_nolegend_",
    )
    axes.plot(
        across[~known],
        up[~known],
        "x",
        markersize=4,
        color="#222222",
        markeredgewidth=0.9,
        clip_on=False,
        zorder=5,
        label="_nolegend_",
    )


def _known(found: Sequence[Quantity], along: str, others: Sequence[str]) -> np.ndarray:
    """Return which curves over the flat further dims have a value that is measured: not all are exactly 0."""
    some: np.ndarray = np.zeros(int(np.prod([found[0].values.sizes[dim] for dim in others])), bool)
    moved = some.copy()
    for each in found:
        if set(each.values.dims) != {along, *others}:
            continue
        values = each.values.transpose(*others, along).values.reshape(some.size, -1).astype(float)
        u = np.zeros_like(values) if each.u is None else each.u.transpose(*others, along).values.reshape(values.shape)
        some |= np.isfinite(values).any(axis=1)
        moved |= ((np.nan_to_num(values) != 0) | (np.nan_to_num(u) != 0)).any(axis=1)
    return some & moved if (some & moved).any() else some


def _curves(
    part: xr.DataArray | None, size: float, along: str, others: Sequence[str], order: np.ndarray
) -> np.ndarray | None:
    """Return curves over the flat further dims, (curve, place), in the unit of the page."""
    if part is None:
        return None
    rows = part.transpose(*others, along).values.astype(float)
    return np.asarray(rows.reshape(-1, rows.shape[-1])[:, order] / size)


def _exact(
    ds: xr.Dataset, name: str, along: str, others: Sequence[str], order: np.ndarray, scale: Scale
) -> tuple[np.ndarray | None, Scale]:
    """Return the exact places of the points, (curve, place), in the unit of the abscissa, and the scale.

    The places are None without the variable. It is the scale of a dim that has none.
    """
    if name not in ds or set(ds[name].dims) != {along, *others}:
        return None, scale
    unit = scale.label.rpartition(" / ")[2] if scale.joined or scale.texts else in_field_units(ds[name])[1]
    places = _curves(ds[name], UNITS.get(unit, ("", 1.0))[1], along, others, order)
    assert places is not None
    if scale.joined or scale.texts:
        return np.where(np.isfinite(places), places, scale.values), scale
    return places, Scale(places.mean(axis=0), f"{name} / {unit}", [], joined=True)


def _ticks(axes: Axes, scale: Scale) -> None:
    """Label single objects with their names, as far as they fit; angles and times at their usual parts."""
    span = float(np.ptp(scale.values)) if scale.values.size else 0.0
    if scale.label.endswith(" / deg") and span >= 60:
        axes.xaxis.set_major_locator(MaxNLocator(9, steps=[1, 1.5, 3, 4.5, 9, 10]))
    elif scale.label.endswith(" / min") and span >= 60:
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 1.5, 2, 3, 6, 10]))
    if scale.texts:
        every = -(-len(scale.texts) // 12)
        axes.set_xticks(scale.values[::every], scale.texts[::every])


def _smoothed(
    ds: xr.Dataset, stated: tuple[str, str] | None, others: Sequence[str]
) -> Callable[[Quantity, int], tuple[Array, Array, Array | None] | None] | None:
    """Return a function of a quantity and the number of a curve: abscissa, smoothed curve and expanded uncertainty."""
    if stated is None or stated[0] not in ds or stated[1] not in ds.coords:
        return None
    name, dim = stated
    if set(ds[name].dims) != {*others, dim, "dof"} or not np.isfinite(ds[name].values).any():
        return None
    x = scale_of(ds, dim).values

    def curve(each: Quantity, pick: int) -> tuple[Array, Array, Array | None] | None:
        if each.of not in ds["dof"].values:
            return None
        values, u = (
            ds[part].sel(dof=each.of).transpose(*others, dim).values.reshape(-1, ds.sizes[dim])[pick] / each.size
            if part in ds
            else None
            for part in (name, f"{name}_u")
        )
        assert values is not None
        return x, values, None if u is None else 2 * u

    return curve
