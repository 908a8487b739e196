"""The beam and the nominal beam: in space, with enlarged deviation, and along the beam with the planes."""

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
from errormotion.methods.beam_direction.report.view import Found, across
from errormotion.report import canvas
from errormotion.report.document import Figure
from errormotion.report.text import ARCSEC, fixed, integer, significant

_GREY, _LIGHT = "#666666", "#b9bec6"
_TILT = 0.3  # of the deviation's drawn length by the beam's
_HEIGHT = 3.5  # inch
_CIRCLE = np.linspace(0, 2 * np.pi, 73)
_OF_PLANES = (canvas.BLUE, canvas.GREEN, canvas.PURPLE, canvas.ORANGE, canvas.SKY, canvas.BLACK)


def space(beam: Found, key: str) -> Figure | None:
    """Return beam and nominal beam, in space and along nominal; None where either is unknown."""
    if not (beam.known and np.isfinite(beam.nominal).all()) or beam.direction @ beam.nominal <= 0:
        return None
    e, names = across(beam.nominal)
    tips = {"measured": e @ (beam.direction / (beam.direction @ beam.nominal))}
    if beam.compensated and beam.uncompensated @ beam.nominal > 0:
        tips["uncompensated"] = e @ (beam.uncompensated / (beam.uncompensated @ beam.nominal))
    largest = max(float(np.linalg.norm(tip)) for tip in tips.values())
    ring = round_up(max(largest, ARCSEC) / ARCSEC) * ARCSEC
    factor = round_down(_TILT / ring)
    cone = ellipse(e @ beam.covariance[3:, 3:] @ e.T)
    cone_factor = factor
    if cone is not None and np.abs(cone).max() > 0:
        cone_factor = max(factor, round_down(0.06 / float(np.abs(cone).max())))

    def paint(figure: Canvas) -> None:
        room = figure.add_axes((0.0, 0.02, 0.5, 0.88))
        _in_space(room, _Camera(beam.nominal, e), beam.nominal, e, names, tips, cone, (factor, cone_factor, ring))
        _triad(figure, _Camera(beam.nominal, e))
        high, wide = figure.get_figheight(), figure.get_figwidth()
        _along(figure.add_axes((3.9 / wide, 0.44 / high, 2.6 / wide, 2.6 / high)), names, tips, cone, ring)
        _key(figure, beam, "uncompensated" in tips)

    angle = angle_between(beam.direction, beam.nominal)
    words = f"Beam and nominal beam. Left, in space, from one zero point: the deviation enlarged {times(factor)}"
    if cone is not None:
        words += f", the cone of the expanded uncertainty (k = 2) {times(cone_factor)}"
    words += f"; the disc is perpendicular to the nominal beam, its rim {number(ring / ARCSEC)} arcsec from it. Right: "
    words += "view along the nominal beam, to scale" + ("." if cone is None else ", the ellipse as well.")
    towards = ", ".join(
        f"{fixed(tip / ARCSEC, 0, signed=True)} arcsec towards {name}"
        for tip, name in zip(tips["measured"], names, strict=True)
    )
    alt = f"Beam {beam.name} and nominal beam in space, {fixed(angle / ARCSEC, 0)} arcsec apart: {towards}."
    return Figure(canvas.draw(paint, key, _HEIGHT), words, alt)


def _in_space(
    room: Axes,
    look: _Camera,
    nominal: Array,
    e: Array,
    names: tuple[str, str],
    tips: dict[str, Array],
    cone: Array | None,
    sizes: tuple[float, float, float],
) -> None:
    factor, cone_factor, ring = sizes
    start = np.zeros(3)
    _disc(room, look, nominal, e, names, factor * ring)
    room.plot(*look(np.stack([start, nominal])).T, color=_GREY, lw=1.0, dashes=(6, 3))
    if "uncompensated" in tips:
        tip = nominal + factor * tips["uncompensated"] @ e
        room.plot(*look(np.stack([start, tip])).T, color=canvas.BLUE, lw=1.1, dashes=(2, 1.5))
        room.plot(*look(tip), marker="o", ms=3, color=canvas.BLUE)
    tip = nominal + factor * tips["measured"] @ e
    if cone is not None:
        _cone(room, look, tip + cone_factor * cone @ e)
    room.plot(*look(np.stack([start, tip])).T, color=canvas.VERMILLION, lw=1.8)
    room.plot(*look(tip), marker="o", ms=3.5, color=canvas.VERMILLION)
    room.plot(*look(start), marker="o", ms=5, color="#222222")
    aside = -1 if look(nominal)[0] > 0 else 1
    room.annotate(
        "zero point",
        tuple(look(start)),
        xytext=(7 * aside, 0),
        textcoords="offset points",
        ha="left" if aside > 0 else "right",
        va="center",
    )
    room.set_aspect("equal")
    room.axis("off")
    room.margins(0.06, 0.06)


