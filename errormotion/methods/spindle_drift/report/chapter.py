"""The chapter of a spindle test: values, curves, temperatures, set-up, uncertainty, quality."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import xarray as xr

from errormotion.kinematics.iso import iso_names
from errormotion.methods.spindle_drift.report import drawings as spindle_figures
from errormotion.methods.spindle_drift.report import iso230_3, setup_drawing
from errormotion.report import budget, provenance, quality
from errormotion.report.document import Block, Cell, KeyFigure, Part, Section, Source, Table, Text, estimate, or_dash
from errormotion.report.drawings.series import (
    QUANTITIES,
    WHAT,
    Curve,
    Event,
    curves,
    end_of_running,
    events,
    last_known,
    minutes_of,
    steps,
    unit_of,
)
from errormotion.report.text import UM, finite, fixed, integer, listed, minutes


def part(source: Source, key: str) -> Part:
    """Return the chapter of one spindle drift dataset; ``key`` distinguishes the identifiers of its figures."""
    errors = source.errors
    return Part(
        "Thermal drift of the spindle",
        _key_figures(errors),
        _summary(source),
        [
            Section("iso", "Thermal drift values (ISO 230-3)", _values(source)),
            Section("drift", "Drift over time", _drift(source, key)),
            Section("temperatures", "Temperatures", _temperatures(source, key)),
            Section("setup", "Set-up", _setup(errors, key)),
            Section("uncertainty", "Uncertainty", _uncertainty(errors)),
            Section("quality", "Residuals and data quality", _quality(source, key)),
            Section("provenance", "Provenance", provenance.blocks(source)),
        ],
        spindle_figures.overview(errors, events(source), f"{key}-overview"),
    )


def _at(line: Curve, index: int | None) -> Cell:
    """Return a curve's value at an instant, or at the last valid one before it, relative to the reference state."""
    place = last_known(line.values, index)
    size = line.unit[1]
    if place is None:
        return Cell("—", reason="could not be determined from this record")
    return estimate(line.values[place] / size, 2 * line.uncertainty[place] / size)


def _key_figures(errors: xr.Dataset) -> list[KeyFigure]:
    found, stop, time = curves(errors), end_of_running(errors), minutes_of(errors)
    if not time.size:
        return []
    when = f"after {fixed(time[stop if stop is not None else -1], 1)} min"
    return [
        KeyFigure(label, _at(found[name], stop), unit_of(name)[0], when)
        for name, label in (
            ("X1", "X at L1"),
            ("Y1", "Y at L1"),
            ("Z", "Z"),
            ("A", "tilt about X"),
            ("B", "tilt about Y"),
        )
    ]


def _summary(source: Source) -> list[str]:
    errors = source.errors
    time, found, stop = minutes_of(errors), curves(errors), end_of_running(errors)
    if time.size < 2:
        return ["The record contains fewer than two instants: no drift can be reported."]
    words = [_procedure(errors)]
    by_size = sorted(
        (name for name in ("X1", "X2", "Y1", "Y2", "Z") if np.isfinite(found[name].values).any()),
        key=lambda name: -float(np.nanmax(np.abs(found[name].values))),
    )
    if by_size:
        words += _largest(errors, by_size[0])
    words += _changes(errors, events(source))
    words += _first_hour(errors)
    words += _course(errors, by_size, events(source))
    place = stop if stop is not None else time.size - 1
    largest = budget.largest(errors.isel(time=place), "EZ")
    if largest:
        words.append(f"The largest share in the variance of Z {_when(errors)}: {largest[0]}, {largest[1]}.")
    if errors.attrs.get("beams") == "nominal":
        words.append(
            "Nominal beams were used, not detected ones: the position of the bar is only as accurate as the drawing."
        )
    unseen = [name for name in ("EX", "EY", "EZ", "EA", "EB", "EC") if not np.isfinite(errors[name].values).any()]
    if unseen:
        names = iso_names("spindle")
        words.append(
            f"Not observed by this test: {', '.join(f'{name} ({names[name]})' for name in unseen)}. "
            "It is reported as unknown, not as zero."
        )
    return words


def _procedure(errors: xr.Dataset) -> str:
    time, stop = minutes_of(errors), end_of_running(errors)
    length = f"The record is {fixed(time[-1] - time[0], 1)} min long"
    if stop is None:
        known = "spindle_speed" in errors
        return f"{length}; {'the spindle did not turn' if known else 'the spindle speed was not recorded'}."
    speed = np.asarray(errors["spindle_speed"].values, float)
    turning = speed[np.abs(np.nan_to_num(speed)) > 0]
    low, high = (float(value) for value in np.percentile(np.abs(turning), [2, 98]))
    at = f"{integer(high)} /min" if high - low < 1e-2 * high else f"{integer(low)} to {integer(high)} /min"
    return f"{length}; the spindle turned at {at} until {fixed(time[stop], 1)} min."


