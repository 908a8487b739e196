"""Drawings of beam and nominal beam: in space with enlarged deviation, and along the beam with the planes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.spatial import ConvexHull, QhullError

from errormotion.arrays import Array
from errormotion.methods.beam_direction.report.view import BeamView, across
from errormotion.report import canvas
from errormotion.report.document import Figure
from errormotion.report.text import ARCSEC, fixed, integer, significant

_GREY, _LIGHT = "#666666", "#b9bec6"
_DEVIATION_LENGTH = 0.3  # drawn length of the deviation, as a share of the beam's
_HEIGHT = 3.5  # inch
_CIRCLE = np.linspace(0, 2 * np.pi, 73)
_PLANE_COLOURS = (canvas.BLUE, canvas.GREEN, canvas.PURPLE, canvas.ORANGE, canvas.SKY, canvas.BLACK)


def space(beam: BeamView, key: str) -> Figure | None:
    """Return the drawing of beam and nominal beam, in space and along nominal; None if either is unknown."""
    if not (beam.known and np.isfinite(beam.nominal).all()) or beam.direction @ beam.nominal <= 0:
        return None
    e, names = across(beam.nominal)
    tips = {"measured": e @ (beam.direction / (beam.direction @ beam.nominal))}
    if beam.compensated and beam.uncompensated @ beam.nominal > 0:
        tips["uncompensated"] = e @ (beam.uncompensated / (beam.uncompensated @ beam.nominal))
    largest = max(float(np.linalg.norm(tip)) for tip in tips.values())
    ring = round_up(max(largest, ARCSEC) / ARCSEC) * ARCSEC
    factor = round_down(_DEVIATION_LENGTH / ring)
    cone = ellipse(e @ beam.covariance[3:, 3:] @ e.T)
    cone_factor = factor
    if cone is not None and np.abs(cone).max() > 0:
        cone_factor = max(factor, round_down(0.06 / float(np.abs(cone).max())))

    def paint(figure: Canvas) -> None:
        axes = figure.add_axes((0.0, 0.02, 0.5, 0.88))
        _in_space(axes, _Camera(beam.nominal, e), beam.nominal, e, names, tips, cone, (factor, cone_factor, ring))
        _triad(figure, _Camera(beam.nominal, e))
        high, wide = figure.get_figheight(), figure.get_figwidth()
        _along(figure.add_axes((3.9 / wide, 0.44 / high, 2.6 / wide, 2.6 / high)), names, tips, cone, ring)
        _key(figure, beam, "uncompensated" in tips)

    angle = angle_between(beam.direction, beam.nominal)
    caption = (
        "Beam and nominal beam. Left, in space, from a common zero point: the deviation enlarged "
        f"{number(factor)} times"
    )
    if cone is not None:
        caption += f", the cone of the expanded uncertainty (k = 2) {number(cone_factor)} times"
    caption += f"; the disc is perpendicular to the nominal beam, its rim at {number(ring / ARCSEC)} arcsec. Right: "
    caption += "view along the nominal beam, to scale" + ("." if cone is None else ", the ellipse as well.")
    towards = ", ".join(
        f"{fixed(tip / ARCSEC, 0, signed=True)} arcsec towards {name}"
        for tip, name in zip(tips["measured"], names, strict=True)
    )
    alt = f"Beam {beam.name} and nominal beam in space, {fixed(angle / ARCSEC, 0)} arcsec apart: {towards}."
    return Figure(canvas.draw(paint, key, _HEIGHT), caption, alt)


def _in_space(
    axes: Axes,
    camera: _Camera,
    nominal: Array,
    e: Array,
    names: tuple[str, str],
    tips: dict[str, Array],
    cone: Array | None,
    sizes: tuple[float, float, float],
) -> None:
    factor, cone_factor, ring = sizes
    start = np.zeros(3)
    _disc(axes, camera, nominal, e, names, factor * ring)
    axes.plot(*camera(np.stack([start, nominal])).T, color=_GREY, lw=1.0, dashes=(6, 3))
    if "uncompensated" in tips:
        tip = nominal + factor * tips["uncompensated"] @ e
        axes.plot(*camera(np.stack([start, tip])).T, color=canvas.BLUE, lw=1.1, dashes=(2, 1.5))
        axes.plot(*camera(tip), marker="o", ms=3, color=canvas.BLUE)
    tip = nominal + factor * tips["measured"] @ e
    if cone is not None:
        _cone(axes, camera, tip + cone_factor * cone @ e)
    axes.plot(*camera(np.stack([start, tip])).T, color=canvas.VERMILLION, lw=1.8)
    axes.plot(*camera(tip), marker="o", ms=3.5, color=canvas.VERMILLION)
    axes.plot(*camera(start), marker="o", ms=5, color="#222222")
    aside = -1 if camera(nominal)[0] > 0 else 1
    axes.annotate(
        "zero point",
        tuple(camera(start)),
        xytext=(7 * aside, 0),
        textcoords="offset points",
        ha="left" if aside > 0 else "right",
        va="center",
    )
    axes.set_aspect("equal")
    axes.axis("off")
    axes.margins(0.06, 0.06)


def _along(axes: Axes, names: tuple[str, str], tips: dict[str, Array], cone: Array | None, ring: float) -> None:
    """Draw the tips as seen along the nominal beam, in arcsec."""
    r = ring / ARCSEC
    circle = np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)], axis=1)
    axes.fill(*(r * circle).T, facecolor="#f3f4f6", edgecolor=_LIGHT, lw=0.8)
    axes.plot(*(0.5 * r * circle).T, color=_LIGHT, lw=0.6)
    axes.plot(0, 0, marker="+", ms=9, color=_GREY, mew=1.0)
    if "uncompensated" in tips:
        axes.plot(*(tips["uncompensated"] / ARCSEC), marker="o", ms=3.5, color=canvas.BLUE)
    tip = tips["measured"] / ARCSEC
    if cone is not None:
        axes.fill(*(tip + cone / ARCSEC).T, facecolor=canvas.VERMILLION, alpha=0.4, lw=0.4, edgecolor=canvas.VERMILLION)
    axes.plot(*tip, marker="o", ms=3, color=canvas.VERMILLION)
    axes.set(xlim=(-1.06 * r, 1.06 * r), ylim=(-1.06 * r, 1.06 * r), aspect="equal")
    axes.set_axisbelow(True)
    axes.set_xlabel(f"towards {names[0]} / arcsec")
    axes.set_ylabel(f"towards {names[1]} / arcsec")


def lines(beam: BeamView, key: str) -> Figure | None:
    """Return the drawing of the conditions of the planes, viewed along the beam; None if no plane is known.

    To first order g.u = -1 is a line across the beam at the distance (1 + g.u) / |g across|.
    """
    known = np.flatnonzero(np.isfinite(beam.planes.gradient).all(axis=1)) if beam.known else np.array([], int)
    if known.size == 0:
        return None
    axes_across, names = across(beam.direction)
    C = axes_across @ beam.covariance[3:, 3:] @ axes_across.T
    ring = ellipse(C)
    tilts = beam.planes.gradient[known] @ axes_across.T
    slope = np.linalg.norm(tilts, axis=1)
    shown = slope > 0.02  # flatter planes do not determine the direction
    if not shown.any():
        return None
    offset = -beam.planes.gradient[known] @ beam.direction - 1
    variance = np.einsum("i,pij,j->p", beam.direction, beam.planes.gradient_covariance[known], beam.direction)
    half = 2 * np.sqrt(np.where(variance >= 0, variance, np.nan)) / np.where(shown, slope, 1.0)
    distance = offset / np.where(shown, slope, 1.0)
    reach = max(
        2.2 * (float(np.abs(ring).max()) if ring is not None else 0.0),
        1.4 * float(np.nanmax(np.abs(distance[shown]))),
        2.0 * float(np.nanmedian(half[shown])) if np.isfinite(half[shown]).any() else 0.0,
        1e-9,
    )

    def paint(figure: Canvas) -> None:
        high, wide = figure.get_figheight(), figure.get_figwidth()
        axes = figure.add_axes((0.62 / wide, 0.44 / high, 2.7 / wide, 2.7 / high))
        r = reach / ARCSEC
        for i, plane in enumerate(known):
            if shown[i]:
                _line(axes, tilts[i] / slope[i], distance[i] / ARCSEC, half[i] / ARCSEC, r, colour_of(plane))
        if ring is not None:
            axes.fill(*(ring / ARCSEC).T, facecolor=canvas.VERMILLION, alpha=0.25, lw=0)
            axes.plot(*(ring / ARCSEC).T, color=canvas.VERMILLION, lw=1.2)
        axes.plot(0, 0, marker="o", ms=4, color=canvas.VERMILLION, zorder=6)
        axes.set(xlim=(-r, r), ylim=(-r, r), aspect="equal")
        axes.set_xlabel(f"towards {names[0]} / arcsec")
        axes.set_ylabel(f"towards {names[1]} / arcsec")
        flat = [beam.planes.names[plane] for i, plane in enumerate(known) if not shown[i]]
        _legend(axes, beam, [int(plane) for i, plane in enumerate(known) if shown[i]], flat)

    distances = "; ".join(
        f"plane {beam.planes.names[plane]} at {significant(abs(distance[i]) / ARCSEC)} arcsec"
        for i, plane in enumerate(known)
        if shown[i]
    )
    check = " The lines of two planes always intersect, so that they are not a check." if shown.sum() == 2 else ""
    caption = (
        "Condition of each plane for the direction, viewed along the beam, which is in the middle: every direction "
        "on the line of a plane fulfils its condition. Bands: noise of its readings, k = 2; narrower for more inclined "
        "planes."
    )
    return Figure(canvas.draw(paint, key, 3.3), caption + check, f"Distances of the lines from the beam: {distances}.")


def ellipse(covariance: Array) -> Array | None:
    """Return the outline (n, 2) at twice the standard uncertainty; None if the covariance (2, 2) is unknown."""
    if not np.isfinite(covariance).all():
        return None
    values, vectors = np.linalg.eigh(covariance)
    sizes = 2 * np.sqrt(values.clip(0))
    return np.asarray((vectors @ (sizes[:, None] * np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)]))).T)


def angle_between(direction: Array, other: Array) -> float:
    """Return the angle between two unit vectors, rad."""
    return math.atan2(float(np.linalg.norm(np.cross(direction, other))), float(direction @ other))


def round_down(value: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not larger than a value."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))


def round_up(value: float) -> float:
    """Return the smallest of 1, 2, 3 and 5 times a power of ten that is not smaller than a value."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(min(step * power for step in (1, 2, 3, 5, 10) if step * power >= value * (1 - 1e-9)))


