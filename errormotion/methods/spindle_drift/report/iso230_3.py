"""The thermal drift values of ISO 230-3 in units of the page, with the reasons of missing ones; their two tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr

from errormotion.report.document import Cell, Source, estimate
from errormotion.report.drawings.series import QUANTITIES, Event, curves, end_of_running, events, minutes_of, unit_of
from errormotion.report.elements import Column, Table
from errormotion.report.provenance import read
from errormotion.report.text import fixed

_STEP = "includes the step of a compensation that was switched in this interval"
_SLOPE_INTERVAL = 10.0  # before the end of running, for the end slope, min
_SIZES = {"time_constant": 60.0, "end_slope": 1 / 3600.0}
"""Unit of a measure on the page, s and 1/s; those that are not stated here have none of their own."""


def done(errors: xr.Dataset) -> list[Event]:
    """Return the events of the schedule."""
    return events(Source(errors, provenance=read(errors)))


def values(errors: xr.Dataset) -> xr.Dataset | None:
    """Return the values over quantity and measure in units of the page; None where the dataset does not contain them.

    ``why`` is the reason of a missing value, ``step`` states that the compensation of a quantity was switched in the
    interval of a value.
    """
    if "iso_value" not in errors:
        return None
    dims, switched = ("quantity", "measure"), done(errors)
    value, u = (
        errors[name].transpose(*dims).values.copy() if name in errors else np.full(errors["iso_value"].shape, np.nan)
        for name in ("iso_value", "iso_uncertainty")
    )
    labels = [[str(name) for name in errors[dim].values] for dim in dims]
    why, step = np.full(value.shape, "", dtype=object), np.full(value.shape, "", dtype=object)
    for k, quantity in enumerate(labels[0]):
        for m, measure in enumerate(labels[1]):
            size = _SIZES.get(measure, 1.0) * (1.0 if measure == "time_constant" else unit_of(quantity)[1])
            value[k, m], u[k, m] = value[k, m] / size, u[k, m] / size
            why[k, m] = why_not(errors, quantity, measure) if not np.isfinite(value[k, m]) else ""
            step[k, m] = _STEP if contains_step(errors, quantity, measure, switched) else ""
    time, stop = minutes_of(errors), end_of_running(errors)
    units = [unit_of(name)[0] for name in labels[0]]
    return xr.Dataset(
        {
            "value": (dims, value), "u": (dims, u), "why": (dims, why.astype(str)), "step": (dims, step.astype(str)),
            "unit": ("quantity", units),
            "per_hour": ("quantity", [f"{unit}/h" for unit in units]),
            "per_kelvin": ("quantity", [f"{unit}/K" for unit in units]),
        },
        dict(zip(dims, labels, strict=True)),
        {
            "running": "to the end of running" + (f" ({fixed(time[stop], 1)} min)" if stop is not None else ""),
            "whole": "whole record" + (f" ({fixed(time[-1], 1)} min)" if time.size else ""),
        },
    ).reindex(quantity=list(QUANTITIES), fill_value={"value": np.nan, "u": np.nan, "why": "", "step": "", "unit": "",
              "per_hour": "", "per_kelvin": ""})  # fmt: skip


def cell(found: xr.Dataset, quantity: str, measure: str) -> Cell:
    """Return a value with its expanded uncertainty."""
    one = found.sel(quantity=quantity, measure=measure)
    signed = not measure.startswith(("range", "time"))
    return estimate(float(one["value"]), 2 * float(one["u"]), signed=signed)


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


def _column(measure: str, head: str = "") -> Column:
    return Column(
        "value",
        uncertainty="u",
        select={"measure": measure},
        head=head or measure.partition("_")[0],
        signed=not measure.startswith(("range", "time")),
        reason="why",
        note="step",
    )


def _quantity(found: xr.Dataset, dims: Sequence[str], index: Sequence[int]) -> str:  # noqa: ARG001 - one dim
    return f"d({found['quantity'].values[index[0]]})"


DRIFT = Table(
    "Thermal drift values. Range: highest minus lowest value in the interval. Difference: value at the end of the "
    "interval minus value at its start. After ±: expanded uncertainty, k = 2.",
    (
        Column("unit"),
        *(_column(f"{kind}_{span}") for span in ("60min", "running", "total") for kind in ("range", "difference")),
    ),
    over="quantity",
    of=values,
    place=_quantity,
    groups=(("", 2), ("first 60 min, d(…)₆₀", 2), ("{running}", 2), ("{whole}", 2)),
    absent="The result contains no ISO 230-3 values.",
)
COURSE = Table(
    "Course of the drift. Time constant of the first approach, slope at the end of running, and displacement or "
    "tilt per kelvin of temperature change. After ±: expanded uncertainty, k = 2.",
    (
        _column("time_constant", "time constant / min"),
        _column("end_slope", "end slope"),
        Column("per_hour", head="unit"),
        _column("per_kelvin", "per kelvin"),
        Column("per_kelvin", head="unit"),
    ),
    over="quantity",
    of=values,
    place=_quantity,
)