def _with_uncertainty(value: Cell) -> str:
    return f"{value.text} ± {value.uncertainty}" if value.uncertainty else str(value.text)


def _largest(errors: xr.Dataset, name: str) -> list[str]:
    unit, size = unit_of(name)
    time = minutes_of(errors)
    moved = errors
    if name != "Z":
        height = float(errors["level_height"].values["12".index(name[1])])
        moved = errors.em.at([*np.asarray(errors.attrs["functional_point"], float)[:2], height])
    largest = moved.em.largest(f"E{name[0]}")
    place = largest.place
    value = estimate(largest.value / size, largest.expanded / size)
    return [
        f"The largest displacement is {WHAT[name].removeprefix('displacement ')}: {_with_uncertainty(value)} {unit}, "
        f"reached after {fixed(time[place], 1)} min."
    ]


def _changes(errors: xr.Dataset, done: Sequence[Event]) -> list[str]:
    """Return the effect of each switched compensation: the step of the displacement at the functional point."""
    words = []
    for event, axis, step in steps(errors, done):
        head = f"{event.what[0].upper()}{event.what[1:]} at {fixed(event.minute, 1)} min"
        if step is None:
            words.append(
                f"{head}: the step of {axis} is unknown: fewer than two means before or after it are complete. "
                "A smaller 'average' gives more of them."
            )
            continue
        start = estimate(step.before / UM[1], 2 * step.u_before / UM[1])
        change = estimate(step.step / UM[1], 2 * step.u_step / UM[1])
        words.append(
            f"{head}: {axis} at the functional point stepped by {_with_uncertainty(change)} µm, from "
            f"{_with_uncertainty(start)} µm."
        )
    return words


def _first_hour(errors: xr.Dataset) -> list[str]:
    """Return the ranges of the first 60 min: Z, the largest lateral one, the largest tilt."""
    ranges = []
    for names in (("Z",), ("X1", "X2", "Y1", "Y2"), ("A", "B")):
        values = {name: iso230_3.value_of(errors, name, "range_60min")[0] for name in names}
        known = {name: value for name, value in values.items() if math.isfinite(value)}
        if known:
            name = max(known, key=lambda quantity: known[quantity])
            cell = iso230_3.cell(errors, name, "range_60min")
            ranges.append(f"d({name}) {_with_uncertainty(cell)} {unit_of(name)[0]}")
    return [f"Largest ranges within the first 60 min: {listed(ranges)}."] if ranges else []


def _course(errors: xr.Dataset, by_size: list[str], done: Sequence[Event]) -> list[str]:
    if not by_size:
        return []
    name = by_size[0]
    slope, slope_u = iso230_3.value_of(errors, name, "end_slope")
    constant, _ = iso230_3.value_of(errors, name, "time_constant")
    words = []
    if np.isfinite(slope) and not iso230_3.contains_step(errors, name, "end_slope", done):
        cell = iso230_3.cell(errors, name, "end_slope")
        state = "still drifting" if abs(slope) > 2 * slope_u else "steady within the uncertainty"
        words.append(
            f"{_when(errors).capitalize()} d({name}) is {state}: {_with_uncertainty(cell)} {unit_of(name)[0]}/h."
        )
    if np.isfinite(constant):
        cell = iso230_3.cell(errors, name, "time_constant")
        words.append(f"d({name}) approaches its end value with a time constant of {_with_uncertainty(cell)} min.")
    return words


def _when(errors: xr.Dataset) -> str:
    stop = end_of_running(errors)
    return "at the end of running" if stop is not None else "at the end of the record"


def _values(source: Source) -> list[Block]:
    errors = source.errors
    found: list[Block] = list(iso230_3.tables(errors, events(source)))
    if not found:
        return [Text("The result contains no ISO 230-3 values.", "note")]
    meaning = "; ".join(f"{name}: {WHAT[name]}" for name in QUANTITIES)
    setup = setup_drawing.setup_of(errors)
    if setup is not None and setup.levels.size == 2:
        heights = [f"{'xyz'[setup.along]} = {fixed(1e3 * height, 3)} mm" for height in setup.levels]
        meaning += f". L1: {heights[0]}; L2: {heights[1]}"
    sensor = str(errors.attrs.get("iso_temperature_sensor", ""))
    if sensor:
        meaning += f". Per kelvin: of the temperature sensor '{sensor}'"
    return [*found, Text(f"{meaning}.", "note")]