def number(value: float) -> str:
    """Return a round number as text, without trailing zeros."""
    return integer(value) if value >= 1 else significant(value, 1)


def colour_of(plane: int) -> str:
    """Return the colour of a plane."""
    return _PLANE_COLOURS[plane % len(_PLANE_COLOURS)]


class _Camera:
    """Parallel projection onto the page in which the length of the beam and the disc about its tip are both visible."""

    def __init__(self, nominal: Array, across: Array) -> None:
        best, self._axes = -1.0, np.zeros((2, 3))
        for azimuth in np.deg2rad(np.arange(-75, 285, 15) + 7.0):  # of equal scores the first is kept: from the front
            for elevation in np.deg2rad([32.0, 20.0, 45.0]):
                c, s = math.cos(elevation), math.sin(elevation)
                toward = np.array([c * math.cos(azimuth), c * math.sin(azimuth), s])
                right = np.cross([0.0, 0.0, 1.0], toward)
                right /= np.linalg.norm(right)
                axes = np.stack([right, np.cross(toward, right)])
                length = float(np.linalg.norm(axes @ nominal))
                area = abs(float(np.linalg.det(axes @ across.T)))
                score = min(length, 2 * area)
                if score > best + 1e-6:
                    best, self._axes = score, axes

    def __call__(self, points: Array) -> Array:
        """Return points (..., 2) on the page of points (..., 3) in space."""
        return np.asarray(points @ self._axes.T)