def _along(room: Axes, names: tuple[str, str], tips: dict[str, Array], cone: Array | None, ring: float) -> None:
    """Draw the tips as seen along the nominal beam, in arcsec."""
    r = ring / ARCSEC
    circle = np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)], axis=1)
    room.fill(*(r * circle).T, facecolor="#f3f4f6", edgecolor=_LIGHT, lw=0.8)
    room.plot(*(0.5 * r * circle).T, color=_LIGHT, lw=0.6)
    room.plot(0, 0, marker="+", ms=9, color=_GREY, mew=1.0)
    if "uncompensated" in tips:
        room.plot(*(tips["uncompensated"] / ARCSEC), marker="o", ms=3.5, color=canvas.BLUE)
    tip = tips["measured"] / ARCSEC
    if cone is not None:
        room.fill(*(tip + cone / ARCSEC).T, facecolor=canvas.VERMILLION, alpha=0.4, lw=0.4, edgecolor=canvas.VERMILLION)
    room.plot(*tip, marker="o", ms=3, color=canvas.VERMILLION)
    room.set(xlim=(-1.06 * r, 1.06 * r), ylim=(-1.06 * r, 1.06 * r), aspect="equal")
    room.set_axisbelow(True)
    room.set_xlabel(f"towards {names[0]} / arcsec")
    room.set_ylabel(f"towards {names[1]} / arcsec")


def lines(beam: Found, key: str) -> Figure | None:
    """Return the condition of each plane for the direction, along the beam; None where no plane is known.

    To first order g.u = -1 is a line across the beam at the distance (1 + g.u) / |g across|.
    """
    known = np.flatnonzero(np.isfinite(beam.planes.gradient).all(axis=1)) if beam.known else np.array([], int)
    if known.size == 0:
        return None
    axes_across, names = across(beam.direction)
    C = axes_across @ beam.covariance[3:, 3:] @ axes_across.T
    ring = ellipse(C)
    seen = beam.planes.gradient[known] @ axes_across.T
    steep = np.linalg.norm(seen, axis=1)
    steady = steep > 0.02  # flatter planes do not determine the direction
    if not steady.any():
        return None
    offset = -beam.planes.gradient[known] @ beam.direction - 1
    variance = np.einsum("i,pij,j->p", beam.direction, beam.planes.gradient_covariance[known], beam.direction)
    half = 2 * np.sqrt(np.where(variance >= 0, variance, np.nan)) / np.where(steady, steep, 1.0)
    distance = offset / np.where(steady, steep, 1.0)
    reach = max(
        2.2 * (float(np.abs(ring).max()) if ring is not None else 0.0),
        1.4 * float(np.nanmax(np.abs(distance[steady]))),
        2.0 * float(np.nanmedian(half[steady])) if np.isfinite(half[steady]).any() else 0.0,
        1e-9,
    )

    def paint(figure: Canvas) -> None:
        high, wide = figure.get_figheight(), figure.get_figwidth()
        room = figure.add_axes((0.62 / wide, 0.44 / high, 2.7 / wide, 2.7 / high))
        r = reach / ARCSEC
        for i, plane in enumerate(known):
            if steady[i]:
                _line(room, seen[i] / steep[i], distance[i] / ARCSEC, half[i] / ARCSEC, r, look_of(plane))
        if ring is not None:
            room.fill(*(ring / ARCSEC).T, facecolor=canvas.VERMILLION, alpha=0.25, lw=0)
            room.plot(*(ring / ARCSEC).T, color=canvas.VERMILLION, lw=1.2)
        room.plot(0, 0, marker="o", ms=4, color=canvas.VERMILLION, zorder=6)
        room.set(xlim=(-r, r), ylim=(-r, r), aspect="equal")
        room.set_xlabel(f"towards {names[0]} / arcsec")
        room.set_ylabel(f"towards {names[1]} / arcsec")
        flat = [beam.planes.names[plane] for i, plane in enumerate(known) if not steady[i]]
        _legend(room, beam, [int(plane) for i, plane in enumerate(known) if steady[i]], flat)

    words = [
        f"plane {beam.planes.names[plane]} passes at {significant(abs(distance[i]) / ARCSEC)} arcsec"
        for i, plane in enumerate(known)
        if steady[i]
    ]
    check = " The lines of two planes always intersect: they are no check of each other." if steady.sum() == 2 else ""
    caption = (
        "Condition of each plane for the direction, along the beam, which is in the middle: every direction "
        "on the line of a plane fulfils its condition. Bands: noise of its readings, k = 2; narrower for more inclined "
        "planes."
    )
    return Figure(
        canvas.draw(paint, key, 3.3), caption + check, f"Lines of the planes about the beam: {'; '.join(words)}."
    )


