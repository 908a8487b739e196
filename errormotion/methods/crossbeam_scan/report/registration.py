"""Figure of one registration: the cold surface, and warm minus cold before and after."""

from __future__ import annotations

import math

import matplotlib
import numpy as np
from matplotlib.figure import Figure as Canvas

from errormotion.arrays import Array
from errormotion.methods.crossbeam_scan.report.view import Campaign, after, at_y, campaign
from errormotion.report import canvas
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import Block, Figure, Source, Text
from errormotion.report.drawings import maps as crossbeam_maps
from errormotion.report.fields import field
from errormotion.report.text import finite, fixed, integer, significant

_WRONG = 10  # assumed error of a pose in standard uncertainties, to show its effect on the residual
_MAPS = ("difference_before", "difference_after")
_FINEST = 48  # cells a side


def blocks(source: Source, key: str) -> list[Block]:
    """Return figure and text of the last registration of the artefact with the largest error."""
    seen = campaign(source.errors)
    shown = seen.shown()
    if shown is None:
        return [Text("No scan could be registered.", "warning")]
    figure = _figure(seen, *shown, key) or Text("The result does not contain maps of the surfaces.", "note")
    return [figure, *_residual(seen, *shown)]


def _residual(seen: Campaign, cycle: int, artefact: int) -> list[Block]:
    rms = seen.get("residual_rms")[cycle, artefact]
    if not math.isfinite(rms):
        return []
    words = f"Residual of this registration: {_length(rms)} (root mean square)"
    points = seen.get("points_used")[cycle, artefact]
    if points > 0:
        words += f" over {integer(points)} points of the warm scan"
    noise = seen.get("noise_found")[cycle, artefact]
    if math.isfinite(noise):
        words += f"; noise of a point {_length(noise)}"
    turned = _wrong_pose(seen, cycle, artefact)
    words += ". The residual shows noise and jitter of two scans; it is not a measure of the accuracy of the pose"
    if turned is not None:
        name, sigma, added = turned
        words += (
            f": the standard uncertainty of the rotation {name} of the registration is {significant(1e6 * sigma)} "
            f"µrad, and an error of the pose of {_WRONG} times this value would change the residual from "
            f"{_length(rms, 4)} to {_length(math.hypot(rms, added), 4)}"
        )
    return [Text(f"{words}. The accuracy of a registration is stated by its covariance.")]


def _wrong_pose(seen: Campaign, cycle: int, artefact: int) -> tuple[str, float, float] | None:
    """Return the best known rotation (ISO name), its uncertainty from the registration, and the effect of its error.

    The effect is the root mean square, m, that an error of the pose of `_WRONG` times the uncertainty adds to the
    residual: the rotation R about the middle of the artefact moves a point P by R x P, which appears along z as
    n . (R x P) with n = (-dS/dx, -dS/dy, 1).
    """
    sigma = seen.get("registration_u", "dof")[cycle, artefact, 3:]
    if not np.isfinite(sigma).any():
        sigma = seen.get("predicted_u", "dof")[cycle, artefact, 3:]
    grid = _surface(seen, artefact)
    if grid is None or not np.isfinite(sigma).any():
        return None
    x, y, z = grid
    if min(z.shape) < 3:
        return None
    down, across = np.gradient(z, y, x)
    normal = np.stack([-across, -down, np.ones_like(z)], axis=-1)
    middle = [finite(np.mean, part) for part in (x, y, z)]
    point = np.stack([*np.broadcast_arrays(x[None, :] - middle[0], y[:, None] - middle[1]), z - middle[2]], axis=-1)
    best = int(np.nanargmin(sigma))
    turn = np.zeros(3)
    turn[best] = _WRONG * sigma[best]
    shift = (normal * np.cross(turn, point)).sum(axis=-1)
    added = math.sqrt(finite(np.mean, shift**2))
    return (seen.names[FREEDOMS[3 + best]], float(sigma[best]), added) if math.isfinite(added) else None


def _length(metres: float, digits: int = 3) -> str:
    return f"{significant(1e6 * metres, digits)} µm" if metres >= 0.1e-6 else f"{significant(1e9 * metres, digits)} nm"


def _surface(seen: Campaign, artefact: int) -> tuple[Array, Array, Array] | None:
    """Return (x (u,), y (v,), z (v, u)) of a cold surface in m; None where the dataset does not contain it."""
    errors = seen.errors
    if any(name not in errors for name in ("surface", "surface_x", "surface_y")):
        return None
    z = field(errors, "surface", "position", "v", "u")[artefact]
    x, y = (_along(seen, name, artefact) for name in ("surface_x", "surface_y"))
    return (x, y, z) if np.isfinite(z).any() and x.size == z.shape[1] and y.size == z.shape[0] else None


def _along(seen: Campaign, name: str, artefact: int) -> Array:
    """Return the coordinates of the maps, which may differ by artefact."""
    found = seen.errors[name]
    return np.asarray((found.isel(position=artefact) if "position" in found.dims else found).values, float)


def _figure(seen: Campaign, cycle: int, artefact: int, key: str) -> Figure | None:
    grid = _surface(seen, artefact)
    if grid is None:
        return None
    x, y, z = grid
    every = max(1, -(-max(z.shape) // _FINEST))
    maps = [("Cold surface", "mm", 1e3 * z, False)]
    for name, title in zip(_MAPS, ("Warm − cold", "After registration"), strict=True):
        values = seen.get(name, "v", "u")[cycle, artefact] if name in seen.errors else np.full(1, np.nan)
        if np.isfinite(values).any():
            maps.append((title, "µm", 1e6 * values, True))
    wide, gap, bar = 1.36, 0.33, 0.5  # inch
    tall = min(max(wide * np.ptp(y) / max(np.ptp(x), 1e-9), 0.8), 3.2)
    high = canvas.TOP + 0.12 + tall + canvas.BOTTOM
    left = canvas.LEFT

    def paint(figure: Canvas) -> None:
        for k, (title, unit, values, centred) in enumerate(maps):
            start = left + k * (wide + gap + bar)
            axes = figure.add_axes((start / canvas.WIDTH, canvas.BOTTOM / high, wide / canvas.WIDTH, tall / high))
            colours = crossbeam_maps.DIVERGING if centred else matplotlib.colormaps["cividis"]
            scale = crossbeam_maps.scale_of(values, 18, colours)
            part = slice(None, None, every)
            crossbeam_maps.cells(axes, 1e3 * x[part], 1e3 * y[part], values[part, part], scale)
            axes.set_title(title, pad=14)
            axes.set_xlabel("x / mm")
            if k == 0:
                axes.set_ylabel("y / mm (along the feed)")
            axes.grid(visible=False)
            box = ((start + wide + 0.07) / canvas.WIDTH, canvas.BOTTOM / high, 0.09 / canvas.WIDTH, tall / high)
            crossbeam_maps.colour_bar(axes, scale, box, unit)

    where = f"the artefact at {at_y(seen.position[artefact])}, {after(seen.time[cycle])}"
    sizes = "; ".join(
        f"{title.lower()} {fixed(finite(np.min, values), 2)} to {fixed(finite(np.max, values), 2)} {unit}"
        for title, unit, values, _ in maps
    )
    caption = (
        f"One registration: {where}, the last of the artefact with the largest error. From left to right: the cold "
        "surface, warm minus cold along z before registration, and after it; each with a separate scale. Empty cells "
        "contain no point."
    )
    return Figure(canvas.draw(paint, key, high), caption, f"Maps of {where}: {sizes}.")
