"""Drawings of probed balls: displacements and residuals."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from errormotion.arrays import Array
from errormotion.methods.normal_vector.report import balls as of
from errormotion.methods.normal_vector.report.balls import MISSING, MOVED, UNDETERMINED, WRONG
from errormotion.report import canvas
from errormotion.report.document import Block, Figure, Source, Text
from errormotion.report.drawings import timeline
from errormotion.report.drawings.turntable import TURN, Dots, Ellipsoids, Lines, Scene, draw, enlargement
from errormotion.report.text import finite, fixed, integer, listed

_LONGEST = 0.22  # drawn length of the longest displacement, relative to the diagonal of the balls
_FAINT, _SOFT = "#c3c8d0", "#6f7680"
_SHADES = ("#a9c8e4", "#6f9fce", "#2f6fb0", "#12386b")  # quarters of the record, earliest first
_MAX_CYCLES = 240  # drawn for each ball
_MAX_DOTS = 600  # residuals drawn for each ball
_MAX_BALLS = 8  # panels of residuals


def balls(source: Source, key: str) -> list[Block]:
    """Return the balls in space with their magnified displacement since the cold cycle, coloured by time."""
    errors = source.errors
    names, cold, moved, well_known = of.names_of(errors), _cold(errors), of.displacement(errors), of.well_known(errors)
    known = np.flatnonzero(np.isfinite(cold).all(axis=1))
    size = np.where(well_known, np.linalg.norm(moved, axis=2), np.nan)
    if not known.size or not np.nan_to_num(size[:, known]).any():
        return [Text("The result contains no displacements of balls.", "note")]
    longest = finite(np.max, size[:, known])
    span = float(np.linalg.norm(np.ptp(cold[known], axis=0)))
    factor = enlargement(longest, max(_LONGEST * span, 2 * longest))
    parts: list[Lines | Dots | Ellipsoids] = [Lines(_table(cold[known]), _FAINT, 0.6)]
    feet = cold[known] * (1, 1, 0) + (0, 0, _floor(cold[known]))
    parts.append(Lines(np.stack([cold[known], feet], axis=1), _FAINT, 0.5, dash="2 2"))
    whole, own = _paths(errors, cold, factor)
    for shade, ends in zip(_SHADES, whole, strict=True):
        if len(ends):
            parts.append(Lines(ends, shade, 1.3))
    if len(own):
        parts.append(Lines(own, canvas.VERMILLION, 1.3, dash="3 2"))
    moved_names = of.moved_names(errors)
    for end, colour in (("", _SOFT), (" (moved)", canvas.VERMILLION)):
        picked = [i for i in known if (names[i] in moved_names) is bool(end)]
        if picked:
            parts.append(Dots(cold[picked], colour, 3.4, [names[i] + end for i in picked]))
    last = [(np.flatnonzero(well_known[:, i]), i) for i in known]
    ends = np.array([cold[i] + factor * moved[k[-1], i] for k, i in last if k.size])
    if len(ends):
        parts.append(Dots(ends, canvas.BLACK, 1.6))
    k, i = np.unravel_index(int(np.nanargmax(np.where(np.isfinite(size), size, -1.0))), size.shape)
    poor = int((np.isfinite(moved).all(axis=2) & ~well_known).sum())
    caption = (
        f"Balls on the table in the cold cycle (grey), and their apparent displacements, magnified {integer(factor)} "
        "times: light in the first quarter of the record, dark in the last, with a black point at the last known "
        f"cycle. The largest is {fixed(1e6 * float(size[k, i]), 1)} µm, of {names[i]}. The displacement of the "
        "tool side is opposite."
        + (
            f" Red, dashed: {listed(moved_names)}, which moved on the table and was not used afterwards."
            if moved_names
            else ""
        )
        + (
            f" Not drawn: {integer(poor)} centres that are poorly determined because of missing touches."
            if poor
            else ""
        )
        + TURN
    )
    alt = f"Balls {listed(names)} in space with their displacements, magnified {integer(factor)} times."
    return [Figure(draw(Scene(parts), key), caption, alt)]


def cold(errors: xr.Dataset) -> tuple[list[str], Array] | None:
    """Return names and centres of the balls in the first cycle; None without balls."""
    return (of.names_of(errors), of.centres(errors)[0][0]) if "centre" in errors else None


def _cold(errors: xr.Dataset) -> np.ndarray:
    """Return the centres in the cold cycle, (ball, 3)."""
    moved = of.displacement(errors)
    if not moved.size:
        return np.full((0, 3), np.nan)
    first = of.centres(errors)[0] - moved
    known = np.asarray(np.isfinite(first).all(axis=2))
    cold: np.ndarray = first[known.argmax(axis=0), np.arange(first.shape[1])]  # NaN where never known
    return cold


def _floor(cold: np.ndarray) -> float:
    return float(cold[:, 2].min()) - 0.04 * float(np.linalg.norm(np.ptp(cold, axis=0)))


def _table(cold: np.ndarray) -> np.ndarray:
    """Return the edges of a rectangle below the balls, with a margin, (4, 2, 3)."""
    margin = 0.08 * np.ptp(cold[:, :2], axis=0)
    (x0, y0), (x1, y1) = cold[:, :2].min(axis=0) - margin, cold[:, :2].max(axis=0) + margin
    corners = np.array([[x, y, _floor(cold)] for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))])
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def _paths(errors: xr.Dataset, cold: np.ndarray, factor: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the steps between cycles by quarter of the record, and those of balls that had moved: each (k, 2, 3)."""
    parts: list[list[np.ndarray]] = [[] for _ in _SHADES]
    own: list[np.ndarray] = []
    time, away, well_known, had_moved = (
        errors["time"].values.astype(float), of.displacement(errors), of.well_known(errors), of.moved(errors)
    )  # fmt: skip
    start, span = time[0], max(float(np.ptp(time)), 1e-9)
    for i in range(len(cold)):
        known = np.flatnonzero(well_known[:, i])
        known = known[np.unique(np.linspace(0, known.size - 1, _MAX_CYCLES).astype(int))] if known.size else known
        position = cold[i] + factor * away[known, i]
        for a, b, k in zip(position, position[1:], known[1:], strict=False):
            step = np.stack([a, b])
            if had_moved[k, i]:
                own.append(step)
            else:
                quarter = int(min(len(_SHADES) * (time[k] - start) / span, len(_SHADES) - 1e-9))
                parts[quarter].append(step)
    return [np.array(steps) for steps in parts], np.array(own)


