"""The check bar that was measured with the beam: fitted circle and enlarged residuals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.kinematics.beams import across
from errormotion.methods.beam_direction.report.drawings import number, round_down
from errormotion.methods.beam_direction.report.view import STROKES
from errormotion.report import canvas
from errormotion.report.document import Block, Cell, Figure, Source, Table, Text, estimate, or_dash
from errormotion.report.fields import field
from errormotion.report.text import finite, fixed, integer

_DRAWN_RESIDUAL = 0.25  # drawn length of the largest residual, as a share of the radius
_MAX_LISTED = 20


@dataclass(frozen=True)
class Bar:
    """A check bar in the plane across its axis.

    Attributes
    ----------
    angle, residual : (n,)
        Azimuth of each point about the axis, rad, and its residual, m, positive outside; NaN without a reading.
    left_out : (n,) of bool
    centre : (3,)
        m; NaN if unknown.
    centre_u : (3,)
        Standard uncertainty, m.
    radius, radius_u, given : float
        Fitted radius, its standard uncertainty, and the known radius of the bar, m.
    names : (str, str)
        Names of the two directions of the drawing.
    """

    angle: Array
    residual: Array
    left_out: NDArray[np.bool_]
    centre: Array
    centre_u: Array
    radius: float
    radius_u: float
    given: float
    names: tuple[str, str]

    @property
    def rms(self) -> float:
        """Root mean square of the residuals of the points that were used, m."""
        return math.sqrt(finite(np.mean, self.residual[~self.left_out] ** 2))


def bar_of(source: Source) -> Bar | None:
    """Return the bar of a result, if it contains one."""
    errors = source.errors
    if "bar_residual" not in errors or errors["bar_residual"].ndim != 1:
        return None
    (dim,) = errors["bar_residual"].dims
    residual = field(errors, "bar_residual", str(dim))
    n = residual.size
    points = np.full((n, 3), np.nan)
    if "bar_point" in errors and set(errors["bar_point"].dims) == {dim, "direction"}:
        points = field(errors, "bar_point", str(dim), "direction")
    centre = _vector(errors, "bar_centre")
    axes, names = _plane(_axis(source, points))
    flat = (points - centre) @ axes.T
    out = np.zeros(n, dtype=bool)
    if "bar_left_out" in errors and errors["bar_left_out"].shape == (n,):
        out = np.nan_to_num(np.asarray(errors["bar_left_out"].values, float)) > 0
    return Bar(
        np.arctan2(flat[:, 1], flat[:, 0]),
        residual,
        out & np.isfinite(residual),
        centre,
        _vector(errors, "bar_centre_u"),
        _scalar(errors, "bar_radius_fitted"),
        _scalar(errors, "bar_radius_u"),
        _scalar(errors, "bar_radius") if "bar_radius" in errors else _scalar(source.raw, "bar_radius"),
        names,
    )


def blocks(bar: Bar, key: str) -> list[Block]:
    """Return the section on the check bar; ``key`` makes the identifiers of its figure unique."""
    used = int((np.isfinite(bar.residual) & ~bar.left_out).sum())
    rows: list[list[Cell | str]] = [
        [f"centre, {name}", "mm", _coordinate(value, u)]
        for name, value, u in zip("xyz", bar.centre, bar.centre_u, strict=True)
    ]
    rows.append(["radius", "mm", estimate(1e3 * bar.radius, 2e3 * bar.radius_u, digits=6, signed=False)])
    if math.isfinite(bar.given):
        rows.append(["known radius of the bar", "mm", fixed(1e3 * bar.given, 4)])
        difference = 1e6 * (bar.radius - bar.given)
        rows.append(["difference of the radii", "µm", estimate(difference, 2e6 * bar.radius_u)])
    rows.append(["points used", "", integer(used)])
    rows.append(["points left out", "", integer(int(bar.left_out.sum()))])
    rows.append(["residual, rms of the points used", "µm", or_dash(fixed(1e6 * bar.rms, 2), "no residuals")])
    table = Table(
        "Check bar measured with this beam. After ±: expanded uncertainty, k = 2.", ["quantity", "unit", "value"], rows
    )
    outliers = [_outliers(bar)] if bar.left_out.any() else []
    drawn = figure(bar, key) or Text("The points of the bar are not in the result.", "note")
    return [table, *outliers, drawn]


def _coordinate(value: float, u: float) -> Cell:
    if u == 0:
        return Cell(fixed(1e3 * value, 3, signed=True), reason="along the bar, in which the centre is not determined")
    return estimate(1e3 * value, 2e3 * u, digits=7)


def _outliers(bar: Bar) -> Table:
    left_out = np.flatnonzero(bar.left_out)
    rows: list[list[Cell | str]] = [
        [
            f"point {k + 1}",
            or_dash(fixed(np.rad2deg(bar.angle[k]), 1), "its position is not in the result"),
            fixed(1e6 * bar.residual[k], 1, signed=True),
        ]
        for k in left_out[:_MAX_LISTED]
    ]
    notes = [f"{len(left_out) - _MAX_LISTED} more are in the dataset."] if len(left_out) > _MAX_LISTED else []
    caption = "Points of the bar that were left out as outliers."
    return Table(caption, ["point", "azimuth / °", "residual / µm"], rows, notes=notes)


def figure(bar: Bar, key: str) -> Figure | None:
    """Return the circle with its residuals enlarged, and the residuals over azimuth; None without points."""
    shown = np.isfinite(bar.angle) & np.isfinite(bar.residual)
    used = shown & ~bar.left_out
    if not used.any() or not bar.radius > 0:
        return None
    largest = float(np.abs(bar.residual[used]).max())
    factor = max(round_down(_DRAWN_RESIDUAL * bar.radius / largest), 1.0) if largest > 0 else 1.0
    middle = _middle(bar.angle[used])
    turned = np.angle(np.exp(1j * (bar.angle - middle)))

    def paint(canvas_: Canvas) -> None:
        wide, high = canvas_.get_figwidth(), canvas_.get_figheight()
        _circle(canvas_.add_axes((0.58 / wide, 0.42 / high, 2.4 / wide, 2.4 / high)), bar, factor, shown)
        axes = canvas_.add_axes((3.65 / wide, 0.42 / high, 3.1 / wide, 2.3 / high))
        x, y = np.rad2deg(turned), 1e6 * bar.residual
        axes.axhline(0, color="#888888", linewidth=0.6)
        axes.plot(x[used], y[used], color=canvas.VERMILLION, lw=0.9, marker="o", ms=3)
        reach = 1.3 * 1e6 * largest if largest > 0 else 1.0
        for k in np.flatnonzero(shown & bar.left_out):
            axes.plot(x[k], np.clip(y[k], -0.95 * reach, 0.95 * reach), "x", color="#222222", ms=5, mew=1.1)
            axes.annotate(
                f"{k + 1}: {fixed(y[k], 1, signed=True)}",
                (x[k], np.clip(y[k], -0.95 * reach, 0.95 * reach)),
                xytext=(5, 0),
                textcoords="offset points",
                va="center",
                fontsize=7,
            )
        axes.set_ylim(-reach, reach)
        axes.set_xlabel("azimuth from the middle of the points / °")
        axes.set_ylabel("residual / µm")

    crosses = " Crosses: points left out, with their number." if (shown & bar.left_out).any() else ""
    caption = (
        f"Section across the check bar, in mm. Dots: the measured points, their distance from the fitted circle "
        f"enlarged {number(factor)} times; right: the residuals over azimuth.{crosses}"
    )
    alt = (
        f"Circle of radius {fixed(1e3 * bar.radius, 4)} mm with {integer(int(used.sum()))} points, residuals up to "
        f"{fixed(1e6 * largest, 1)} µm, rms {fixed(1e6 * bar.rms, 2)} µm, {integer(int(bar.left_out.sum()))} left out."
    )
    return Figure(canvas.draw(paint, key, 2.95), caption, alt)


def _circle(axes: Axes, bar: Bar, factor: float, shown: NDArray[np.bool_]) -> None:
    r = 1e3 * bar.radius
    turn = np.linspace(0, 2 * np.pi, 181)
    axes.fill(r * np.cos(turn), r * np.sin(turn), facecolor="#f3f4f6", edgecolor="#666666", lw=0.9)
    axes.plot(0, 0, marker="+", color="#666666", ms=8, mew=0.8)
    order = [k for k in np.argsort(np.angle(np.exp(1j * (bar.angle - _middle(bar.angle[shown]))))) if shown[k]]
    used = np.array([k for k in order if not bar.left_out[k]])
    far = r * (1 + 1.4 * _DRAWN_RESIDUAL)
    radial = np.clip(r + 1e3 * factor * bar.residual, r * (1 - 1.4 * _DRAWN_RESIDUAL), far)
    x, y = radial * np.cos(bar.angle), radial * np.sin(bar.angle)
    axes.plot(x[used], y[used], color=canvas.VERMILLION, lw=0.8)
    for k in used:
        axes.plot(
            [r * math.cos(bar.angle[k]), x[k]], [r * math.sin(bar.angle[k]), y[k]], color=canvas.VERMILLION, lw=0.5
        )
    axes.plot(x[used], y[used], "o", color=canvas.VERMILLION, ms=2.4)
    for k in np.flatnonzero(shown & bar.left_out):
        axes.plot(x[k], y[k], "x", color="#222222", ms=5, mew=1.1)
        axes.annotate(str(k + 1), (x[k], y[k]), xytext=(5, 3), textcoords="offset points", fontsize=7)
    axes.set(xlim=(-1.02 * far, 1.02 * far), ylim=(-1.02 * far, 1.02 * far), aspect="equal")
    axes.set_xlabel(f"{bar.names[0]} from the centre / mm")
    axes.set_ylabel(f"{bar.names[1]} from the centre / mm")


def _middle(angle: Array) -> float:
    return float(np.angle(np.exp(1j * angle).sum()))


def _vector(errors: xr.Dataset, name: str) -> Array:
    if name not in errors or errors[name].shape != (3,):
        return np.full(3, np.nan)
    return np.asarray(errors[name].values, float)


def _scalar(errors: xr.Dataset | None, name: str) -> float:
    return float(errors[name]) if errors is not None and name in errors and errors[name].ndim == 0 else math.nan


def _axis(source: Source, points: Array) -> Array:
    """Return the direction of the bar: the stated one, or the normal of the plane of its points."""
    for dataset in (source.errors, source.raw):
        if dataset is not None and "bar_axis" in dataset:
            axis = _vector(dataset, "bar_axis")
            if np.isfinite(axis).all() and np.linalg.norm(axis) > 0:
                return axis / float(np.linalg.norm(axis))
    known = points[np.isfinite(points).all(axis=1)]
    if len(known) < 3:
        return np.array([0.0, 0.0, 1.0])
    return np.asarray(np.linalg.svd(known - known.mean(axis=0))[2][2])


def _plane(axis: Array) -> tuple[Array, tuple[str, str]]:
    """Return two unit vectors (2, 3) across the bar, machine axes if it is parallel to one, and their names."""
    along = int(np.argmax(np.abs(axis)))
    if abs(axis[along]) < 1 - 1e-6:
        return across(axis), ("across 1", "across 2")
    first, second = (i for i in range(3) if i != along)
    return np.eye(3)[[first, second]], (STROKES[first], STROKES[second])
