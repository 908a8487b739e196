"""A spatial drawing that can be rotated: by the script of the page, or without it by selecting one of several views.

The views are selected with radio buttons, so that arrow keys rotate the drawing. The selected view is printed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from errormotion.arrays import Array

WIDE, HIGH = 497.0, 320.0  # points
_MARGIN = 22.0
_TURNS = 12
_ELEVATION = np.radians(24.0)
_FIXED = ((0.0, np.pi / 2, "from above"), (0.0, 0.0, "along Y"), (np.pi / 2, 0.0, "along X"))
TURN = " It can be rotated by dragging, with the arrow keys, or with the buttons."
"""End of the caption of a drawing."""
_INK = "#222222"
_LETTER, _LINE = 5.2, 9.5  # width of a letter and height of a line of the names, points

_Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class Lines:
    """Line segments (k, 2, 3), m, of one colour; ``head`` is the length of arrow heads in points."""

    ends: Array
    colour: str
    width: float = 0.8
    head: float = 0.0
    dash: str = ""


@dataclass(frozen=True)
class Dots:
    """Points (k, 3), m, with optional names, and notes that the page shows under the pointer."""

    places: Array
    colour: str
    radius: float = 1.4
    names: Sequence[str] = ()
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Ellipsoids:
    """Ellipsoids at (k, 3), m; their squared semi-axes are the eigenvalues of (k, 3, 3), m^2."""

    places: Array
    shapes: Array
    colour: str


@dataclass(frozen=True)
class Scene:
    """Elements of the drawing; later ones are drawn on top."""

    parts: list[Lines | Dots | Ellipsoids] = field(default_factory=list)

    def points(self) -> Array:
        """Return all points that must be visible, (k, 3)."""
        found = []
        for part in self.parts:
            if isinstance(part, Lines):
                found.append(part.ends.reshape(-1, 3))
            elif isinstance(part, Dots):
                found.append(part.places)
            else:
                reach = np.sqrt(np.diagonal(part.shapes, axis1=1, axis2=2))
                found += [part.places - reach, part.places + reach]
        return np.concatenate(found)


def enlargement(longest: float, wanted: float) -> int:
    """Return the largest magnification (1, 2, 5 times a power of ten) that draws a length within ``wanted``."""
    if not (math.isfinite(longest) and longest > 0 and math.isfinite(wanted) and wanted > longest):
        return 1
    power = 10 ** math.floor(math.log10(wanted / longest))
    return int(max(step * power for step in (1, 2, 5) if step * power <= wanted / longest))


def camera(azimuth: float, elevation: float) -> Array:
    """Return the unit vectors to the right, upwards and towards the viewer, (3, 3)."""
    a, e = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]), elevation
    away = np.array([-a[1], a[0], 0.0])
    up = np.array([0.0, 0.0, np.cos(e)]) + away * np.sin(e)
    return np.stack([a, up, np.cross(a, up)])


def draw(scene: Scene, key: str) -> Markup:
    """Return the drawing as HTML; ``key`` makes its identifiers unique."""
    views = [(2 * np.pi * k / _TURNS + np.radians(30.0), _ELEVATION, "") for k in range(_TURNS)]
    views += list(_FIXED)
    points = scene.points()
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    turned = [(points - centre) @ camera(azimuth, elevation).T for azimuth, elevation, _ in views]
    across = max(np.abs(p[:, 0]).max() for p in turned)
    above = max(np.abs(p[:, 1]).max() for p in turned)
    scale = min((WIDE / 2 - _MARGIN) / max(across, 1e-12), (HIGH / 2 - _MARGIN) / max(above, 1e-12))
    buttons, pictures, rules = [], [], []
    for k, (azimuth, elevation, name) in enumerate(views):
        label = f"<label for='{key}-v{k}'>{name}</label> " if name else ""
        title = name or f"rotated by {30 * k}°"
        checked = " checked" if k == 0 else ""
        buttons.append(f"<input type='radio' name='{key}' id='{key}-v{k}' aria-label=\"{title}\"{checked}>{label}")
        pictures.append(_picture(scene, camera(azimuth, elevation), centre, scale, f"{key}-p{k}"))
        rules.append(f"#{key}-v{k}:checked~#{key}-p{k}")
    style = (
        f"#{key}-t svg{{display:none}}{','.join(rules)}{{display:block!important}}"
        f"#{key}-t{{font-size:8pt;color:#555}}#{key}-t input{{margin:0 1px;vertical-align:middle}}"
        f"#{key}-t label{{margin-right:6px}}@media print{{#{key}-t :is(input,label,span){{display:none}}}}"
    )
    points_of = escape(json.dumps(_plain(scene, centre, points), ensure_ascii=False, separators=(",", ":")))
    return Markup(
        f"<div id='{key}-t' class='turn' data-scene=\"{points_of}\"><style>{style}</style><span>rotate:</span> "
        f"{''.join(buttons)}{''.join(pictures)}</div>"
    )


def _plain(scene: Scene, centre: Array, points: Array) -> dict[str, Any]:
    """Return the scene for the script of the page, with positions to a millionth of its size."""
    radius = float(np.linalg.norm(points - centre, axis=1).max()) or 1.0
    decimals = 6 - math.floor(math.log10(radius))

    def of(part: Lines | Dots | Ellipsoids) -> dict[str, Any]:
        if isinstance(part, Lines):
            look = {"width": part.width, "head": part.head, "dash": part.dash}
            return {"kind": "lines", "colour": part.colour, **look, "ends": part.ends.round(decimals).tolist()}
        if isinstance(part, Dots):
            texts = {"names": [str(name) for name in part.names], "notes": [str(note) for note in part.notes]}
            shape = {"places": part.places.round(decimals).tolist(), "radius": part.radius}
            return {"kind": "dots", "colour": part.colour, **shape, **{k: v for k, v in texts.items() if v}}
        shapes = [[float(f"{each:.4g}") for each in shape.ravel()] for shape in part.shapes]
        matrices = np.array(shapes).reshape(-1, 3, 3).tolist()
        places = part.places.round(decimals).tolist()
        return {"kind": "ellipsoids", "colour": part.colour, "places": places, "shapes": matrices}

    parts = [of(part) for part in scene.parts]
    return {"centre": centre.round(decimals).tolist(), "radius": float(f"{radius:.6g}"), "parts": parts}


def _picture(scene: Scene, R: Array, centre: Array, scale: float, name: str) -> str:
    drawn, taken = [_triad(R)], list[_Box]()

    def flat(places: Array) -> Array:
        seen = (places - centre) @ R[:2].T * scale
        return np.asarray(seen * (1, -1) + (WIDE / 2, HIGH / 2))

    for part in scene.parts:
        if isinstance(part, Dots) and part.names:
            taken += [_around(float(x), float(y), part.radius) for x, y in flat(part.places)]
    for part in scene.parts:
        if isinstance(part, Lines):
            drawn.append(_lines(part, flat(part.ends)))
        elif isinstance(part, Dots):
            drawn.append(_dots(part, flat(part.places), taken))
        else:
            drawn.append(_ellipses(part, flat(part.places), R, scale))
    return f"<svg id='{name}' viewBox='0 0 {WIDE:g} {HIGH:g}' aria-hidden='true'>{''.join(drawn)}</svg>"


def _lines(part: Lines, ends: Array) -> str:
    path = "".join(f"M{a[0]:.1f} {a[1]:.1f}L{b[0]:.1f} {b[1]:.1f}" for a, b in ends)
    if part.head:
        way = ends[:, 1] - ends[:, 0]
        size = np.linalg.norm(way, axis=1)
        for (_, tip), step, length in zip(ends, way, size, strict=True):
            if length < 1.0:  # parallel to the line of sight: no head
                continue
            u = step / length
            back, side = tip - part.head * u, 0.38 * part.head * np.array([-u[1], u[0]])
            left, right = back + side, back - side
            path += f"M{left[0]:.1f} {left[1]:.1f}L{tip[0]:.1f} {tip[1]:.1f}L{right[0]:.1f} {right[1]:.1f}"
    dash = f" stroke-dasharray='{part.dash}'" if part.dash else ""
    return f"<path d='{path}' fill='none' stroke='{part.colour}' stroke-width='{part.width:g}'{dash}/>"


def _dots(part: Dots, places: Array, taken: list[_Box]) -> str:
    """Draw points; names are placed without overlap of the boxes ``taken``, if possible."""
    r = part.radius
    path = "".join(f"M{x - r:.1f} {y:.1f}a{r} {r} 0 1 0 {2 * r} 0a{r} {r} 0 1 0 {-2 * r} 0" for x, y in places)
    names = ""
    for (x, y), name in zip(places, part.names, strict=False):
        box = _free(float(x), float(y), r, _LETTER * len(name), taken)
        taken.append(box)
        start = f"x='{box[0]:.1f}'" if box[0] > x else f"x='{box[2]:.1f}' text-anchor='end'"
        names += (
            f"<text {start} y='{box[3] - 2:.1f}' font-size='8.5' font-weight='bold' fill='{part.colour}'>"
            f"{escape(name)}</text>"
        )
    return f"<path d='{path}' fill='{part.colour}'/>{names}"


def _around(x: float, y: float, r: float) -> _Box:
    return x - r, y - r, x + r, y + r


def _free(x: float, y: float, r: float, width: float, taken: Sequence[_Box]) -> _Box:
    """Return the box of a name of this width next to a point: left, top, right and bottom."""
    candidates = [
        (left, y + down, left + width, y + down + _LINE)
        for down in (-r - _LINE, r, -_LINE / 2, -r - 2 * _LINE, r + _LINE)
        for left in (x + r + 3, x - r - 3 - width)
    ]
    for box in candidates:
        inside = box[0] > 0 and box[1] > 0 and box[2] < WIDE and box[3] < HIGH
        if inside and not any(
            box[0] < other[2] and other[0] < box[2] and box[1] < other[3] and other[1] < box[3] for other in taken
        ):
            return box
    return candidates[0]


def _ellipses(part: Ellipsoids, places: Array, R: Array, scale: float) -> str:
    """Draw the outlines of ellipsoids in parallel projection, which are ellipses."""
    found = []
    for (x, y), shape in zip(places, part.shapes, strict=True):
        values, vectors = np.linalg.eigh(R[:2] @ shape @ R[:2].T)
        b, a = scale * np.sqrt(values.clip(0))
        turn = -np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
        found.append(f"<ellipse rx='{a:.2f}' ry='{b:.2f}' transform='translate({x:.1f} {y:.1f}) rotate({turn:.1f})'/>")
    return f"<g fill='{part.colour}' fill-opacity='.25' stroke='{part.colour}' stroke-width='.6'>{''.join(found)}</g>"


def _triad(R: Array) -> str:
    """Draw the directions of the machine axes in the corner."""
    x, y, drawn = 30.0, HIGH - 30.0, []
    for k, name in enumerate("XYZ"):
        dx, dy = 20 * R[0, k], -20 * R[1, k]
        if np.hypot(dx, dy) < 3:
            continue
        drawn.append(
            f"<path d='M{x} {y}l{dx:.1f} {dy:.1f}' stroke='{_INK}' stroke-width='.8'/>"
            f"<text x='{x + 1.35 * dx:.1f}' y='{y + 1.35 * dy + 3:.1f}' font-size='8' text-anchor='middle' "
            f"fill='{_INK}'>{name}</text>"
        )
    return "".join(drawn)
