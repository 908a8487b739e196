"""A history as text, in um, arcsec and degC."""

from __future__ import annotations

import math
from datetime import UTC, datetime

import numpy as np
import xarray as xr

from errormotion.datasets.files.events import instant
from errormotion.record.history import version_changes
from errormotion.report.text import rounded

FIELD = {"m": (1e6, "um"), "rad": (648000 / math.pi, "arcsec"), "1": (1.0, ""), "degC": (1.0, "degC")}
"""Factor and name of the printed unit, by SI unit."""
MM_FROM = 1e-3
"""Smallest length that is printed in mm, m."""


def field_of(ds: xr.Dataset) -> tuple[float, str]:
    """Return factor and name of the printed unit of the figure of a history."""
    unit = str(ds.attrs["unit"])
    if unit == "m" and np.median(np.abs(ds["value"].values)) >= MM_FROM:
        return 1e3, "mm"
    return FIELD[unit]


def date(ds: xr.Dataset, seconds: float) -> str:
    """Return a time of a history as date and time of day, UTC."""
    start = instant(str(ds.attrs["start"])) or datetime.fromtimestamp(0, UTC)
    return f"{datetime.fromtimestamp(start.timestamp() + seconds, UTC):%Y-%m-%d %H:%M}"


def sized(ds: xr.Dataset, value: float, half_width: float) -> str:
    """Return a value with the half width of its interval and the unit; ``unknown`` for NaN."""
    if not math.isfinite(value):
        return "unknown"
    factor, unit = field_of(ds)
    text, spread = rounded(factor * value, factor * half_width)
    return f"{text} ± {spread} {unit}".rstrip()


def trend_text(ds: xr.Dataset) -> str:
    """Return the trend with its interval."""
    if not np.isfinite(ds["trend"]):
        return "unknown, because values at three or more times are needed"
    factor, unit = field_of(ds)
    low, high = float(ds["trend_low"]), float(ds["trend_high"])
    ends = [rounded(factor * each, factor * (high - low) / 2)[0] for each in (float(ds["trend"]), low, high)]
    slope, end = (f"{each} {unit}".rstrip() for each in (ends[0], ends[2]))
    return f"{slope} per year, {100 * float(ds.attrs['coverage']):.0f} % interval {ends[1]} to {end}"


def sentences(ds: xr.Dataset) -> list[str]:
    """Return the results of a history as sentences, the most important first."""
    factor, unit = field_of(ds)
    texts = []
    for k in range(ds.sizes["step"]):
        size = sized(ds, float(ds["step_size"][k]), float(ds["step_half_width"][k]))
        text = str(ds["step_event"].values[k])
        low, likely, high = (date(ds, float(ds[f"step_{name}"][k])) for name in ("low", "time", "high"))
        named = f", noted: {text}" if text else ", no note"
        p = float(ds["step_p"][k])
        texts.append(f"Step of {size} about {likely} (between {low} and {high}, p = {p:.2g}){named}.")
    if not texts:
        texts.append(
            "No significant step, with a probability of a false alarm of "
            f"{100 * float(ds.attrs['false_alarms']):.2g} %."
        )
    for k, before, after in version_changes(ds):
        when = date(ds, float(ds["time"][k]))
        texts.append(
            f"From {when} on, {before} is replaced by {after}: values before and after may differ by definition."
        )
    sure = float(ds["trend_low"]) > 0 or float(ds["trend_high"]) < 0
    texts.append(f"Trend: {trend_text(ds)}{'.' if not np.isfinite(ds['trend']) or sure else ': not significant.'}")
    names = ds["run"].values
    departing = [str(name) for name, each in zip(names, ds["departing"].values, strict=True) if each]
    if departing:
        texts.append(f"Outliers, which are left out of the centre of the chart: {', '.join(departing)}.")
    outside = [str(name) for name, each in zip(names, ds["outside"].values, strict=True) if each]
    shown = ", ".join(outside[:5]) + (f" and {len(outside) - 5} more" if len(outside) > 5 else "")
    texts.append(f"Outside the control limits: {shown}." if outside else "All values are within the control limits.")
    tau = float(ds["reproducibility"])
    if np.isfinite(tau):
        own = float(np.median(ds["expanded_uncertainty"].values)) / 2
        tau_text, own_text = rounded(factor * tau, factor * max(tau, own) / 10, signed=False)[0], factor * own
        texts.append(
            f"Reproducibility of machine and set-up (Paule and Mandel): standard deviation {tau_text} {unit}".rstrip()
            + f", in addition to the stated standard uncertainty of the runs, {own_text:.2g} {unit}".rstrip()
            + " (median)."
        )
    if "duration" in ds.variables and float(ds["duration"]) > 0:
        texts.append(
            f"Neighbouring runs are alike over about {float(ds['duration']) / 86400:.2g} days: the intervals of trend "
            "and steps contain it."
        )
    if count := ds.sizes["source"]:
        texts.append(f"Sources that several runs share, treated as fully correlated: {count}.")
    return texts