def ellipse(covariance: Array) -> Array | None:
    """Return the outline (n, 2) at twice the standard uncertainty; None where the covariance (2, 2) is not known."""
    if not np.isfinite(covariance).all():
        return None
    values, vectors = np.linalg.eigh(covariance)
    sizes = 2 * np.sqrt(values.clip(0))
    return np.asarray((vectors @ (sizes[:, None] * np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)]))).T)


def angle_between(direction: Array, other: Array) -> float:
    """Return the angle between two unit vectors, rad."""
    return math.atan2(float(np.linalg.norm(np.cross(direction, other))), float(direction @ other))


def round_down(value: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not larger."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))


def round_up(value: float) -> float:
    """Return the smallest 1, 2, 3 or 5 times a power of ten that is not smaller."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(min(step * power for step in (1, 2, 3, 5, 10) if step * power >= value * (1 - 1e-9)))


def number(value: float) -> str:
    """Return a round number without zeros behind its decimal point."""
    return integer(value) if value >= 1 else significant(value, 1)


def times(factor: float) -> str:
    """Return a factor in words."""
    return f"{number(factor)} times"


def look_of(plane: int) -> str:
    """Return the colour of a plane."""
    return _OF_PLANES[plane % len(_OF_PLANES)]


class _Camera:
    """Parallel projection onto the page, from where the beam's length and the disc about its tip are both seen."""

    def __init__(self, nominal: Array, across: Array) -> None:
        best, self._axes = -1.0, np.zeros((2, 3))
        for azimuth in np.deg2rad(np.arange(-75, 285, 15) + 7.0):  # the first of equals is kept: from the front
            for elevation in np.deg2rad([32.0, 20.0, 45.0]):
                c, s = math.cos(elevation), math.sin(elevation)
                toward = np.array([c * math.cos(azimuth), c * math.sin(azimuth), s])
                right = np.cross([0.0, 0.0, 1.0], toward)
                right /= np.linalg.norm(right)
                axes = np.stack([right, np.cross(toward, right)])
                length = float(np.linalg.norm(axes @ nominal))
                open_ = abs(float(np.linalg.det(axes @ across.T)))
                score = min(length, 2 * open_)
                if score > best + 1e-6:
                    best, self._axes = score, axes

    def __call__(self, points: Array) -> Array:
        """Return points (..., 2) on the page of points (..., 3) in space."""
        return np.asarray(points @ self._axes.T)


def _disc(room: Axes, look: _Camera, centre: Array, axes: Array, names: tuple[str, str], r: float) -> None:
    """Draw rings about the nominal tip and lines towards two machine axes."""
    circle = np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)], axis=1) @ axes
    room.fill(*look(centre + r * circle).T, facecolor="#f3f4f6", edgecolor=_LIGHT, lw=0.8)
    room.plot(*look(centre + 0.5 * r * circle).T, color=_LIGHT, lw=0.6)
    for axis, name in zip(axes, names, strict=True):
        room.plot(*look(np.stack([centre - r * axis, centre + 1.1 * r * axis])).T, color=_LIGHT, lw=0.6)
        x, y = look(centre + 1.22 * r * axis)
        room.text(x, y, f"+{name}", color=_GREY, fontsize=7, ha="center", va="center")


