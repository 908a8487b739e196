"""The page of a history: values with trend and steps, control chart, moving ranges, notes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure as Drawing

from errormotion.arrays import Array
from errormotion.datasets.files.events import instant
from errormotion.record.history import version_changes
from errormotion.record.text import date, field_of, sentences, sized, trend_text
from errormotion.report.canvas import BLACK, BLUE, GREEN, PURPLE, VERMILLION, WIDTH, draw
from errormotion.report.document import Block, Cell, Figure, KeyFigure, Part, Section, Source, Table, Text, estimate
from errormotion.report.page.language import texts_of
from errormotion.report.write import PLAIN, Form, write_page

HEIGHTS = {"values": 3.1, "chart": 2.5, "ranges": 1.9}
"""Heights of the figures, inches."""
MAX_ROWS = 200
"""Largest number of rows of the table of values; of more values the newest are listed."""


def write(history: xr.Dataset, out: Path, form: Form = PLAIN) -> Path:
    """Write the page of a history; an existing page is replaced."""
    source = Source(history, None, {"test": str(history.attrs["figure"])}, {})
    return write_page([source], lambda: [part(history, source.key)], out, form=form)


def chapters(source: Any) -> list[Part]:
    """Return the chapters of a stored history."""
    return [part(source.errors, source.key)]


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of these pages: English text = text in the language."""
    return texts_of("errormotion.record", language)


def part(ds: xr.Dataset, key: str) -> Part:
    """Return the chapter of a history."""
    figure, machine = str(ds.attrs["figure"]), str(ds.attrs["machine"])
    notes: list[Block] = [Text(note, "note") for note in ds.attrs["notes"] if note]
    left_out = [str(each) for each in ds.attrs["left_out"] if each]
    if left_out:
        rows = [[each] for each in left_out[:MAX_ROWS]]
        notes.append(Table(f"{len(left_out)} runs left out", ["run and reason"], rows, numeric=False))
    tables: list[Block] = [*_steps(ds), *_events(ds)]
    blocks: list[Section] = [
        Section("history", "Values over time", [_values_figure(ds, key), *tables]),
        Section("control", "Control chart", [_chart_figure(ds, key), _ranges_figure(ds, key)]),
        Section("values", "Values", [_values(ds), *notes]),
    ]
    return Part(f"{figure} of {machine} over time", _key_figures(ds), sentences(ds), blocks, kind="History")


def _key_figures(ds: xr.Dataset) -> list[KeyFigure]:
    factor, unit = field_of(ds)
    last = estimate(factor * float(ds["value"][-1]), factor * float(ds["expanded_uncertainty"][-1]))
    per_year = f"{unit or 1}/year"
    trend, low, high = (factor * float(ds[name]) for name in ("trend", "trend_low", "trend_high"))
    slope = estimate(trend, (high - low) / 2, reason="fewer than three times")
    coverage = f"{100 * float(ds.attrs['coverage']):.0f} % interval ± {slope.uncertainty}" if slope.uncertainty else ""
    return [
        KeyFigure("Last value", last, unit, date(ds, float(ds["time"][-1]))),
        KeyFigure("Trend", Cell(slope.text, reason=slope.reason), per_year, coverage),
        KeyFigure("Steps", Cell(str(ds.sizes["step"])), "", f"of {ds.sizes['run']} runs"),
        KeyFigure("Outside the limits", Cell(f"{ds['outside'].values.sum():.0f}"), "", "3 standard deviations"),
    ]


def _days(ds: xr.Dataset, seconds: Array) -> Array:
    """Return times of a history in days since 1970, the unit of date axes."""
    start = instant(str(ds.attrs["start"])) or datetime.fromtimestamp(0, UTC)
    days: Array = (start.timestamp() + seconds) / 86400.0
    return days


def _axes(drawing: Drawing, ds: xr.Dataset, label: str) -> Axes:
    wide, high = drawing.get_size_inches()
    axes = drawing.add_axes((0.62 / wide, 0.42 / high, (wide - 0.72) / wide, (high - 0.87) / high))
    locator: Any = AutoDateLocator(minticks=4, maxticks=9)  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(locator)
    formats = ["%Y", "%Y-%m", "%m-%d", "%H:%M", "%H:%M", "%H:%M:%S"]  # the same in every language
    axes.xaxis.set_major_formatter(
        ConciseDateFormatter(locator, formats=formats, zero_formats=formats, show_offset=False)  # type: ignore[no-untyped-call]
    )
    axes.set_ylabel(label)
    t = ds["time"].values
    margin = 0.02 * float(t[-1] - t[0]) or 86400.0
    axes.set_xlim(*map(float, _days(ds, np.array([t[0] - margin, t[-1] + margin]))))
    return axes