def _disc(axes: Axes, camera: _Camera, centre: Array, e: Array, names: tuple[str, str], r: float) -> None:
    """Draw rings about the nominal tip and lines towards two machine axes."""
    circle = np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)], axis=1) @ e
    axes.fill(*camera(centre + r * circle).T, facecolor="#f3f4f6", edgecolor=_LIGHT, lw=0.8)
    axes.plot(*camera(centre + 0.5 * r * circle).T, color=_LIGHT, lw=0.6)
    for axis, name in zip(e, names, strict=True):
        axes.plot(*camera(np.stack([centre - r * axis, centre + 1.1 * r * axis])).T, color=_LIGHT, lw=0.6)
        x, y = camera(centre + 1.22 * r * axis)
        axes.text(x, y, f"+{name}", color=_GREY, fontsize=7, ha="center", va="center")


def _cone(axes: Axes, camera: _Camera, outline: Array) -> None:
    """Draw a cone from the zero point to an outline (n, 3)."""
    flat = camera(np.concatenate([np.zeros((1, 3)), outline]))
    try:
        hull = flat[ConvexHull(flat).vertices]
    except QhullError:  # edge-on it is a line, covered by the beam
        return
    axes.fill(*hull.T, facecolor=canvas.VERMILLION, alpha=0.16, lw=0)
    axes.fill(*camera(outline).T, facecolor=canvas.VERMILLION, alpha=0.3, edgecolor=canvas.VERMILLION, lw=0.8)


