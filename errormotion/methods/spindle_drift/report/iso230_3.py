"""Tables of thermal drift values as in ISO 230-3: ranges and differences, first hour and whole record."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from errormotion.report.document import Cell, Table, estimate
from errormotion.report.drawings.series import QUANTITIES, Event, curves, end_of_running, minutes_of, unit_of
from errormotion.report.text import fixed

_STEP = "includes the step of a compensation that was switched in this interval"
_SLOPE_INTERVAL = 10.0  # before the end of running, for the end slope, min
_PER_HOUR = 3600.0


def value_of(errors: xr.Dataset, quantity: str, measure: str) -> tuple[float, float]:
    """Return one ISO 230-3 value and its standard uncertainty in SI; NaN where the dataset does not contain it."""
    if "iso_value" not in errors:
        return math.nan, math.nan
    place = {}
    for dim, label in (("quantity", quantity), ("measure", measure)):
        places = np.flatnonzero(errors[dim].values == label)
        if not places.size:
            return math.nan, math.nan
        place[dim] = places[0]
    value, uncertainty = (
        float(errors.variables[name].isel(place)) if name in errors else math.nan
        for name in ("iso_value", "iso_uncertainty")
    )
    return value, uncertainty


def cell(errors: xr.Dataset, quantity: str, measure: str, done: Sequence[Event] = ()) -> Cell:
    """Return one value in the units of the report with its expanded uncertainty, or a dash with the reason.

    A footnote states that the quantity's compensation was switched in the interval of the value.
    """
    value, uncertainty = value_of(errors, quantity, measure)
    size = 60.0 if measure == "time_constant" else unit_of(quantity)[1]
    if measure == "end_slope":
        size /= _PER_HOUR
    made = estimate(
        value / size,
        2 * uncertainty / size,
        reason="" if math.isfinite(value) else why_not(errors, quantity, measure),
        signed=not measure.startswith(("range", "time")),
    )
    if math.isfinite(value) and contains_step(errors, quantity, measure, done):
        return replace(made, reason=_STEP)
    return made


def contains_step(errors: xr.Dataset, quantity: str, measure: str, done: Sequence[Event]) -> bool:
    """Return whether the quantity's compensation was switched within the interval of a measure."""
    switched = [event.minute for event in done if quantity[0] in event.axes]
    time = minutes_of(errors)
    if not (time.size and switched):
        return False
    stop = end_of_running(errors)
    running = time[stop] if stop is not None else time[-1]
    start = running - _SLOPE_INTERVAL if measure == "end_slope" else time[0]
    end = time[0] + 60 if measure.endswith("60min") else time[-1] if measure.endswith("total") else running
    return any(start < minute <= end for minute in switched)


def why_not(errors: xr.Dataset, quantity: str, measure: str) -> str:
    """Return the reason why a value is missing."""
    time = minutes_of(errors)
    values = curves(errors)[quantity].values
    if not np.isfinite(values).any():
        return f"{quantity} could not be determined from this record"
    if measure.endswith("60min") and (time.size == 0 or time[-1] - time[0] < 60):
        return f"the record is {fixed(time[-1] - time[0], 1)} min long, shorter than 60 min"
    if measure.endswith("running") and end_of_running(errors) is None:
        if "spindle_speed" in errors:
            return "the spindle did not turn in this record"
        return "the spindle speed was not recorded"
    if measure == "per_kelvin":
        if "temperature" not in errors or not np.isfinite(errors["temperature"].values).any():
            return "no temperature was recorded"
        return "the temperatures changed too little for a coefficient"
    if measure == "time_constant":
        return "the curve is not described by one exponential within this record"
    return "too few valid readings in this interval"


def tables(errors: xr.Dataset, done: Sequence[Event] = ()) -> list[Table]:
    """Return the table of drift values and the table of parameters of the curves."""
    if "iso_value" not in errors:
        return []
    time, stop = minutes_of(errors), end_of_running(errors)
    running = f"to the end of running ({fixed(time[stop], 1)} min)" if stop is not None else "to the end of running"
    whole = f"whole record ({fixed(time[-1], 1)} min)" if time.size else "whole record"
    groups = [("", 2), ("first 60 min, d(…)₆₀", 2), (running, 2), (whole, 2)]
    head = ["quantity", "unit"] + ["range", "difference"] * 3
    intervals = [f"{kind}_{span}" for span in ("60min", "running", "total") for kind in ("range", "difference")]
    first = Table(
        "Thermal drift values. Range: highest minus lowest value in the interval. Difference: value at the end of the "
        "interval minus value at its start. After ±: expanded uncertainty, k = 2.",
        head,
        [[f"d({name})", unit_of(name)[0], *(cell(errors, name, m, done) for m in intervals)] for name in QUANTITIES],
        groups,
    )
    second = Table(
        "Course of the drift. Time constant of the first approach, slope at the end of running, and displacement or "
        "tilt per kelvin of temperature change. After ±: expanded uncertainty, k = 2.",
        ["quantity", "time constant / min", "end slope", "unit", "per kelvin", "unit"],
        [
            [
                f"d({name})",
                cell(errors, name, "time_constant", done),
                cell(errors, name, "end_slope", done),
                f"{unit_of(name)[0]}/h",
                cell(errors, name, "per_kelvin", done),
                f"{unit_of(name)[0]}/K",
            ]
            for name in QUANTITIES
        ],
    )
    return [first, second]
