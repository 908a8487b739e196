"""One figure of one machine over time as a dataset, schema ``errormotion.history/1``.

``series`` contains the values with their stated covariance, ``steps`` trend, steps and outliers, ``control`` the
control limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any

import numpy as np
import xarray as xr

from errormotion.datasets.files.events import instant
from errormotion.errors import DatasetError, RunError
from errormotion.estimation.between_runs import COVERAGE
from errormotion.record.control import chart
from errormotion.record.figures import figure_over_time
from errormotion.record.runs.listing import Listing, Note
from errormotion.record.series import Series
from errormotion.record.steps import FALSE_DEPARTURES, FALSE_STEPS, Model, Step, model_of

SCHEMA = "errormotion.history/1"
SMALL_SCATTER_P = 0.01
"""Probability of a scatter at most as small as the present one, below which the history states a note."""

#: Variable to its dimensions, its unit (``figure``: that of the figure), and its meaning.
TABLE: dict[str, tuple[tuple[str, ...], str, str]] = {
    "time": (("run",), "s", "of each run since `start`, not decreasing"),
    "value": (("run",), "figure", "the figure of each run"),
    "expanded_uncertainty": (("run",), "figure", "U (k = 2) that the run states"),
    "influence": (("source", "run"), "figure", "effect of one standard uncertainty of each source that runs share"),
    "source_id": (("source",), "text", "identity of each of these sources"),
    "version": (("run",), "text", "method and its version; empty where unknown; not in histories of earlier versions"),
    "centre": (("run",), "figure", "centre of the control chart"),
    "lower_limit": (("run",), "figure", "lower control limit"),
    "upper_limit": (("run",), "figure", "upper control limit"),
    "outside": (("run",), "flag", "1 where the value is outside of its limits, else 0"),
    "moving_range": (("run",), "figure", "absolute difference from the run before; NaN for the first and across steps"),
    "range_limit": (("run",), "figure", "its upper limit; NaN for the first"),
    "fitted": (("run",), "figure", "trend with steps; NaN for fewer than three times"),
    "fitted_half_width": (("run",), "figure", "half of its interval"),
    "departing": (("run",), "flag", "1 where a run departs alone from trend and steps, else 0"),
    "step_time": (("step",), "s", "most likely time: the middle between two runs"),
    "step_low": (("step",), "s", "last run surely before the step"),
    "step_high": (("step",), "s", "first run surely after the step"),
    "step_size": (("step",), "figure", "size"),
    "step_half_width": (("step",), "figure", "half of its interval"),
    "step_p": (("step",), "p", "probability that chance gives a step as clear"),
    "step_event": (("step",), "text", "notes between `step_low` and `step_high`, the nearest one first; may be empty"),
    "event_time": (("event",), "s", "of each note"),
    "event_text": (("event",), "text", "the note"),
    "event_by": (("event",), "text", "who noted it; may be empty"),
    "event_run": (("event",), "text", "run that it was noted on; empty for a note on the machine"),
    "trend": ((), "figure", "change per year; NaN for fewer than three times"),
    "trend_low": ((), "figure", "lower end of its interval"),
    "trend_high": ((), "figure", "upper end of its interval"),
    "reproducibility": ((), "figure", "tau by Paule and Mandel: standard deviation between runs about trend and steps"),
    "reproducibility_of_ranges": (
        (),
        "figure",
        "tau from the moving ranges, which the control limits hold unless runs are alike",
    ),
    "duration": (
        (),
        "s",
        "time over which runs are alike, 0 for independent ones; not in histories of earlier versions",
    ),
    "chi2": ((), "number", "of the residuals for the stated uncertainties alone"),
    "chi2_p": ((), "p", "probability of a smaller one"),
    "degrees": ((), "number", "its degrees of freedom"),
}
UNITS = ("m", "rad", "1", "degC")
OPTIONAL = ("version", "duration")
"""Variables that histories of earlier versions do not contain."""


def history(runs: Listing, machine: str, figure: str, at: Sequence[float] | None = None) -> xr.Dataset:
    """Return a figure of the runs of one machine over time.

    Parameters
    ----------
    runs : Listing
        Runs of this machine.
    machine, figure : str
        See `errormotion.record.figures.figure_over_time`.
    at : sequence of float, optional
        Place of a freedom, m.

    Returns
    -------
    Dataset
        Schema ``errormotion.history/1``.

    Raises
    ------
    RunError
        No run states the figure; the message lists the known figures.
    """
    followed = figure_over_time(runs.runs, figure, at)
    series = followed.series
    if series.unit not in UNITS:
        raise RunError(
            f"'{figure}': expected a unit of {', '.join(UNITS)}; found '{series.unit}'", code="history.unit.differs"
        )
    model = model_of(series)
    limits = chart(series, model)
    zero, fit = series.time[0], model.fit
    first = np.array([np.nan])
    unknown = np.full(series.size, np.nan)
    notes = [note for note in runs.notes if note.time is not None]
    found: dict[str, Any] = {
        "time": series.time - zero,
        "value": series.value,
        "expanded_uncertainty": 2 * series.u,
        "influence": series.influence if len(series.identities) else np.zeros((0, series.size)),
        "source_id": _texts(series.identities),
        "version": _texts(series.versions or [""] * series.size),
        "centre": limits.centre,
        "lower_limit": limits.lower,
        "upper_limit": limits.upper,
        "outside": limits.outside(series.value).astype(float),
        "moving_range": np.concatenate([first, limits.moving_range]),
        "range_limit": np.concatenate([first, limits.range_limit]),
        "fitted": fit.fitted if fit else unknown,
        "fitted_half_width": fit.fitted_half_width if fit else unknown,
        "departing": np.isin(np.arange(series.size), model.departing).astype(float),
        **_steps(series, model.steps, notes),
        "event_time": np.array([_seconds(note) - zero for note in notes]),
        "event_text": _texts([note.text for note in notes]),
        "event_by": _texts([note.by for note in notes]),
        "event_run": _texts([note.run for note in notes]),
        "trend": model.trend[0],
        "trend_low": model.trend[1],
        "trend_high": model.trend[2],
        "reproducibility": fit.tau if fit else np.nan,
        "reproducibility_of_ranges": limits.tau if series.size > 1 else np.nan,
        "duration": fit.duration if fit else np.nan,
        "chi2": fit.chi2 if fit else np.nan,
        "chi2_p": fit.p if fit else np.nan,
        "degrees": float(fit.degrees) if fit else np.nan,
    }
    variables = {}
    for name, (dims, unit, meaning) in TABLE.items():
        units = {"figure": series.unit, "s": "s"}.get(unit)
        variables[name] = (dims, found[name], {"long_name": meaning} | ({"units": units} if units else {}))
    attrs: dict[str, Any] = {
        "schema": SCHEMA,
        "machine": machine,
        "figure": _common_name(series, figure),
        "unit": series.unit,
        "start": datetime.fromtimestamp(zero, UTC).isoformat(),
        "coverage": COVERAGE,
        "false_alarms": FALSE_STEPS + FALSE_DEPARTURES,
        "notes": [*followed.notes, *_remarks(model)] or [""],
        "left_out": list(followed.left_out) or [""],
    }
    if at is not None:
        attrs["at"] = [float(each) for each in at]
    ds = xr.Dataset(variables, coords={"run": _texts(series.runs)}, attrs=attrs)
    if wrong := violations(ds):
        raise DatasetError(f"The history does not conform to {SCHEMA}:", wrong, code="schema.violated")
    return ds


def version_changes(ds: xr.Dataset) -> list[tuple[int, str, str]]:
    """Return each run whose method or its version differs from that of the run before: index, version before, version.

    Runs of unknown version are passed over.
    """
    if "version" not in ds.variables:
        return []
    known = [(k, str(each)) for k, each in enumerate(ds["version"].values) if each]
    return [(k, before, after) for (_, before), (k, after) in pairwise(known) if before != after]


def _common_name(series: Series, figure: str) -> str:
    """Return the name of the figure if it is the same in all runs, otherwise the requested name."""
    names = set(series.names)
    return names.pop() if len(names) == 1 else figure


def _seconds(note: Note) -> float:
    return note.time.timestamp() if note.time is not None else np.nan


def _texts(texts: Sequence[str]) -> np.ndarray:
    return np.array(list(texts), dtype=str) if len(texts) else np.zeros(0, dtype="<U1")


def _steps(series: Series, steps: Sequence[Step], notes: Sequence[Note]) -> dict[str, Any]:
    t, named = series.time, []
    middle = [0.5 * (t[step.index - 1] + t[step.index]) for step in steps]
    for step in steps:
        before, after = float(t[step.index - 1]), float(t[step.index])
        away = [(max(before - _seconds(note), _seconds(note) - after, 0.0), note) for note in notes]
        inside = [(d, note) for d, note in away if t[step.first] <= _seconds(note) <= t[step.last]]
        versions = series.versions[step.first : step.last + 1]
        changed = [f"{a} replaced by {b}" for a, b in pairwise(filter(None, versions)) if a != b]
        named.append("; ".join([note.text for _, note in sorted(inside, key=lambda pair: pair[0])] + changed))
    return {
        "step_time": np.array(middle) - t[0],
        "step_low": np.array([t[step.first] for step in steps]) - t[0],
        "step_high": np.array([t[step.last] for step in steps]) - t[0],
        "step_size": np.array([step.size for step in steps]),
        "step_half_width": np.array([step.half_width for step in steps]),
        "step_p": np.array([step.p for step in steps]),
        "step_event": _texts(named),
    }


def _remarks(model: Model) -> list[str]:
    if model.fit is not None and model.fit.p < SMALL_SCATTER_P:
        return [
            f"The values scatter less than their uncertainties allow (chi-square {model.fit.chi2:.1f} with "
            f"{model.fit.degrees} degrees of freedom, p = {model.fit.p:.2g}): the runs share sources without an "
            "identity, or U is too large. The intervals of trend and steps are then too wide."
        ]
    return []


def violations(ds: xr.Dataset) -> list[str]:
    """Return every violation of the schema, one sentence each."""
    messages = [
        f"attribute '{name}': missing" for name in ("machine", "figure", "unit", "start") if name not in ds.attrs
    ]
    if "unit" in ds.attrs and ds.attrs["unit"] not in UNITS:
        messages.append(f"attribute 'unit': expected one of {', '.join(UNITS)}; found '{ds.attrs['unit']}'")
    if "start" in ds.attrs and instant(str(ds.attrs["start"])) is None:
        messages.append(
            f"attribute 'start': expected a time such as 2026-03-31T08:00:00+00:00; found {ds.attrs['start']!r}"
        )
    if "run" not in ds.coords:
        messages.append("run: missing; expected the names of the runs")
    for name, (dims, unit, meaning) in TABLE.items():
        if name not in ds.variables and name in OPTIONAL:
            continue
        if name not in ds.variables:
            messages.append(f"{name}: missing; expected {meaning}")
            continue
        variable = ds.variables[name]
        if variable.dims != dims:
            messages.append(f"{name}: expected dims ({', '.join(dims)}); found ({', '.join(map(str, variable.dims))})")
        elif variable.size and variable.dtype.kind not in ("UO" if unit == "text" else "fiu"):
            messages.append(f"{name}: expected {'text' if unit == 'text' else 'numbers'}; found {variable.dtype}")
    return messages or _wrong_values(ds)


def _wrong_values(ds: xr.Dataset) -> list[str]:
    messages = []
    known = ("time", "value", "expanded_uncertainty", "influence", "outside", "departing", "event_time", "step_size")
    messages += [
        f"{name}: expected known numbers; found NaN" for name in known if not np.isfinite(ds[name].values).all()
    ]
    if not ds.sizes["run"]:
        messages.append("run: expected at least one run; found none")
    if (np.diff(ds["time"].values) < 0).any():
        messages.append("time: expected the oldest run first; found a time before the one of the previous run")
    if (ds["expanded_uncertainty"].values <= 0).any():
        messages.append("expanded_uncertainty: expected values above 0")
    if (ds["lower_limit"].values > ds["upper_limit"].values).any():
        messages.append("lower_limit: expected values up to 'upper_limit'")
    for name in ("step_p", "chi2_p"):
        if ((ds[name].values < 0) | (ds[name].values > 1)).any():
            messages.append(f"{name}: expected probabilities from 0 to 1")
    low, middle, high = (ds[f"step_{name}"].values for name in ("low", "time", "high"))
    if not ((low <= middle) & (middle <= high)).all():
        messages.append("step_time: expected times between 'step_low' and 'step_high'")
    if float(ds["trend_low"]) > float(ds["trend_high"]):
        messages.append("trend_low: expected a value up to 'trend_high'")
    shared = (ds["influence"].values ** 2).sum(axis=0)
    if (4 * shared > ds["expanded_uncertainty"].values ** 2 * (1 + 1e-9)).any():
        messages.append("influence: expected shared sources up to the stated uncertainty")
    return messages