def residuals(source: Source, key: str) -> list[Block]:
    """Return the residuals of every ball over time; excluded ones are marked."""
    errors = source.errors
    names, (values, kind), used = of.names_of(errors), of.residuals(errors), of.used(errors)
    if not np.isfinite(values).any():
        return [Text("The result contains no residuals.", "note")]
    noise = float(errors["noise"]) if "noise" in errors else np.nan
    shown = list(range(min(len(names), _MAX_BALLS)))
    top = 1e6 * finite(np.max, np.abs(used)) if np.isfinite(used).any() else 1.0
    top = 1.15 * max(top, 2.2e6 * noise if np.isfinite(noise) else 0.0, 1e-3)
    heights = [0.62] * len(shown)
    time = timeline.clock(errors["time"].values.astype(float))

    def paint(figure: Canvas) -> None:
        panels = canvas.stack(figure, heights)
        for axes, i in zip(panels, shown, strict=True):
            if np.isfinite(noise):
                axes.axhspan(-2e6 * noise, 2e6 * noise, color=canvas.SKY, alpha=0.15, linewidth=0)
            _residuals_of(axes, 1e6 * values[:, i], kind[:, i], time.values, top)
            axes.set_title(f"{names[i]} / µm")
        timeline.time_axis(panels[-1], time)
        margin = 0.02 * float(np.ptp(time.values)) or 1.0
        panels[-1].set_xlim(time.values[0] - margin, time.values[-1] + margin)

    out = np.array([int((kind == each).sum()) for each in (MISSING, WRONG, MOVED, UNDETERMINED)])
    marks = ((0, "red bars at the bottom: missing"), (1, "crosses: outliers"), (2, "squares: the ball had moved"))
    words = [word for k, word in marks if out[k]] + (["triangles: cycle not determined"] if out[3] else [])
    legend = f" {'; '.join(words).capitalize()}; at the upper edge if the residual is unknown." if words else ""
    fewer = f" The first {_MAX_BALLS} of {len(names)} balls are drawn." if len(names) > _MAX_BALLS else ""
    band = " Band: twice the noise of a touch." if np.isfinite(noise) else ""
    what = of.what(errors)
    caption = f"Residuals of the {what} by ball over time: measured minus fitted distance.{band}{legend}{fewer}"
    rms = 1e6 * float(np.sqrt(finite(np.mean, used**2)))
    alt = f"Residuals of {integer(int(np.isfinite(used).sum()))} {what}; root mean square {fixed(rms, 3)} µm."
    return [Figure(canvas.draw(paint, key, canvas.stack_height(heights)), caption, alt)]


def _residuals_of(axes: Axes, y: np.ndarray, kind: np.ndarray, time: np.ndarray, top: float) -> None:
    m = y.shape[1]
    step = float(np.median(np.diff(time))) if time.size > 1 else 1.0
    across = time[:, None] + 0.5 * step * ((np.arange(m) + 0.5) / m - 0.5)
    used = np.argwhere(np.isfinite(y) & (kind == 0))
    used = used[:: -(-len(used) // _MAX_DOTS)] if len(used) > _MAX_DOTS else used
    axes.plot(across[tuple(used.T)], y[tuple(used.T)], ".", color=canvas.BLUE, markersize=3.2, markeredgewidth=0)
    for what, look, colour in (
        (WRONG, "x", canvas.BLACK),
        (MOVED, "s", canvas.VERMILLION),
        (UNDETERMINED, "^", canvas.PURPLE),
    ):
        where = kind == what
        height = np.clip(np.nan_to_num(y[where], nan=top), -top, top)
        axes.plot(
            across[where], height, look, color=colour, markersize=3.6, markerfacecolor="none", markeredgewidth=0.8,
            clip_on=False,
        )  # fmt: skip
    lost = across[(kind == MISSING)]
    axes.plot(lost, np.full(lost.size, -top), "|", color=timeline.UNKNOWN, markersize=6, clip_on=False)
    axes.axhline(0, color="#888888", linewidth=0.6)
    axes.set_ylim(-1.04 * top, 1.04 * top)
    axes.locator_params(axis="y", nbins=4)
