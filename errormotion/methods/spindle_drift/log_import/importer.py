"""Conversion of logs of a drift, columns of text, to a raw dataset."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.files.tomlfile import load_model
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.tables.table import Place
from errormotion.datasets.text.log_reader import NOTES, Columns, holes, read_columns
from errormotion.datasets.units import convert
from errormotion.errors import DatasetError
from errormotion.methods.spindle_drift.imported_beams import with_beam_covariance
from errormotion.methods.spindle_drift.log_import.import_map import (
    MAP_SCHEMA,
    Channel,
    ImportMap,
    SpeedColumn,
    TemperatureColumn,
    TimeColumn,
)
from errormotion.methods.spindle_drift.schema import CHANNELS, RAW_SCHEMAS

_DRIFT = RAW_SCHEMAS[0]
_ROWS = {row.name: row for row in _DRIFT.rows}
_VARIABLE = {"time": "time", "channels": "distance", "temperatures": "temperature", "spindle_speed": "spindle_speed"}


def read_log(log: Path, map_file: Path) -> xr.Dataset:
    """Return the raw dataset of a drift from a log and a map of the schema ``errormotion.map/1``.

    Empty cells are NaN, and counted in the attribute ``missing_values`` (JSON, key of the map to count).

    Raises
    ------
    DatasetError
        The map or the log is invalid; all mistakes are reported together, each with its line.
    """
    settings = load_model(map_file, ImportMap, error=DatasetError)
    mistakes = Mistakes(log)
    columns = read_columns(_columns_of(settings), "time", settings.time.unit, settings.format, mistakes)
    _check_times(columns, mistakes)
    _check_magnitudes(columns, settings, mistakes)
    mistakes.raise_any()
    return _raw_dataset(columns, settings)


LOG_READERS = {MAP_SCHEMA: read_log}
"""Formats of maps that the method reads."""


def _columns_of(settings: ImportMap) -> dict[str, Place]:
    """Return the column of each key of the map."""
    columns: dict[str, Place] = {"time": settings.time.column}
    columns |= {f"channels.{name}": settings.channels[name].column for name in CHANNELS}
    columns |= {f"temperatures.{name}": entry.column for name, entry in settings.temperatures.items()}
    if settings.spindle_speed is not None:
        columns["spindle_speed"] = settings.spindle_speed.column
    return columns


def _check_times(columns: Columns, mistakes: Mistakes) -> None:
    """Report times that do not increase."""
    t, lines = columns.values["time"], columns.lines
    known = np.flatnonzero(~np.isnan(t))
    for step in np.flatnonzero(np.diff(t[known]) <= 0):
        before, after = known[step], known[step + 1]
        mistakes.add(
            int(lines[after]),
            f"time: expected more than {t[before]:.9g} of line {int(lines[before])}; found {t[after]:.9g}",
            "time: expected to increase",
        )


def _check_magnitudes(columns: Columns, settings: ImportMap, mistakes: Mistakes) -> None:
    """Report the first implausible value of each column."""
    for key, values in columns.values.items():
        row = _ROWS[_VARIABLE[key.partition(".")[0]]]
        inside = _inside(key, columns, settings)
        outside = np.flatnonzero((inside < row.low) | (inside > row.high))
        if outside.size:
            first, unit = outside[0], _column(key, settings).unit
            mistakes.add(
                int(columns.lines[first]),
                f"{key}: {values[first]:.6g} is a {row.name} of {inside[first]:.6g} {row.unit}; expected "
                f"{row.low:g}..{row.high:g} {row.unit}. Is the unit '{unit}' right? ({outside.size} such values)",
            )


def _column(key: str, settings: ImportMap) -> TimeColumn | Channel | TemperatureColumn | SpeedColumn:
    """Return the entry of the map for a column."""
    table, _, name = key.partition(".")
    if table == "channels":
        return settings.channels[name]
    if table == "temperatures":
        return settings.temperatures[name]
    return settings.spindle_speed if table == "spindle_speed" and settings.spindle_speed else settings.time


def _inside(key: str, columns: Columns, settings: ImportMap) -> Array:
    """Return a column in the unit of the schema."""
    column = _column(key, settings)
    unit = columns.time_unit if key == "time" else column.unit
    inside = np.asarray(convert(columns.values[key], unit, _ROWS[_VARIABLE[key.partition(".")[0]]].unit))
    return inside * column.scale + column.offset if isinstance(column, Channel) else inside


def _raw_dataset(columns: Columns, settings: ImportMap) -> xr.Dataset:
    channels = [settings.channels[name] for name in CHANNELS]
    direction = np.array([channel.direction for channel in channels])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    inside = {key: _inside(key, columns, settings) for key in columns.values}
    metre = {"units": "m"}
    variables: dict[str, Any] = {
        "distance": (("channel", "time"), np.stack([inside[f"channels.{name}"] for name in CHANNELS]), metre),
        "beam_origin": (("channel", "direction"), [channel.origin for channel in channels], metre),
        "beam_direction": (("channel", "direction"), direction, {"units": "1"}),
        "bar_radius": ((), settings.bar_radius, metre),
        "distance_noise": ((), settings.distance_noise, metre),
        "level": (("height",), list(settings.levels), metre),
    }
    coords: dict[str, Any] = {
        "channel": list(CHANNELS),
        "direction": ["x", "y", "z"],
        "height": ["L1", "L2"],
        "time": (("time",), inside["time"], {"units": "s"}),
    }
    if channels[0].origin_uncertainty is not None:
        for name in ("origin_uncertainty", "direction_uncertainty"):
            variables[f"beam_{name}"] = (("channel",), [getattr(channel, name) for channel in channels])
    if settings.temperatures:
        temperature = np.stack([inside[f"temperatures.{name}"] for name in settings.temperatures], axis=1)
        variables["temperature"] = (("time", "sensor"), temperature, {"units": "degC"})
        coords["sensor"] = list(settings.temperatures)
    if settings.spindle_speed is not None:
        variables["spindle_speed"] = (("time",), inside["spindle_speed"], {"units": "1/min"})
    missing = {key: int(np.isnan(values).sum()) for key, values in columns.values.items()}
    attrs: dict[str, Any] = {
        "schema": _DRIFT.id,
        "missing_values": json.dumps({key: count for key, count in missing.items() if count}),
    }
    attrs |= {name: value for name, value in (("machine", settings.machine), ("start", columns.start)) if value}
    notes = [*holes(inside["time"], columns.lines), *columns.notes]
    if notes:
        attrs[NOTES] = json.dumps(notes)
    return with_beam_covariance(xr.Dataset(variables, coords, attrs))