def _cone(room: Axes, look: _Camera, outline: Array) -> None:
    """Draw a cone from the zero point to an outline (n, 3)."""
    flat = look(np.concatenate([np.zeros((1, 3)), outline]))
    try:
        hull = flat[ConvexHull(flat).vertices]
    except QhullError:  # seen edge-on it is a line, which the beam covers
        return
    room.fill(*hull.T, facecolor=canvas.VERMILLION, alpha=0.16, lw=0)
    room.fill(*look(outline).T, facecolor=canvas.VERMILLION, alpha=0.3, edgecolor=canvas.VERMILLION, lw=0.8)


def _triad(figure: Canvas, look: _Camera) -> None:
    """Draw the machine's axes in a corner."""
    corner = figure.add_axes((0.01, 0.02, 0.12, 0.25))
    for axis, name in zip(np.eye(3), "XYZ", strict=True):
        x, y = look(axis)
        corner.annotate(
            "", (x, y), (0, 0), arrowprops={"arrowstyle": "-|>", "color": _GREY, "lw": 0.8, "shrinkA": 0, "shrinkB": 0}
        )
        size = math.hypot(x, y)
        if size > 0.1:
            corner.text(x * (1 + 0.25 / size), y * (1 + 0.25 / size), name, color=_GREY, ha="center", va="center")
    corner.set(xlim=(-1.4, 1.4), ylim=(-1.4, 1.4), aspect="equal")
    corner.axis("off")


def _key(figure: Canvas, beam: Found, uncompensated: bool) -> None:
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
        look: dict[str, Any] = {"color": canvas.BLUE, "lw": 1.1, "dashes": (2, 1.5), "marker": "o", "ms": 3}
        handles.append(Line2D([], [], label="without compensation", **look))
    figure.legend(handles=handles, loc="upper left", bbox_to_anchor=(0.0, 1.01), ncols=3)


def _line(room: Axes, normal: Array, distance: float, half: float, reach: float, colour: str) -> None:
    """Draw the line of one plane and its band."""
    along = np.array([-normal[1], normal[0]])
    ends = np.outer([-3 * reach, 3 * reach], along) + distance * normal
    if math.isfinite(half):
        band = np.concatenate([ends - half * normal, (ends + half * normal)[::-1]])
        room.fill(*band.T, facecolor=colour, alpha=0.12, lw=0)
    room.plot(*ends.T, color=colour, lw=1.1)


def _legend(room: Axes, beam: Found, planes: list[int], flat: list[str]) -> None:
    """Name the planes, the ellipse, and the deviations of nominal and of the uncompensated beam."""
    degrees = np.rad2deg(np.stack([beam.planes.inclination, beam.planes.rotation]))
    handles: list[Line2D | Patch] = []
    for plane in planes:
        tilt = f": inclination {fixed(degrees[0, plane], 1)}°, rotation {fixed(degrees[1, plane], 0)}°"
        label = f"plane {beam.planes.names[plane]}{tilt if np.isfinite(degrees[:, plane]).all() else ''}"
        handles.append(Line2D([], [], color=look_of(plane), lw=1.1, label=label))
    handles.append(
        Patch(facecolor=canvas.VERMILLION, alpha=0.4, label="direction of the beam, all sources of uncertainty, k = 2")
    )
    room.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.05, 1.02))
    words = []
    axes_across, names = across(beam.direction)
    for what, direction in (("nominal", beam.nominal), ("without compensation", beam.uncompensated)):
        if np.isfinite(direction).all() and (what == "nominal" or beam.compensated):
            x, y = axes_across @ (direction / (direction @ beam.direction)) / ARCSEC
            words.append(
                f"{what}: {fixed(x, 0, signed=True)} arcsec towards {names[0]}, "
                f"{fixed(y, 0, signed=True)} towards {names[1]}"
            )
    if flat:
        words.append(f"not drawn, perpendicular to the beam: plane {', '.join(flat)}")
    room.text(1.07, 0.02, "\n".join(words), transform=room.transAxes, color=_GREY, va="bottom", linespacing=1.5)
