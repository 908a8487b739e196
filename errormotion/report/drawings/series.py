"""The seven quantities of a spindle test over time: displacements at two levels, Z, and two tilts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from errormotion.datasets.timing import SWITCHING
from errormotion.report.canvas import BLUE, GREEN, ORANGE, PURPLE, SKY, VERMILLION
from errormotion.report.document import Source
from errormotion.report.provenance import read
from errormotion.report.text import SECOND_OF_ARC, UM

QUANTITIES = ("X1", "X2", "Y1", "Y2", "Z", "A", "B")
WHAT = {
    "X1": "displacement in X at level L1",
    "X2": "displacement in X at level L2",
    "Y1": "displacement in Y at level L1",
    "Y2": "displacement in Y at level L2",
    "Z": "displacement in Z at the end face",
    "A": "tilt about X",
    "B": "tilt about Y",
}

AROUND_A_STEP = 10.0
"""Interval before and after a step over which means are taken, s."""

LOOK: dict[str, tuple[str, tuple[float, ...] | None]] = {
    "X1": (BLUE, None),
    "X2": (SKY, (5, 2)),
    "Y1": (VERMILLION, None),
    "Y2": (ORANGE, (5, 2)),
    "Z": (GREEN, None),
    "A": (PURPLE, None),
    "B": (BLUE, (5, 2)),
}
"""Colour and dashes of each channel and quantity."""


@dataclass(frozen=True)
class Curve:
    """One quantity over time in SI, with its standard uncertainty; both (time,), NaN if not determined."""

    name: str
    values: np.ndarray
    uncertainty: np.ndarray

    @property
    def unit(self) -> tuple[str, float]:
        """Unit on the page, and its size in SI."""
        return unit_of(self.name)


def unit_of(quantity: str) -> tuple[str, float]:
    """Return the unit of an ISO 230-3 quantity on the page, and its size in SI."""
    return SECOND_OF_ARC if quantity in ("A", "B") else UM


def curves(errors: xr.Dataset) -> dict[str, Curve]:
    """Return the seven quantities by name; NaN if the dataset does not contain one."""
    n = errors.sizes.get("time", 0)
    nothing = np.full(n, np.nan)
    found = dict.fromkeys(QUANTITIES, (nothing, nothing))
    if "displacement" in errors:
        moved = errors["displacement"].transpose(..., "lateral", "time")
        sigma = errors["displacement_u"].transpose(..., "lateral", "time") if "displacement_u" in errors else None
        for i in range(min(moved.shape[0], 2)):
            for j, axis in enumerate("XY"):
                u = nothing if sigma is None else sigma.values[i, j]
                found[f"{axis}{i + 1}"] = (moved.values[i, j], u)
    for name, freedom, index in (("Z", "EZ", 2), ("A", "EA", 3), ("B", "EB", 4)):
        if freedom in errors:
            variance = errors["covariance"].isel(dof=index, dof_=index).values
            found[name] = (errors[freedom].values, np.sqrt(np.where(variance >= 0, variance, np.nan)))
    return {name: Curve(name, *both) for name, both in found.items()}


def minutes_of(errors: xr.Dataset) -> np.ndarray:
    """Return the instants in minutes since the reference state, (time,)."""
    return np.asarray(errors["time"].values, float) / 60


def running(errors: xr.Dataset) -> np.ndarray | None:
    """Return whether the spindle turns, bool (time,); None if the speed is unknown."""
    if "spindle_speed" not in errors or errors["spindle_speed"].dims != ("time",):
        return None
    speed = np.asarray(errors["spindle_speed"].values, float)
    return np.nan_to_num(np.abs(speed)) > 0 if np.isfinite(speed).any() else None


def end_of_running(errors: xr.Dataset) -> int | None:
    """Return the index of the last instant with turning spindle; None if there is none or it is unknown.

    The setting ``running_end`` of the method has priority over the recorded speed.
    """
    stated = read(errors).get("settings", {}).get("running_end")
    if isinstance(stated, (int, float)):
        # Relative to the start of the record; the time of the dataset is relative to the reference state. A mean that
        # ends later contains readings after the end of running.
        end = stated - float(errors.attrs.get("reference_time", 0.0))
        length, mean = length_of_means(errors)
        before = np.flatnonzero(errors["time"].values + (length / 2 if mean else 0.0) <= end + 1e-6)
        return int(before[-1]) if before.size else None
    turning = running(errors)
    return int(np.flatnonzero(turning)[-1]) if turning is not None and turning.any() else None


def length_of_means(errors: xr.Dataset) -> tuple[float, bool]:
    """Return the interval of the instants, s, and whether each is the middle of a mean of this length.

    A record whose readings are less frequent than the means is not averaged: its instants are time stamps.
    """
    time = np.asarray(errors["time"].values, float)
    interval = float(np.median(np.diff(time))) if time.size > 1 else 0.0
    average = read(errors).get("settings", {}).get("average")
    return interval, isinstance(average, (int, float)) and abs(interval - average) < 0.01 * average


@dataclass(frozen=True)
class StepWeights:
    """Weights over time, (time,), whose sums with the values of a freedom are parts of a step.

    Attributes
    ----------
    before, step : ndarray
        Value at the step by the line before it, and that by the line after it minus that by the line before it.
    bent_before, bent_after : ndarray
        Effects on the values by the lines of a curvature that changes a slope by itself within the age of the drift.
    """

    before: np.ndarray
    step: np.ndarray
    bent_before: np.ndarray
    bent_after: np.ndarray


@dataclass(frozen=True)
class Step:
    """A step of a displacement and its value before the step, with standard uncertainties, m."""

    before: float
    u_before: float
    step: float
    u_step: float


def steps(errors: xr.Dataset, done: Sequence[Event]) -> list[tuple[Event, str, Step | None]]:
    """Return each switched compensation with its axis and the step of the displacement; None where it is unknown."""
    found = []
    for event in done:
        for axis in event.axes:
            others = [60 * other.minute for other in done if axis in other.axes or not other.axes]
            found.append((event, axis, step_of(errors, f"E{axis}", 60 * event.minute, others)))
    return found


def step_of(errors: xr.Dataset, freedom: str, at: float, others: Sequence[float] = ()) -> Step | None:
    """Return the step of a freedom over ``time`` by `step_weights`; None as there."""
    weights = step_weights(errors, freedom, at, others)
    if weights is None:
        return None
    (before, u_before), (step, u_step), (bent_before, _), (bent_after, _) = (
        _combined(errors, each, freedom)
        for each in (weights.before, weights.step, weights.bent_before, weights.bent_after)
    )
    bent = abs(bent_before) + abs(bent_after)
    return Step(before, math.hypot(u_before, bent_before), step, math.hypot(u_step, bent))


def _combined(errors: xr.Dataset, weights: np.ndarray, freedom: str) -> tuple[float, float]:
    """Return a linear combination of one displacement over time with its standard uncertainty, m."""
    used = np.flatnonzero(weights)
    combined = errors.isel(time=used).em.combine(weights[used], "time")
    variance = float(combined.covariance.sel(dof=freedom, dof_=freedom))
    return float(combined.value.sel(dof=freedom)), math.sqrt(max(variance, 0.0))


def step_weights(errors: xr.Dataset, freedom: str, at: float, others: Sequence[float] = ()) -> StepWeights | None:
    """Return the weights of a step of a freedom over ``time``, by lines through the values before and after it.

    A line is fitted to the values within `AROUND_A_STEP`, or to the two nearest ones if it contains fewer. Values whose
    mean contains a time from ``at`` until `SWITCHING` later are on neither side. None where one side has fewer than two
    values: a switched compensation changes the slope, so that the line of the other side does not replace it.

    A drift that has lasted for a time t, its age, is bent by no more than its slope divided by t: faster parts of a
    warm-up are over by then.

    Parameters
    ----------
    errors : Dataset
        Over ``time``.
    freedom : str
    at : float
        Time of the step, s since the reference state.
    others : sequence of float
        Times of other changes, s, beyond which no value is used.
    """
    time = np.asarray(errors["time"].values, float)
    known = np.isfinite(errors[freedom].values)
    length, mean = length_of_means(errors)
    reach = length / 2 if mean else length  # a time stamp may be that of the start or of the end of a reading
    age = at - max((other for other in others if other < at), default=0.0)
    values, bent = list[np.ndarray](), list[np.ndarray]()
    for later in (False, True):
        usable = known & ((time - reach >= at + SWITCHING - 1e-6) if later else (time + reach <= at + 1e-6))
        for other in others:
            if other > at:
                usable &= time + reach <= other + 1e-6
            elif other < at:
                usable &= time - reach >= other + SWITCHING - 1e-6
        nearest = np.flatnonzero(usable)
        nearest = nearest[np.argsort(np.abs(time[nearest] - at), kind="stable")]
        if nearest.size < 2:
            return None
        line = nearest[: max(2, int((np.abs(time[nearest] - at) <= AROUND_A_STEP).sum()))]
        t = time[line] - at
        slope = (t - t.mean()) / np.sum((t - t.mean()) ** 2)
        value = 1.0 / t.size - t.mean() * slope
        values.append(_spread(time.size, line, value))
        bent.append(_spread(time.size, line, slope * (value @ t**2) / 2 / max(age, AROUND_A_STEP)))
    return StepWeights(values[0], values[1] - values[0], *bent)


def _spread(size: int, places: np.ndarray, weights: np.ndarray) -> np.ndarray:
    found = np.zeros(size)
    found[places] = weights
    return found


def last_known(values: np.ndarray, index: int | None = None) -> int | None:
    """Return the last index at or before ``index`` with a finite value; None if there is none."""
    known = np.flatnonzero(np.isfinite(values[: None if index is None else index + 1]))
    return int(known[-1]) if known.size else None


@dataclass(frozen=True)
class Event:
    """A command to the machine, at a time in minutes; the compensation of ``axes`` was changed."""

    minute: float
    what: str
    axes: tuple[str, ...] = ()


def events(source: Source) -> list[Event]:
    """Return the commands of the schedule in the settings within the record, in chronological order."""
    schedule = source.settings.get("schedule")
    zero = float(source.errors.attrs.get("reference_time", 0.0))
    if not isinstance(schedule, (list, tuple)):
        return []
    found = []
    for entry in schedule:
        if isinstance(entry, Mapping):
            at = _seconds(entry.get("at", entry.get("time")))
            what = _done(entry)
            if math.isfinite(at) and what:
                axes = entry.get("compensation")
                found.append(Event((at - zero) / 60, what, tuple(axes) if isinstance(axes, Mapping) else ()))
    time = minutes_of(source.errors)
    end = time[-1] if time.size else -math.inf
    return sorted((event for event in found if event.minute <= end), key=lambda event: event.minute)


def commanded_speed(source: Source) -> np.ndarray | None:
    """Return the spindle speed that the schedule commands until each instant, 1/min (time,); None without a schedule.

    A machine that stands still while it is measured turns more slowly on average than it was commanded to.
    """
    schedule = source.settings.get("schedule")
    zero = float(source.errors.attrs.get("reference_time", 0.0))
    found = [
        (_seconds(entry.get("at", entry.get("time"))) - zero, float(entry["spindle_speed"]))
        for entry in (schedule if isinstance(schedule, (list, tuple)) else ())
        if isinstance(entry, Mapping) and isinstance(entry.get("spindle_speed"), (int, float))
    ]
    found = sorted(each for each in found if math.isfinite(each[0]))
    if not found:
        return None
    time = np.asarray(source.errors["time"].values, float)
    last = np.searchsorted([at for at, _ in found], time, side="left") - 1
    return np.where(last >= 0, np.array([speed for _, speed in found])[last], 0.0)


def _seconds(value: Any) -> float:
    if isinstance(value, (int, float)):
        return float(value)
    words = str(value).split()
    sizes = {"s": 1.0, "min": 60.0, "h": 3600.0}
    try:
        return float(words[0]) * sizes[words[1]]
    except (IndexError, KeyError, ValueError):
        return math.nan


def _done(entry: Mapping[str, Any]) -> str:
    words = []
    speed = entry.get("spindle_speed")
    if speed is not None:
        words.append(f"{speed:g} /min" if isinstance(speed, (int, float)) else str(speed))
    compensation = entry.get("compensation")
    if isinstance(compensation, Mapping):
        words += [f"{axis} compensation {'on' if state else 'off'}" for axis, state in compensation.items()]
    return ", ".join(words)