def _marks(axes: Axes, ds: xr.Dataset) -> None:
    """Draw notes as dotted lines with their numbers, and the interval of each step as a band."""
    for low, high in zip(ds["step_low"].values, ds["step_high"].values, strict=True):
        axes.axvspan(*map(float, _days(ds, np.array([low, high]))), color=VERMILLION, alpha=0.18, linewidth=0)
    for k, *_ in version_changes(ds):
        axes.axvline(*map(float, _days(ds, ds["time"].values[[k]])), color=BLACK, linewidth=0.9, linestyle=(0, (4, 2)))
    low, high = ds["time"].values[[0, -1]]
    inside = [k for k, t in enumerate(ds["event_time"].values) if low <= t <= high]
    for k, when in zip(inside, map(float, _days(ds, ds["event_time"].values[inside])), strict=True):
        axes.axvline(when, color=PURPLE, linewidth=0.9, linestyle=(0, (1.5, 1.5)))
        axes.annotate(
            str(k + 1),
            (when, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, 2),
            textcoords="offset points",
            color=PURPLE,
            ha="center",
        )


def _pieces(ds: xr.Dataset) -> list[slice]:
    """Return the values between two steps."""
    bounds = [0, *np.searchsorted(ds["time"].values, ds["step_time"].values), ds.sizes["run"]]
    return [slice(int(first), int(last)) for first, last in pairwise(bounds)]


def _figure(ds: xr.Dataset, key: str, name: str, curves: Callable[[Axes], None], *texts: str) -> Figure:
    """Return a figure over time with curves, notes, steps and legend; ``texts`` are its caption and description."""
    unit, quantity = field_of(ds)[1], "range" if name == "ranges" else "value"

    def paint(drawing: Drawing) -> None:
        axes = _axes(drawing, ds, f"{quantity} / {unit}" if unit else quantity)
        _marks(axes, ds)
        curves(axes)
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.045), ncols=5, borderaxespad=0.0, handlelength=1.6)

    return Figure(draw(paint, f"{key}-{name}", HEIGHTS[name], WIDTH), *texts)


def _values_figure(ds: xr.Dataset, key: str) -> Figure:
    factor, _ = field_of(ds)
    when, y = _days(ds, ds["time"].values), factor * ds["value"].values
    U, fitted, half = (factor * ds[name].values for name in ("expanded_uncertainty", "fitted", "fitted_half_width"))
    outlier = ds["departing"].values > 0

    def curves(axes: Axes) -> None:
        for piece in _pieces(ds):
            # An outlier has its own parameter in the model; the line continues across it.
            kept = [k for k in range(len(y))[piece] if not outlier[k]]
            axes.fill_between(
                when[kept], (fitted - half)[kept], (fitted + half)[kept], color=GREEN, alpha=0.2, linewidth=0
            )
            axes.plot(when[kept], fitted[kept], color=GREEN, label=None if piece.start else "trend and steps")
        axes.errorbar(when, y, yerr=U, fmt="o", ms=3, lw=0.8, color=BLUE, label="value with U (k = 2)")
        if outlier.any():
            axes.plot(when[outlier], y[outlier], "D", ms=6, mfc="none", color=VERMILLION, label="outlier")
        if ds.sizes["step"]:
            axes.fill_between([], [], color=VERMILLION, alpha=0.18, label="time of a step")
        if version_changes(ds):
            axes.plot([], [], color=BLACK, linewidth=0.9, linestyle=(0, (4, 2)), label="version of the method")
        if ds.sizes["event"]:
            axes.plot([], [], color=PURPLE, linestyle=(0, (1.5, 1.5)), label="note")

    caption = (
        "Values with expanded uncertainty (k = 2); trend with steps and its "
        f"{100 * float(ds.attrs['coverage']):.0f} % interval. Red: interval of the time of each step. Numbers refer to "
        "the notes below."
    )
    words = f"{ds.sizes['run']} values over time, trend {trend_text(ds)}, {ds.sizes['step']} steps"
    return _figure(ds, key, "values", curves, caption, words)


