"""Maps of the inclination error of the sensor over inclination, rotation and depth, with the calibrated tilts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure as Canvas
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.datasets.calibrations.inclination import InclinationCalibration
from errormotion.errors import DatasetError
from errormotion.kinematics.beams import tilt_vector
from errormotion.methods.beam_direction.report.view import BeamView, Planes
from errormotion.report import canvas
from errormotion.report.document import Block, Figure, Source, Text
from errormotion.report.drawings import maps as map_drawings
from errormotion.report.text import finite, fixed, integer, listed, significant

_HATCH = "#9a9a9a"
_SECTION_WIDTH = np.deg2rad(10.0)  # angle of settings and planes to a section in which they are shown
_STEPS = 81
_SAME_SLOPE = 1e-6  # difference of the slopes of one calibration: 10 nm at 10 mm
_DEPTHS = 9  # dots over the depth, at each inclination
_SECTIONS = (0.0, np.pi / 2)


@dataclass(frozen=True)
class _Tilts:
    """Calibrated settings.

    Attributes
    ----------
    inclination, rotation, slope : (setting,)
        rad, rad, 1.
    left_out : (setting,) of bool
    group : (group,) of int
        Setting of each group of readings.
    depth, error : (group,)
        Depth from mid-range and error there, m.
    group_left_out : (group,) of bool
    """

    inclination: Array
    rotation: Array
    slope: Array
    left_out: NDArray[np.bool_]
    group: NDArray[np.intp]
    depth: Array
    error: Array
    group_left_out: NDArray[np.bool_]


def calibration_of(source: Source, planes: Planes) -> tuple[InclinationCalibration | None, str]:
    """Return the calibration that was used for the compensation, or None and the reason.

    It is searched by its name, as in the identification, and in the campaign's folder; its content must be that used.
    """
    name = source.settings.get("compensation")
    if not name:
        return None, "the readings were evaluated without an inclination calibration"
    campaign = source.run.get("campaign")
    folder = campaign.get("folder") if isinstance(campaign, Mapping) else None
    try:
        calibration = InclinationCalibration.find(str(name), folder)
    except DatasetError as error:
        return None, f"the calibration '{name}' cannot be shown: {error}"
    if not _agrees(calibration, planes):
        return None, f"the content of the calibration '{name}' is not that used for the correction"
    return calibration, ""


def _agrees(calibration: InclinationCalibration, planes: Planes) -> bool:
    """Return whether the correction at each plane is that of the calibration."""
    k = calibration.slope(tilt_vector(planes.inclination, planes.rotation))[0]
    for correction, raw, slope in zip(planes.compensation, planes.raw, k, strict=True):
        known = np.isfinite(correction) & np.isfinite(raw)
        if not np.isfinite(slope) or known.sum() < 2 or np.ptp(raw[known]) == 0:
            continue
        by_reading = float(np.polyfit(raw[known], correction[known], 1)[0])
        if abs(by_reading - slope / (1 + slope)) > _SAME_SLOPE:
            return False
    return True


def blocks(beam: BeamView, calibration: InclinationCalibration | None, reason: str, key: str) -> list[Block]:
    """Return the section on the calibration; ``reason`` states why it is None."""
    if calibration is None:
        return [Text(f"No map: {reason.rstrip('.')}.", "note")]
    summary = Text(_description(calibration))
    return [summary, *_extrapolated(beam.planes, calibration), maps(beam.planes, calibration, key)]


def _extrapolated(planes: Planes, calibration: InclinationCalibration) -> list[Block]:
    """Return a warning with the planes that the calibration does not cover."""
    known = np.isfinite(planes.inclination) & np.isfinite(planes.rotation)
    outside = known & ~calibration.supported(tilt_vector(planes.inclination, planes.rotation))
    if not outside.any():
        return []
    names = listed([planes.names[k] for k in np.flatnonzero(outside)])
    of = f"tilts of planes {names} to the beam are" if outside.sum() > 1 else f"tilt of plane {names} to the beam is"
    text = f"The {of} outside the settings of the calibration: the correction is extrapolated."
    return [Text(text, "warning")]


def _description(calibration: InclinationCalibration) -> str:
    """Return a description of the calibration and its remaining error."""
    ds = calibration.dataset
    low, high = (float(ds[name]) - calibration.mid_range for name in ("reading_low", "reading_high"))
    n, out = ds.sizes["setting"], int((ds["setting_left_out"].values > 0).sum())
    left = f", {integer(out)} of them left out" if out else ""
    farthest = max(abs(low), abs(high))
    remaining = float(ds["remaining_error"])
    interval = ds["remaining_error_interval"].values
    return (
        f"Calibration '{calibration.name}': slope k of the error with depth at {integer(n)} tilts{left}, fitted by a "
        f"polynomial of order {calibration.order}, depths {fixed(1e3 * low, 1)} to {fixed(1e3 * high, 1)} mm from "
        f"mid-range. Remaining error of k at tilts that were left out of the fit: {significant(1e3 * remaining)} µm "
        f"per mm (95 %: {significant(1e3 * interval[0])} to {significant(1e3 * interval[1])}), which is "
        f"{significant(1e6 * remaining * farthest)} µm at {fixed(1e3 * farthest, 1)} mm."
    )


def maps(planes: Planes, calibration: InclinationCalibration, key: str) -> Figure:
    """Return the maps of the slope over inclination and rotation, and of the error in two sections."""
    tilts = _tilts(calibration)
    steepest = max(finite(np.max, np.abs(tilts.inclination)), np.nan_to_num(finite(np.max, planes.inclination)))
    reach = min(steepest * 1.08 + np.deg2rad(1.0), np.deg2rad(80.0))
    ds = calibration.dataset
    depth = np.linspace(float(ds["reading_low"]), float(ds["reading_high"]), _STEPS) - calibration.mid_range
    across = np.linspace(-reach, reach, _STEPS)
    sections = [_section(calibration, across, depth, rotation) for rotation in _SECTIONS]
    disc = _disc(calibration, across)
    slope_scale = map_drawings.scale_of(1e3 * np.concatenate([disc.ravel(), tilts.slope[~tilts.left_out]]), 20)
    error_scale = map_drawings.scale_of(1e6 * np.ravel(sections), 20)

    def paint(figure: Canvas) -> None:
        wide, high = figure.get_figwidth(), figure.get_figheight()

        def area(left: float, bottom: float, width: float, height: float) -> tuple[float, float, float, float]:
            return left / wide, bottom / high, width / wide, height / high

        axes = figure.add_axes(area(0.5, 0.9, 2.75, 2.75))
        _draw_disc(axes, disc, across, slope_scale, tilts, planes)
        _bar(figure, slope_scale, area(0.5, 0.3, 2.75, 0.08), "slope k / µm per mm")
        for i, (rotation, error) in enumerate(zip(_SECTIONS, sections, strict=True)):
            axes = figure.add_axes(area(3.85, 0.9 + (1 - i) * 1.55, 2.9, 1.2))
            _draw_section(axes, error, across, depth, error_scale, rotation, tilts, planes, calibration.mid_range)
            if i == 0:
                axes.tick_params(labelbottom=False)
            else:
                axes.set_xlabel("inclination / °")
        _bar(figure, error_scale, area(3.85, 0.3, 2.9, 0.08), "error / µm")

    caption = (
        "Inclination error of the sensor, error = depth times k. Left: k over inclination (from the middle) and "
        "rotation; right: the error over depth in two sections, with negative inclinations at the opposite rotation. "
        "Dots: calibrated settings, in the colour of their value; crosses: left out of the calibration. Numbers: the "
        "planes of this measurement; in the sections those within 10°, with their depths. Hatched: not covered by the "
        "calibration."
    )
    known = [k for k in range(len(planes)) if np.isfinite([planes.inclination[k], planes.rotation[k]]).all()]
    q = tilt_vector(planes.inclination[known], planes.rotation[known])
    at_planes = "; ".join(
        f"plane {planes.names[k]} {fixed(1e3 * value, 2, signed=True)}" + ("" if supported else " (not covered)")
        for k, value, supported in zip(known, calibration.slope(q)[0], calibration.supported(q), strict=True)
    )
    low, high = finite(np.min, 1e3 * disc), finite(np.max, 1e3 * disc)
    alt = (
        f"Maps of the inclination error: k from {fixed(low, 2, signed=True)} to {fixed(high, 2, signed=True)} µm per mm"
        + (f"; at the planes: {at_planes}" if at_planes else "")
        + "."
    )
    return Figure(canvas.draw(paint, key, 3.95), caption, alt)


def _tilts(calibration: InclinationCalibration) -> _Tilts:
    ds = calibration.dataset
    slope = np.asarray(ds["slope"].values, float)
    group, depth = np.asarray(ds["group_setting"].values, dtype=int), np.asarray(ds["group_depth"].values, float)
    return _Tilts(
        np.asarray(ds["inclination"].values, float),
        np.asarray(ds["rotation"].values, float),
        slope,
        np.asarray(ds["setting_left_out"].values > 0),
        group,
        depth,
        depth * slope[group] + np.asarray(ds["group_residual"].values, float),
        np.asarray(ds["group_left_out"].values > 0),
    )


def _disc(calibration: InclinationCalibration, across: Array) -> Array:
    """Return k over the inclinations towards rotation 0 and 90 deg; NaN where it is not covered."""
    x, y = np.meshgrid(across, across)
    alpha = np.hypot(x, y)
    q = tilt_vector(np.minimum(alpha, 1.5), np.arctan2(y, x))
    inside = (alpha <= across[-1]) & calibration.supported(q)
    return np.where(inside, calibration.slope(q)[0], np.nan)


def _section(calibration: InclinationCalibration, across: Array, depth: Array, rotation: float) -> Array:
    """Return the error (depth, inclination) at one rotation, m; NaN where it is not covered."""
    q = tilt_vector(across, rotation)
    k = np.where(calibration.supported(q), calibration.slope(q)[0], np.nan)
    return np.asarray(depth[:, None] * k)


def _hatch(axes: Axes, x: Array, y: Array, where: NDArray[np.bool_]) -> None:
    """Draw diagonal lines over the part of a grid in which ``where`` is true."""
    wide, high = np.ptp(x), np.ptp(y)
    box = axes.get_position()
    figure = axes.figure
    shape = box.width * figure.get_figwidth() / (box.height * figure.get_figheight())  # type: ignore[union-attr]
    share = np.linspace(0, 1, 4 * x.size)
    lines = []
    for start in np.arange(-1.0, shape, 0.045):
        # In units of the panel's height: up and to the right at 45 degrees.
        across, up = (start + share) / shape, share
        inside = (across >= 0) & (across <= 1)
        column = np.rint(across[inside] * (x.size - 1)).astype(int)
        row = np.rint(up[inside] * (y.size - 1)).astype(int)
        points = np.stack([x[0] + wide * across[inside], y[0] + high * up[inside]], axis=1)
        hatched = np.concatenate([[False], where[row, column], [False]])
        for first, last in np.flatnonzero(hatched[1:] != hatched[:-1]).reshape(-1, 2):
            lines.append(points[[first, last - 1]])
    axes.add_collection(LineCollection(lines, colors=_HATCH, linewidths=0.5, zorder=2))


def _draw_disc(axes: Axes, disc: Array, across: Array, scale: ScalarMappable, tilts: _Tilts, planes: Planes) -> None:
    degrees = np.rad2deg(across)
    map_drawings.cells(axes, degrees, degrees, 1e3 * disc, scale)
    outside = np.hypot(*np.meshgrid(degrees, degrees)) > degrees[-1]
    _hatch(axes, degrees, degrees, np.isnan(disc) & ~outside)
    circle = np.linspace(0, 2 * np.pi, 121)
    for ring in _rings(degrees[-1]):
        axes.plot(ring * np.cos(circle), ring * np.sin(circle), color="#777777", lw=0.4)
        axes.text(-ring * 0.707, -ring * 0.707, f"{ring:g}°", fontsize=6.5, color="#444444", ha="center", va="center")
    for angle in range(0, 360, 45):
        c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
        axes.plot([0, degrees[-1] * c], [0, degrees[-1] * s], color="#777777", lw=0.3)
        axes.text(1.09 * degrees[-1] * c, 1.07 * degrees[-1] * s, f"{angle}°", fontsize=7, ha="center", va="center")
    x, y = (np.rad2deg(tilts.inclination) * turn(tilts.rotation) for turn in (np.cos, np.sin))
    used = ~tilts.left_out
    axes.scatter(
        x[used], y[used], c=scale.to_rgba(1e3 * tilts.slope[used]), s=7, edgecolors="#333333", linewidths=0.3, zorder=4
    )
    axes.plot(x[~used], y[~used], "x", color="#222222", ms=4, mew=0.8, zorder=4)
    for k in range(len(planes)):
        x0, y0 = (np.rad2deg(planes.inclination[k]) * turn(planes.rotation[k]) for turn in (np.cos, np.sin))
        if np.isfinite([x0, y0]).all():
            _mark(axes, float(x0), float(y0), planes.names[k])
    axes.set(xlim=(-1.2 * degrees[-1], 1.2 * degrees[-1]), ylim=(-1.2 * degrees[-1], 1.2 * degrees[-1]), aspect="equal")
    axes.axis("off")


def _mark(axes: Axes, x: float, y: float, name: str) -> None:
    axes.text(
        x,
        y,
        name,
        fontsize=7,
        fontweight="bold",
        ha="center",
        va="center",
        zorder=6,
        bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "#222222", "linewidth": 0.7},
    )


def _rings(reach: float) -> list[float]:
    step = 15.0 if reach > 25 else 5.0
    return [float(ring) for ring in np.arange(step, reach, step)]


def _draw_section(
    axes: Axes,
    error: Array,
    across: Array,
    depth: Array,
    scale: ScalarMappable,
    rotation: float,
    tilts: _Tilts,
    planes: Planes,
    mid_range: float,
) -> None:
    degrees, millimetres = np.rad2deg(across), 1e3 * depth
    map_drawings.cells(axes, degrees, millimetres, 1e6 * error, scale)
    _hatch(axes, degrees, millimetres, np.isnan(error))
    axes.grid(visible=False)
    x, y, values, out = _readings_on(tilts, rotation)
    colours = scale.to_rgba(1e6 * values[~out])
    axes.scatter(np.rad2deg(x[~out]), 1e3 * y[~out], c=colours, s=5, edgecolors="#333333", linewidths=0.25, zorder=4)
    axes.plot(np.rad2deg(x[out]), 1e3 * y[out], "x", color="#222222", ms=3.5, mew=0.7, zorder=4)
    signed, near = _in_section(planes.inclination, planes.rotation, rotation)
    for k in np.flatnonzero(near):
        used = 1e3 * (planes.raw[k] - mid_range)
        low, high = finite(np.min, used), finite(np.max, used)
        axes.plot([np.rad2deg(signed[k])] * 2, [low, high], color="#222222", lw=1.2, zorder=5)
        _mark(axes, float(np.rad2deg(signed[k])), float(np.nan_to_num((low + high) / 2)), planes.names[k])
    axes.set_ylabel("depth / mm")
    right, left = (fixed(np.rad2deg(rotation) + turn, 0) for turn in (0, 180))
    axes.set_title(f"rotation {right}°, and {left}° left of 0")


def _readings_on(tilts: _Tilts, rotation: float) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Return signed inclination, depth, error and whether it was left out, for some readings near a section.

    Of the settings at one inclination, the nearest to the section is used, and of its readings a few over the depth.
    """
    signed, near = _in_section(tilts.inclination, tilts.rotation, rotation)
    distance = np.abs(np.sin(tilts.rotation - rotation) * tilts.inclination)
    chosen: dict[int, int] = {}
    for k in (int(k) for k in np.flatnonzero(near & ~tilts.left_out)):
        degrees = round(float(np.rad2deg(signed[k])))
        if degrees not in chosen or distance[k] < distance[chosen[degrees]]:
            chosen[degrees] = k
    parts = [np.zeros(0, dtype=int)]
    for k in chosen.values():
        groups = np.flatnonzero(tilts.group == k)
        groups = groups[np.argsort(tilts.depth[groups])]
        parts.append(groups[np.unique(np.linspace(0, groups.size - 1, _DEPTHS).astype(int))] if groups.size else groups)
    some = np.concatenate(parts)
    return signed[tilts.group[some]], tilts.depth[some], tilts.error[some], tilts.group_left_out[some]