def _drift(source: Source, key: str) -> list[Block]:
    done = events(source)
    made = [
        spindle_figures.displacements(source.errors, done, f"{key}-d", source.limits),
        spindle_figures.tilts(source.errors, done, f"{key}-t", source.limits),
    ]
    return [figure for figure in made if figure is not None] or [Text("No instant has a valid result.", "warning")]


def _temperatures(source: Source, key: str) -> list[Block]:
    figure = spindle_figures.temperatures(source.errors, events(source), f"{key}-temperature")
    if figure is None:
        return [Text("No temperatures were recorded with this test.", "note")]
    return [figure, _temperature_table(source.errors)]


def _temperature_table(errors: xr.Dataset) -> Table:
    values = errors["temperature"].transpose("time", "sensor").values
    names = errors["sensor"].values if "sensor" in errors.coords else np.arange(1, values.shape[1] + 1)
    stop = end_of_running(errors)
    rows: list[list[Cell | str]] = []
    for name, column in zip(names, values.T, strict=True):
        first, last = np.flatnonzero(np.isfinite(column))[:1], last_known(column, stop)
        start = column[first[0]] if first.size else math.nan
        end = column[last] if last is not None else math.nan
        spans = (start, end, finite(np.min, column), finite(np.max, column))
        rows.append(
            [
                str(name),
                *(or_dash(fixed(value, 2), "no valid reading") for value in spans),
                or_dash(fixed(end - start, 2, signed=True), "no valid reading"),
            ]
        )
    return Table(
        "Temperatures in °C, and their change in K from the start to the end of running.",
        ["sensor", "start", _when(errors).removeprefix("at the "), "lowest", "highest", "change"],
        rows,
    )


def _setup(errors: xr.Dataset, key: str) -> list[Block]:
    figure, table = setup_drawing.figure(errors, f"{key}-setup"), setup_drawing.table(errors)
    if figure is None or table is None:
        return [Text("The result does not contain the geometry of beams and bar.", "note")]
    return [figure, table]


def _uncertainty(errors: xr.Dataset) -> list[Block]:
    time, stop = minutes_of(errors), end_of_running(errors)
    if not time.size:
        return [Text("The record is empty.", "warning")]
    place = stop if stop is not None else time.size - 1
    hour = int(np.searchsorted(time, 60.0))
    places = {f"after {minutes(60 * time[hour])}": errors.isel(time=hour)} if hour < min(place, time.size - 1) else {}
    places[f"{_when(errors)} ({fixed(time[place], 1)} min)"] = errors.isel(time=place)
    if place < time.size - 1:
        places[f"end of the record ({fixed(time[-1], 1)} min)"] = errors.isel(time=-1)
    point = ", ".join(fixed(1e3 * float(value), 3) for value in np.atleast_1d(errors.attrs["functional_point"]))
    return [
        budget.twist_table(errors, places, iso_names("spindle")),
        budget.table(errors.isel(time=place), f"{_when(errors)} ({fixed(time[place], 1)} min)"),
        Text(
            f"Functional point ({point}) mm in the frame '{errors.attrs.get('frame', 'not stated')}'. Sources that "
            "affect many instants are common to all of them; differences between instants take their covariance into "
            "account, so that the uncertainty of a difference may be smaller than that of either value. "
            "The budget covers only the listed sources.",
            "note",
        ),
    ]


def _quality(source: Source, key: str) -> list[Block]:
    errors = source.errors
    blocks = quality.notes(errors) + quality.sentences(errors, source.raw)
    table = quality.table(errors)
    if table is not None:
        blocks.append(table)
    if "fit_residual" in errors:
        largest = np.abs(errors["fit_residual"].values)
        if np.isfinite(largest).any() and np.nanmax(largest) < 1e-11:
            blocks.append(
                Text(
                    "The fit is exact: as many readings as unknowns. The residuals are zero by construction and do "
                    "not show the accuracy, which depends on the sensors and the beam calibration.",
                    "note",
                )
            )
        else:
            figure = spindle_figures.channels(
                errors, "fit_residual", "Residual of the fit", "Residuals of the fit by channel.", f"{key}-residual"
            )
            blocks += [figure] if figure else []
    figure = spindle_figures.channels(
        errors, "distance_mean", "Averaged reading", "Averaged readings of the sensors by channel.", f"{key}-reading"
    )
    return [*blocks, figure] if figure else blocks
