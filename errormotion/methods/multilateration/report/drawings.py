"""Drawings of a network in space and in section: error vectors, stations and lines of sight, ellipsoids, slices."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from errormotion.arrays import Array
from errormotion.methods.multilateration.report.network import AXES, drawn, left_out, longest, residuals, thinned
from errormotion.report import canvas
from errormotion.report.document import Block, Figure, Source, Text
from errormotion.report.drawings.turntable import TURN, Dots, Ellipsoids, Lines, Scene, draw, enlargement
from errormotion.report.text import finite, fixed, integer, listed, rounded, significant

_VECTORS, _SIGHTS, _ELLIPSOIDS = 400, 60, 150
_ARROW = 0.12  # longest arrow over the diagonal of the volume
_TYPICAL, _LARGEST = 0.015, 0.1  # semi-axis of the median ellipsoid, and of the largest, over the same
_SOFT, _FAINT = "#8a8f98", "#c3c8d0"
_SHADES = ("#7fb0dc", "#2a5599", "#D55E00")  # thirds of the longest, shortest first


def _span(net: xr.Dataset) -> float:
    positions = net["position"].values[drawn(net)]
    return float(np.linalg.norm(np.ptp(positions, axis=0))) if len(positions) else float("nan")


def _box(net: xr.Dataset) -> Lines:
    """Return the edges of the box around the targets."""
    low, high = (f(net["position"].values[drawn(net)], axis=0) for f in (np.min, np.max))
    corners = np.array([[(a, b)[i >> k & 1] for k, (a, b) in enumerate(zip(low, high, strict=True))] for i in range(8)])
    edges = [(corners[i], corners[i | 1 << k]) for i in range(8) for k in range(3) if not i >> k & 1]
    return Lines(np.array(edges), _FAINT, 0.6)


def vectors(source: Source, key: str) -> list[Block]:
    """Return the error vectors in space, enlarged."""
    net = source.errors
    position, error, length, names = (net[name].values for name in ("position", "error", "length", "target"))
    worst = longest(net)
    known = drawn(net)[np.isfinite(error[drawn(net)]).all(axis=1)]
    if not known.size or worst is None or not length[worst] > 0:
        return [
            Text("No error vectors are drawn: no target has a known position and an error other than zero.", "note")
        ]
    factor = enlargement(length[worst], max(_ARROW * _span(net), 2 * length[worst]))
    picked = thinned(known, _VECTORS, worst)
    ends = np.stack([position[picked], position[picked] + factor * error[picked]], axis=1)
    third = np.minimum(3 * length[picked] / length[worst], 2.999).astype(int)
    notes = [_note(net, int(i)) for i in picked]
    parts: list[Lines | Dots | Ellipsoids] = [_box(net), Dots(position[picked], _SOFT, 0.9, notes=notes)]
    parts += [Lines(ends[third == k], colour, 1.0, 3.2) for k, colour in enumerate(_SHADES) if (third == k).any()]
    parts.append(Dots(ends[picked == worst, 0], _SHADES[2], 1.6, [names[worst]]))
    um = 1e6 * length[worst]
    fewer = f" {integer(picked.size)} of {integer(known.size)} targets are drawn." if picked.size < known.size else ""
    caption = (
        f"Error vectors, enlarged {integer(factor)} times, from the commanded positions (dots). Light blue: up to a "
        f"third of the longest, {fixed(um, 2)} µm at {names[worst]}; dark blue: up to two thirds; red: longer."
        f"{fewer}{TURN}"
    )
    alt = f"Error vectors of {integer(picked.size)} targets in space; the longest is {fixed(um, 2)} µm."
    return [Figure(draw(Scene(parts), key), caption, alt)]


def _note(net: xr.Dataset, target: int) -> str:
    """Return the name of a target and its errors with their expanded uncertainty, one line each."""
    sigma = np.sqrt(np.diag(net["variance"].values[target]).clip(0))
    errors = zip(("EX", "EY", "EZ"), net["error"].values[target], sigma, strict=True)
    lines = [(name, *rounded(1e6 * value, 2e6 * u)) for name, value, u in errors]
    return "\n".join([net["target"].values[target], *(f"{name}: {value} ± {U} µm" for name, value, U in lines)])


def layout(source: Source, key: str) -> list[Block]:
    """Return stations, targets and the lines of sight between them."""
    net, residual, use = source.errors, residuals(source), left_out(source.errors)
    position, station = net["position"].values, net["station_place"].values
    known = np.flatnonzero(np.isfinite(station).all(axis=1))
    if not (known.size and drawn(net).size):
        return [Text("The layout is not drawn: the positions of the stations are unknown.", "note")]
    picked = thinned(drawn(net), _SIGHTS)
    parts: list[Lines | Dots | Ellipsoids] = [_box(net)]
    broken = []
    for j in known:
        colour = canvas.COLOURS[int(j) % len(canvas.COLOURS)]
        ends = np.stack([np.broadcast_to(station[j], (picked.size, 3)), position[picked]], axis=1)
        seen = np.isfinite(residual[j, picked]) | ~np.isfinite(residual).any()
        seen &= use[j, picked] == 0
        parts.append(Lines(ends[seen], colour + "55", 0.4))
        if (~seen).any():
            broken.append(Lines(ends[~seen], canvas.BLACK, 0.7, dash="3 2"))
    parts += broken
    parts.append(Dots(position[drawn(net) if drawn(net).size <= 2000 else picked], _SOFT, 1.0))
    for j in known:
        colour = canvas.COLOURS[int(j) % len(canvas.COLOURS)]
        parts.append(Dots(station[[j]], colour, 4.0, [net["station"].values[j]]))
    fewer = (
        f" Lines of {integer(picked.size)} of {integer(drawn(net).size)} targets."
        if len(picked) < drawn(net).size
        else ""
    )
    dashed = " Dashed: no reading, or one that was ignored." if broken else ""
    caption = f"Positions of the tracker, targets, and lines of sight.{dashed}{fewer}{TURN}"
    alt = f"{len(known)} positions of the tracker around {integer(drawn(net).size)} targets."
    return [Figure(draw(Scene(parts), key), caption, alt)]


def ellipsoids(source: Source, key: str) -> list[Block]:
    """Return the uncertainty of the targets as ellipsoids, enlarged."""
    net = source.errors
    sigma = net["worst_direction"].values
    known = drawn(net)[np.isfinite(sigma[drawn(net)]) & (sigma[drawn(net)] > 0)]
    if not known.size:
        return [Text("No ellipsoids are drawn: the uncertainties of the targets are unknown.", "note")]
    worst = int(known[np.argmax(sigma[known])])
    largest, typical = 2 * sigma[worst], 2 * float(np.median(sigma[known]))
    wanted = _span(net) * min(_LARGEST, _TYPICAL * largest / typical)
    factor = enlargement(largest, max(wanted, 2 * largest))
    picked = thinned(known, _ELLIPSOIDS, worst)
    parts: list[Lines | Dots | Ellipsoids] = [
        _box(net),
        Ellipsoids(net["position"].values[picked], (2 * factor) ** 2 * net["variance"].values[picked], canvas.BLUE),
        Dots(net["position"].values[[worst]], canvas.VERMILLION, 1.2, [net["target"].values[worst]]),
    ]
    caption = (
        f"Uncertainty of the targets, k = 2: ellipsoids enlarged {integer(factor)} times. The longest semi-axis is "
        f"{significant(1e6 * largest)} µm, at {net['target'].values[worst]}; the median over the targets is "
        f"{significant(1e6 * typical)} µm. Contributions common to all targets are included.{TURN}"
    )
    return [Figure(draw(Scene(parts), key), caption, f"Uncertainty ellipsoids of {integer(picked.size)} targets.")]


def _layer(net: xr.Dataset, axis: int) -> tuple[np.ndarray, float]:
    """Return the targets of the middle layer along an axis, and its position, m."""
    along = net["position"].values[drawn(net), axis]
    span = float(np.ptp(along))
    levels = np.unique(np.round(along / max(span, 1e-9), 4)) * max(span, 1e-9)
    if levels.size <= 40:  # a grid
        middle = float(levels[(levels.size - 1) // 2])
        reach = 1e-3 * span + 1e-9
    else:
        middle, reach = float(np.median(along)), span / 12
    return drawn(net)[np.abs(along - middle) <= reach], middle


def slices(source: Source, key: str) -> list[Block]:
    """Return the errors in the middle layers across Z, Y and X."""
    net = source.errors
    known = np.asarray(np.isfinite(net["error"].values).all(axis=1))
    if not (drawn(net).size and known[drawn(net)].any()):
        return [Text("No sections are drawn: no target has a known position and error.", "note")]
    size = finite(np.max, net["length"].values)
    factor = enlargement(size, max(1.5 * _ARROW * _span(net), 2 * size))
    shown = [np.abs(net["error"].values[_layer(net, k)[0], k]) for k in range(3)]
    top = finite(np.max, np.concatenate(shown))
    top = 1e6 * top if top > 0 else 1.0

    def paint(figure: Canvas) -> None:
        panels = figure.subplots(1, 3)
        figure.subplots_adjust(left=0.095, right=0.985, top=0.92, bottom=0.33, wspace=0.34)
        for axes, normal in zip(panels, (2, 1, 0), strict=True):
            _slice(axes, net, normal, factor, top, known)
        bar = figure.add_axes((0.3, 0.15, 0.4, 0.03))
        edges = np.linspace(-top, top, 42)
        bar.pcolor(edges, [0, 1], ((edges[1:] + edges[:-1]) / 2)[None], cmap="RdBu_r", vmin=-top, vmax=top)
        bar.set_yticks([])
        bar.grid(visible=False)
        bar.set_xlabel("error perpendicular to the layer / µm")

    where = [f"{AXES[k]} = {fixed(1e3 * _layer(net, k)[1], 1)} mm" for k in (2, 1, 0)]
    caption = (
        f"Errors in the middle layers, at {listed(where)} (positions of the reflector): arrows, enlarged "
        f"{integer(factor)} times, for the error in the layer, colours for the error perpendicular to it."
    )
    return [Figure(canvas.draw(paint, key, 3.0), caption, f"Sections through the volume at {listed(where)}.")]


def _slice(axes: Axes, net: xr.Dataset, normal: int, factor: int, top: float, known: np.ndarray) -> None:
    a, b = (k for k in range(3) if k != normal)
    layer, _ = _layer(net, normal)
    layer = thinned(layer[known[layer]], _VECTORS)
    position, error = net["position"].values[layer], net["error"].values[layer]
    axes.set_title(f"perpendicular to {AXES[normal]}")
    axes.set_xlabel(f"{'xyz'[a]} / mm")
    axes.set_ylabel(f"{'xyz'[b]} / mm")
    axes.set_aspect("equal", adjustable="datalim")
    if not layer.size:
        axes.text(0.5, 0.5, "no target", transform=axes.transAxes, ha="center", color="#555555")
        return
    h, v = 1e3 * position[:, a], 1e3 * position[:, b]
    across = 1e6 * error[:, normal]
    axes.scatter(h, v, 30, across, cmap="RdBu_r", vmin=-top, vmax=top, edgecolors="#666666", linewidths=0.4)
    axes.quiver(
        h, v, *(1e3 * factor * error[:, [a, b]]).T, angles="xy", scale_units="xy", scale=1,
        color=canvas.BLACK, width=0.006, headwidth=3.5, headlength=4, headaxislength=3.5,
    )  # fmt: skip
    ends = 1e3 * np.concatenate([position, position + factor * error])
    axes.update_datalim(ends[:, [a, b]])
    axes.margins(0.08)
    axes.autoscale_view()


def histograms(source: Source, key: str) -> list[Block]:
    """Return histograms of the three coordinates of the errors, and of their length."""
    net = source.errors
    data: list[Array] = [*(1e6 * net["error"].values.T), 1e6 * net["length"].values]
    if not any(np.isfinite(values).any() for values in data):
        return [Text("No histograms are drawn: the errors of the targets are unknown.", "note")]
    names = ["EX", "EY", "EZ", "length of the vector"]

    def paint(figure: Canvas) -> None:
        panels = figure.subplots(1, 4)
        figure.subplots_adjust(left=0.065, right=0.985, top=0.88, bottom=0.23, wspace=0.28)
        for axes, values, name in zip(panels, data, names, strict=True):
            kept = values[np.isfinite(values)]
            axes.set_title(name)
            axes.set_xlabel("µm")
            if kept.size:
                bins = int(np.clip(2 * np.cbrt(kept.size), 5, 40))
                axes.hist(kept, bins=bins, color=canvas.SKY, edgecolor="white", linewidth=0.4)
                axes.axvline(float(np.mean(kept)), color=canvas.VERMILLION, linewidth=1.0)
        panels[0].set_ylabel("targets")

    rms = ", ".join(
        f"{name} {fixed(float(np.sqrt(finite(np.mean, v**2))), 2)} µm" for name, v in zip(names, data, strict=True)
    )
    caption = f"Distribution of the errors over the targets; the line is the mean. Root mean squares: {rms}."
    return [Figure(canvas.draw(paint, key, 1.75), caption, f"Histograms of the errors. Root mean squares: {rms}.")]