def _chart_figure(ds: xr.Dataset, key: str) -> Figure:
    factor, _ = field_of(ds)
    when, y = _days(ds, ds["time"].values), factor * ds["value"].values
    centre, low, high = (factor * ds[name].values for name in ("centre", "lower_limit", "upper_limit"))
    out = ds["outside"].values > 0

    def curves(axes: Axes) -> None:
        for piece in _pieces(ds):
            named = piece.start == 0
            axes.plot(when[piece], centre[piece], color=GREEN, lw=0.9, label="centre" if named else None)
            for limit, label in ((low, "limits" if named else None), (high, None)):
                axes.plot(when[piece], limit[piece], color=BLACK, lw=0.8, ls=(0, (5, 2)), label=label)
        axes.plot(when, y, "o-", ms=3, lw=0.6, color=BLUE, label="value")
        if out.any():
            axes.plot(when[out], y[out], "o", ms=6.5, mfc="none", color=VERMILLION, label="outside")

    caption = (
        "Individual values with control limits at three standard deviations from the centre, which result from the "
        "reproducibility (moving ranges; wider where runs are alike) and the stated uncertainty of each run. Centre "
        "and limits are determined again after each step."
    )
    words = f"Control chart of {ds.sizes['run']} values, {out.sum():.0f} outside"
    return _figure(ds, key, "chart", curves, caption, words)


def _ranges_figure(ds: xr.Dataset, key: str) -> Figure:
    factor, _ = field_of(ds)
    when = _days(ds, ds["time"].values)
    ranges, limit = (factor * ds[name].values for name in ("moving_range", "range_limit"))

    def curves(axes: Axes) -> None:
        axes.plot(when, limit, color=BLACK, lw=0.8, ls=(0, (5, 2)), label="limit")
        axes.plot(when, ranges, "o-", ms=3, lw=0.6, color=BLUE, label="moving range")
        axes.set_ylim(bottom=0)

    caption = (
        "Moving ranges: absolute difference of each value from the previous one, with its upper limit. Ranges across a "
        "step are omitted."
    )
    words = f"Moving ranges of {ds.sizes['run']} values"
    return _figure(ds, key, "ranges", curves, caption, words)


def _steps(ds: xr.Dataset) -> list[Table]:
    rows: list[Sequence[Cell | str]] = []
    for k in range(ds.sizes["step"]):
        size = sized(ds, float(ds["step_size"][k]), float(ds["step_half_width"][k]))
        times = [date(ds, float(ds[f"step_{name}"][k])) for name in ("time", "low", "high")]
        event = str(ds["step_event"].values[k]) or "no note"
        rows.append([times[0], f"{times[1]} to {times[2]}", size, f"{float(ds['step_p'][k]):.2g}", event])
    head = ["about", "between (UTC)", "size, 95 %", "p", "noted"]
    return (
        [Table("Steps, with the notes within the time interval of the step", head, rows, numeric=False)] if rows else []
    )


def _events(ds: xr.Dataset) -> list[Table]:
    rows: list[Sequence[Cell | str]] = []
    for k in range(ds.sizes["event"]):
        texts = [str(ds[f"event_{name}"].values[k]) for name in ("text", "by", "run")]
        rows.append([str(k + 1), date(ds, float(ds["event_time"][k])), *texts])
    head = ["", "time (UTC)", "note", "by", "run"]
    return [Table("Notes on the machine and its runs", head, rows, numeric=False)] if rows else []


def _values(ds: xr.Dataset) -> Table:
    factor, unit = field_of(ds)
    rows: list[Sequence[Cell | str]] = []
    first = max(0, ds.sizes["run"] - MAX_ROWS)
    for k in range(first, ds.sizes["run"]):
        value = estimate(factor * float(ds["value"][k]), factor * float(ds["expanded_uncertainty"][k]))
        remarks = [word for name, word in (("outside", "outside"), ("departing", "outlier")) if ds[name][k]]
        remarks += [version for changed, _, version in version_changes(ds) if changed == k]
        started, run = date(ds, float(ds["time"][k])), str(ds["run"].values[k])
        rows.append([started, run, value.text, value.uncertainty, ", ".join(remarks)])
    caption = f"Values in {unit}" if unit else "Values"
    if first:
        caption += f", the newest {MAX_ROWS} of {ds.sizes['run']}"
    return Table(caption, ["started (UTC)", "run", "value", "U (k = 2)", "remark"], rows, numeric=False)