def _bar(figure: Canvas, scale: ScalarMappable, area: tuple[float, float, float, float], label: str) -> None:
    """Draw a horizontal colour bar with its label below."""
    bar = figure.colorbar(scale, cax=figure.add_axes(area), orientation="horizontal", spacing="proportional")
    bar.outline.set_linewidth(0.4)
    bounds = np.asarray(scale.norm.boundaries)  # type: ignore[attr-defined]
    zero = int(np.argmin(np.abs(bounds)))
    every = max(1, int(np.ceil((bounds.size - 1) / 7)))
    bar.set_ticks([float(bounds[i]) for i in range(bounds.size) if (i - zero) % every == 0])
    bar.minorticks_off()
    bar.ax.tick_params(labelsize=7, width=0.4, length=2)
    bar.set_label(label, fontsize=7.5, labelpad=1)


def _in_section(inclination: Array, rotation: Array, section: float) -> tuple[Array, NDArray[np.bool_]]:
    """Return signed inclinations in the section at a rotation, and which tilts are near it."""
    cosine = np.cos(rotation - section)
    signed = inclination * np.sign(cosine)
    flat = np.abs(inclination) < np.deg2rad(1.0)
    with np.errstate(invalid="ignore"):
        near = (np.abs(cosine) >= np.cos(_SECTION_WIDTH)) | flat
    return signed, np.asarray(near & np.isfinite(inclination) & np.isfinite(rotation))