def _triad(figure: Canvas, camera: _Camera) -> None:
    """Draw the machine's axes in a corner."""
    corner = figure.add_axes((0.01, 0.02, 0.12, 0.25))
    for axis, name in zip(np.eye(3), "XYZ", strict=True):
        x, y = camera(axis)
        corner.annotate(
            "", (x, y), (0, 0), arrowprops={"arrowstyle": "-|>", "color": _GREY, "lw": 0.8, "shrinkA": 0, "shrinkB": 0}
        )
        size = math.hypot(x, y)
        if size > 0.1:
            corner.text(x * (1 + 0.25 / size), y * (1 + 0.25 / size), name, color=_GREY, ha="center", va="center")
    corner.set(xlim=(-1.4, 1.4), ylim=(-1.4, 1.4), aspect="equal")
    corner.axis("off")


def _key(figure: Canvas, beam: BeamView, uncompensated: bool) -> None:
    handles = [
        Line2D([], [], color=_GREY, lw=1.0, dashes=(6, 3), marker="+", ms=7, label="nominal"),
        Line2D(
            [],
            [],
            color=canvas.VERMILLION,
            lw=1.8,
            marker="o",
            ms=3,
            label="measured, compensated" if beam.compensated else "measured",
        ),
    ]
    if uncompensated:
        style: dict[str, Any] = {"color": canvas.BLUE, "lw": 1.1, "dashes": (2, 1.5), "marker": "o", "ms": 3}
        handles.append(Line2D([], [], label="without compensation", **style))
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.0, 1.01), ncols=3)


def _line(axes: Axes, normal: Array, distance: float, half: float, reach: float, colour: str) -> None:
    """Draw the line of one plane and its band."""
    along = np.array([-normal[1], normal[0]])
    ends = np.outer([-3 * reach, 3 * reach], along) + distance * normal
    if math.isfinite(half):
        band = np.concatenate([ends - half * normal, (ends + half * normal)[::-1]])
        axes.fill(*band.T, facecolor=colour, alpha=0.12, lw=0)
    axes.plot(*ends.T, color=colour, lw=1.1)


def _legend(axes: Axes, beam: BeamView, planes: list[int], flat: list[str]) -> None:
    """Draw the legend of planes and ellipse, with the deviations of nominal and of the uncompensated beam."""
    degrees = np.rad2deg(np.stack([beam.planes.inclination, beam.planes.rotation]))
    handles: list[Line2D | Patch] = []
    for plane in planes:
        tilt = f": inclination {fixed(degrees[0, plane], 1)}°, rotation {fixed(degrees[1, plane], 0)}°"
        label = f"plane {beam.planes.names[plane]}{tilt if np.isfinite(degrees[:, plane]).all() else ''}"
        handles.append(Line2D([], [], color=colour_of(plane), lw=1.1, label=label))
    handles.append(
        Patch(facecolor=canvas.VERMILLION, alpha=0.4, label="direction of the beam, all sources of uncertainty, k = 2")
    )
    axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.05, 1.02))
    lines = []
    axes_across, names = across(beam.direction)
    for name, direction in (("nominal", beam.nominal), ("without compensation", beam.uncompensated)):
        if np.isfinite(direction).all() and (name == "nominal" or beam.compensated):
            x, y = axes_across @ (direction / (direction @ beam.direction)) / ARCSEC
            lines.append(
                f"{name}: {fixed(x, 0, signed=True)} arcsec towards {names[0]}, "
                f"{fixed(y, 0, signed=True)} towards {names[1]}"
            )
    if flat:
        lines.append(f"not drawn, perpendicular to the beam: plane {', '.join(flat)}")
    axes.text(1.07, 0.02, "\n".join(lines), transform=axes.transAxes, color=_GREY, va="bottom", linespacing=1.5)
