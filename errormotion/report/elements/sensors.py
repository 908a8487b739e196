"""Temperature sensors: positions on the machine, temperatures, and missing readings."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from markupsafe import Markup
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.report import canvas
from errormotion.report.document import Block, Cell, Figure, Source, Table, Text, or_dash
from errormotion.report.drawings.timeline import UNKNOWN, sensor_names
from errormotion.report.drawings.turntable import TURN, Dots, Ellipsoids, Lines, Scene, draw
from errormotion.report.text import DASH, finite, fixed, integer, listed, percent

_FAINT, _STILL, _COOLER = "#c3c8d0", "#6f7680", canvas.BLUE
_WARMER = ("#6f7680", "#B07800", "#D55E00", "#96280a")
_WIDE, _HIGH = 110.0, 18.0
_MAX_GAPS = 60
_MIN_CHANGE = 0.5  # K; smaller changes are not coloured


@dataclass(frozen=True)
class Sensors:
    """The temperature sensors: their places on the machine as a map, their temperatures as a table.

    ``others`` returns names and places (k, 3) in m of further points of the map, which are drawn for orientation.
    """

    others: Callable[[xr.Dataset], tuple[Sequence[str], Array] | None] | None = None

    def blocks(self, source: Source, key: str) -> list[Block]:
        """Return the drawing and the table; a note without temperatures."""
        others = self.others(source.errors) if self.others is not None else None
        return blocks(of_dataset(source.errors, source), key, others)


@dataclass(frozen=True)
class Sensor:
    """Temperatures of one sensor.

    Attributes
    ----------
    name : str
    place : (3,)
        Position on the machine, m; NaN = unknown.
    first, low, high, last : float
        degC, of the known values; NaN if there are none.
    known : float
        Fraction of the instants with a value.
    curve : (2, n)
        Time and temperature, for a small drawing; NaN in gaps.
    why : str
        Reasons of missing values, if known.
    """

    name: str
    place: Array
    first: float
    low: float
    high: float
    last: float
    known: float
    curve: Array
    why: str = ""

    @property
    def change(self) -> float:
        """Largest deviation from the first known temperature, K."""
        up, down = self.high - self.first, self.low - self.first
        return up if up >= -down else down

    @property
    def placed(self) -> bool:
        """Whether its position is known."""
        return bool(np.isfinite(self.place).all())


def of_dataset(errors: xr.Dataset, source: Source) -> list[Sensor]:
    """Return the sensors of a dataset with temperatures over time; positions are from the settings of instruments."""
    names = sensor_names(errors)
    if not names:
        return []
    values = np.asarray(errors["temperature"].transpose("time", "sensor").values, float)
    time = np.asarray(errors["time"].values, float)
    where = places(source)
    found = []
    for i, name in enumerate(names):
        own = values[np.isfinite(values[:, i]), i]
        first, last = (float(own[0]), float(own[-1])) if own.size else (math.nan, math.nan)
        low, high = finite(np.min, own), finite(np.max, own)
        share = own.size / max(len(values), 1)
        place = where.get(name, np.full(3, np.nan))
        found.append(Sensor(name, place, first, low, high, last, share, np.stack([time, values[:, i]])))
    return found


def places(source: Source) -> dict[str, Array]:
    """Return the positions of sensors in the settings of instruments, m, by their names in datasets."""
    found: dict[str, Array] = {}
    for holder in (source.provenance, source.run):
        entries = holder.get("instruments")
        for entry in entries if isinstance(entries, (list, tuple)) else []:
            settings = entry.get("settings") if isinstance(entry, Mapping) else None
            given = settings.get("places") if isinstance(settings, Mapping) else None
            for name, place in given.items() if isinstance(given, Mapping) else []:
                point = _point(place)
                if point is not None:
                    # If two instruments have channels of the same name, datasets prefix the instrument.
                    found.setdefault(str(name), point)
                    found[f"{entry.get('name', '')}.{name}"] = point
    return found


def _point(place: Any) -> Array | None:
    try:
        point = np.asarray(place, dtype=float)
    except (TypeError, ValueError):
        return None
    return point if point.shape == (3,) and np.isfinite(point).all() else None


def blocks(sensors: Sequence[Sensor], key: str, others: tuple[Sequence[str], Array] | None = None) -> list[Block]:
    """Return the map, if any position is known, and the table.

    Parameters
    ----------
    sensors : sequence of Sensor
    key : str
        Makes identifiers unique.
    others : (names, (k, 3)), optional
        Further points that are drawn for orientation, m.
    """
    if not sensors:
        return [Text("No temperatures were recorded.", "note")]
    placed = [sensor for sensor in sensors if sensor.placed]
    found: list[Block] = []
    if placed:
        found.append(_map(placed, [sensor.name for sensor in sensors if not sensor.placed], key, others))
    else:
        found.append(
            Text(
                "The positions of the sensors on the machine are unknown; no map is drawn. State them as 'places' of "
                "the thermometer in the bench file.",
                "note",
            )
        )
    return [*found, table(sensors)]


def _map(placed: Sequence[Sensor], lost: Sequence[str], key: str, others: tuple[Sequence[str], Array] | None) -> Figure:
    where = np.array([sensor.place for sensor in placed])
    names, points = others if others is not None else ([], np.empty((0, 3)))
    points = np.asarray(points, float)
    kept = [i for i in range(len(points)) if np.isfinite(points[i]).all()]
    names, points = [names[i] for i in kept], points[kept]
    every = np.concatenate([where, points])
    floor = float(every[:, 2].min()) - 0.05 * max(float(np.ptp(every, axis=0).max()), 0.1)
    largest = finite(np.max, np.abs([sensor.change for sensor in placed]))
    parts: list[Lines | Dots | Ellipsoids] = [Lines(_floor(every, floor), _FAINT, 0.6)]
    parts.append(Lines(np.stack([every, every * (1, 1, 0) + (0, 0, floor)], axis=1), _FAINT, 0.5, dash="2 2"))
    if len(points):
        parts.append(Dots(points, _STILL, 2.2, names))
    shade = max(largest / len(_WARMER), _MIN_CHANGE)
    for sensor in placed:
        label = (
            f"{sensor.name} {fixed(sensor.change, 1, signed=True)} K" if _known(sensor) else f"{sensor.name} unknown"
        )
        parts.append(Dots(sensor.place[None], _colour(sensor, shade), 3.2, [label]))
    caption = (
        "Positions of the sensors on the machine, with the largest change from the first known temperature. "
        + (
            f"Grey: within {fixed(shade, 1)} K; ochre, orange and dark red: warmer by more than {fixed(shade, 1)}, "
            f"{fixed(2 * shade, 1)} and {fixed(3 * shade, 1)} K; blue: cooler. "
            if largest >= _MIN_CHANGE
            else f"All changes are smaller than {fixed(_MIN_CHANGE, 1)} K. "
        )
        + "Dashed lines lead to the base of the drawing."
        + (f" Grey points: {listed(list(names))}." if len(names) else "")
        + (f" Position unknown: {listed(list(lost))}." if lost else "")
        + TURN
    )
    words = "; ".join(f"{s.name} {fixed(s.change, 1, signed=True)} K" for s in placed)
    return Figure(draw(Scene(parts), key), caption, f"Sensors in space, with their change: {words}.")


def _known(sensor: Sensor) -> bool:
    return math.isfinite(sensor.change)


def _colour(sensor: Sensor, shade: float) -> str:
    if not _known(sensor):
        return canvas.BLACK
    steps = sensor.change / shade
    return _COOLER if steps <= -1 else _WARMER[int(np.clip(steps, 0, len(_WARMER) - 1))]


def _floor(points: Array, height: float) -> Array:
    """Return the edges of the rectangle below all points, (4, 2, 3)."""
    (x0, y0), (x1, y1) = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    corners = np.array([[x, y, height] for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))])
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def table(sensors: Sequence[Sensor]) -> Table:
    """Return the table of range, last value and small curve of each sensor."""
    rows: list[list[Cell | str]] = []
    never = "no valid reading"
    for sensor in sensors:
        where = ", ".join(fixed(1e3 * value, 0) for value in sensor.place) if sensor.placed else DASH
        missing = Cell(percent(1 - sensor.known), reason=f"of {sensor.name}: {sensor.why}" if sensor.why else "")
        rows.append(
            [
                sensor.name,
                or_dash(where, "position not stated"),
                *(or_dash(fixed(v, 1), never) for v in (sensor.first, sensor.low, sensor.high, sensor.last)),
                or_dash(fixed(sensor.change, 1, signed=True), never),
                missing if sensor.known < 1 else "never",
                Cell(sparkline(sensor.curve)),
            ]
        )
    return Table(
        "Temperatures in °C, and the largest change from the first known temperature in K. Each small curve is scaled "
        "from its lowest to its highest value; red: no value.",
        ["sensor", "position / mm", "first", "lowest", "highest", "last", "change", "missing", "curve"],
        rows,
    )


def sparkline(curve: Array) -> Markup:
    """Return a curve (2, n) without axes, with a red bar at the bottom where it is NaN."""
    time, values = curve
    time, values = canvas.decimate(np.asarray(time, float), np.asarray(values, float), 50)
    size = f"viewBox='0 0 {_WIDE:g} {_HIGH:g}' width='{_WIDE:g}' height='{_HIGH:g}' style='vertical-align:middle'"
    if time.size < 2 or not time[-1] > time[0]:
        return Markup(f"<svg {size} aria-hidden='true'></svg>")
    x = (time - time[0]) / (time[-1] - time[0]) * (_WIDE - 2) + 1
    known = np.isfinite(values)
    drawn = []
    if known.any():
        low, span = finite(np.min, values), max(float(np.ptp(values[known])), 0.2)
        y = _HIGH - 5 - (values - low) / span * (_HIGH - 7)
        path = "".join(f"{'L' if i and known[i - 1] else 'M'}{x[i]:.1f} {y[i]:.1f}" for i in range(x.size) if known[i])
        drawn.append(f"<path d='{path}' fill='none' stroke='{canvas.BLUE}' stroke-width='1.2'/>")
    bars = _runs(x, ~known)
    if bars:
        path = "".join(f"M{a:.1f} {_HIGH - 1.5:g}H{b:.1f}" for a, b in bars[:_MAX_GAPS])
        drawn.append(f"<path d='{path}' fill='none' stroke='{UNKNOWN}' stroke-width='2.5'/>")
    last = "the last is unknown" if not known[-1] else f"the last is {fixed(float(values[-1]), 1)} °C"
    return Markup(f"<svg {size} role='img' aria-label='curve; {last}'>{''.join(drawn)}</svg>")


def _runs(x: Array, where: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Return start and end of each run, from neighbour to neighbour."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(np.int8)))
    return [
        (float(x[max(start - 1, 0)]), float(x[min(stop, x.size - 1)]))
        for start, stop in zip(edges[::2], edges[1::2], strict=True)
    ]


def warmest(sensors: Sequence[Sensor]) -> str:
    """Return a sentence on the sensor with the largest change, and on unknown ones; empty without sensors."""
    known = [sensor for sensor in sensors if _known(sensor)]
    if not known:
        return f"{integer(len(sensors))} sensors, none with a valid reading." if sensors else ""
    most = max(known, key=lambda sensor: abs(sensor.change))
    change = f"{most.name}, {fixed(most.change, 1, signed=True)} K"
    words = f"{integer(len(sensors))} temperature sensors; largest change: {change}."
    unknown = [sensor.name for sensor in sensors if not math.isfinite(sensor.last)]
    return words + (f" Without a valid reading: {listed(unknown)}." if unknown else "")
