"""The page of a history: values with trend and steps, control chart, moving ranges, notes."""

from __future__ import annotations

from collections.abc import Sequence
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
from errormotion.record.text import date, field_of, sentences, sized, trend_text
from errormotion.report.canvas import BLACK, BLUE, GREEN, PURPLE, VERMILLION, WIDTH, draw
from errormotion.report.document import Block, Cell, Figure, KeyFigure, Part, Section, Source, Table, Text, estimate
from errormotion.report.page.language import texts_of
from errormotion.report.write import PLAIN, Form, write_page

HEIGHTS = {"values": 3.1, "chart": 2.5, "ranges": 1.9}
"""Of the figures, inches."""
MOST_ROWS = 200
"""Rows of the table of values; of more, the newest."""


def write(history: xr.Dataset, out: Path, form: Form = PLAIN) -> Path:
    """Write the page of a history; an older one is replaced in one step."""
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
        rows = [[each] for each in left_out[:MOST_ROWS]]
        notes.append(Table(f"{len(left_out)} runs are left out", ["run and reason"], rows, numeric=False))
    tables: list[Block] = [*_steps(ds), *_events(ds)]
    blocks: list[Section] = [
        Section("course", "Course", [_values_figure(ds, key), *tables]),
        Section("control", "Control chart", [_chart_figure(ds, key), _ranges_figure(ds, key)]),
        Section("values", "Values", [_values(ds), *notes]),
    ]
    return Part(f"{figure} of {machine} over time", _key_figures(ds), sentences(ds), blocks, kind="History")


def _key_figures(ds: xr.Dataset) -> list[KeyFigure]:
    factor, unit = field_of(ds)
    last = estimate(factor * float(ds["value"][-1]), factor * float(ds["expanded_uncertainty"][-1]))
    per_year = unit + "/year"
    trend, low, high = (factor * float(ds[name]) for name in ("trend", "trend_low", "trend_high"))
    slope = estimate(trend, (high - low) / 2, reason="fewer than three times")
    coverage = f"{100 * float(ds.attrs['coverage']):.0f} % interval ± {slope.uncertainty}" if slope.uncertainty else ""
    return [
        KeyFigure("Last value", last, unit, date(ds, float(ds["time"][-1]))),
        KeyFigure("Trend", Cell(slope.text, reason=slope.reason), per_year, coverage),
        KeyFigure("Steps", Cell(str(ds.sizes["step"])), "", f"of {ds.sizes['run']} runs"),
        KeyFigure("Outside of the limits", Cell(f"{ds['outside'].values.sum():.0f}"), "", "3 standard deviations"),
    ]


def _days(ds: xr.Dataset, seconds: Array) -> Array:
    """Return times of a history in days since 1970, as axes of dates hold them."""
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


def _legend(axes: Axes) -> None:
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.045), ncols=5, borderaxespad=0.0, handlelength=1.6)


def _label(ds: xr.Dataset) -> str:
    unit = field_of(ds)[1]
    return f"value / {unit}" if unit else "value"


def _values_figure(ds: xr.Dataset, key: str) -> Figure:
    factor, _ = field_of(ds)
    when, y = _days(ds, ds["time"].values), factor * ds["value"].values
    U, fitted, half = (factor * ds[name].values for name in ("expanded_uncertainty", "fitted", "fitted_half_width"))
    alone = ds["departing"].values > 0
    bounds = [0, *np.searchsorted(ds["time"].values, ds["step_time"].values), len(y)]

    def paint(drawing: Drawing) -> None:
        axes = _axes(drawing, ds, _label(ds))
        _marks(axes, ds)
        for first, last in pairwise(bounds):
            piece = slice(int(first), int(last))
            # A run that departs alone has a parameter of its own: the line goes on across it.
            kept = [k for k in range(len(y))[piece] if not alone[k]]
            axes.fill_between(
                when[kept], (fitted - half)[kept], (fitted + half)[kept], color=GREEN, alpha=0.2, linewidth=0
            )
            axes.plot(when[kept], fitted[kept], color=GREEN, label="trend and steps" if first == 0 else None)
        axes.errorbar(when, y, yerr=U, fmt="o", ms=3, lw=0.8, color=BLUE, label="value with U (k = 2)")
        if alone.any():
            axes.plot(when[alone], y[alone], "D", ms=6, mfc="none", color=VERMILLION, label="departs alone")
        if ds.sizes["step"]:
            axes.fill_between([], [], color=VERMILLION, alpha=0.18, label="time of a step")
        if ds.sizes["event"]:
            axes.plot([], [], color=PURPLE, linestyle=(0, (1.5, 1.5)), label="note")
        _legend(axes)

    coverage = f"{100 * float(ds.attrs['coverage']):.0f} %"
    return Figure(
        draw(paint, f"{key}-values", HEIGHTS["values"], WIDTH),
        f"Values with their expanded uncertainty (k = 2), and trend with steps with its {coverage} interval. Red: "
        "the interval of the time of each step. The numbers are those of the notes below.",
        f"{ds.sizes['run']} values over time, trend {trend_text(ds)}, {ds.sizes['step']} steps",
    )


def _chart_figure(ds: xr.Dataset, key: str) -> Figure:
    factor, _ = field_of(ds)
    when, y = _days(ds, ds["time"].values), factor * ds["value"].values
    centre, low, high = (factor * ds[name].values for name in ("centre", "lower_limit", "upper_limit"))
    out = ds["outside"].values > 0
    bounds = [0, *np.searchsorted(ds["time"].values, ds["step_time"].values), len(y)]

    def paint(drawing: Drawing) -> None:
        axes = _axes(drawing, ds, _label(ds))
        _marks(axes, ds)
        for first, last in pairwise(bounds):
            piece = slice(int(first), int(last))
            shown = first == 0
            axes.plot(when[piece], centre[piece], color=GREEN, lw=0.9, label="centre" if shown else None)
            for limit, label in ((low, "limits"), (high, None)):
                axes.plot(
                    when[piece], limit[piece], color=BLACK, lw=0.8, ls=(0, (5, 2)), label=label if shown else None
                )
        axes.plot(when, y, "o-", ms=3, lw=0.6, color=BLUE, label="value")
        if out.any():
            axes.plot(when[out], y[out], "o", ms=6.5, mfc="none", color=VERMILLION, label="outside")
        _legend(axes)

    return Figure(
        draw(paint, f"{key}-chart", HEIGHTS["chart"], WIDTH),
        "Individual values with control limits: three standard deviations from the centre, of the reproducibility from "
        "the moving ranges and the stated uncertainty of each run. Centre and limits begin anew after a step.",
        f"Control chart of {ds.sizes['run']} values, {out.sum():.0f} outside",
    )


def _ranges_figure(ds: xr.Dataset, key: str) -> Figure:
    factor, unit = field_of(ds)
    when = _days(ds, ds["time"].values)
    ranges, limit = (factor * ds[name].values for name in ("moving_range", "range_limit"))

    def paint(drawing: Drawing) -> None:
        axes = _axes(drawing, ds, f"range / {unit}" if unit else "range")
        _marks(axes, ds)
        axes.plot(when, limit, color=BLACK, lw=0.8, ls=(0, (5, 2)), label="limit")
        axes.plot(when, ranges, "o-", ms=3, lw=0.6, color=BLUE, label="moving range")
        axes.set_ylim(bottom=0)
        _legend(axes)

    return Figure(
        draw(paint, f"{key}-ranges", HEIGHTS["ranges"], WIDTH),
        "Moving ranges: difference of each value from the one before, with its upper limit. A range across a step is "
        "left out.",
        f"Moving ranges of {ds.sizes['run']} values",
    )


def _steps(ds: xr.Dataset) -> list[Table]:
    rows: list[Sequence[Cell | str]] = []
    for k in range(ds.sizes["step"]):
        size = sized(ds, float(ds["step_size"][k]), float(ds["step_half_width"][k]))
        times = [date(ds, float(ds[f"step_{name}"][k])) for name in ("time", "low", "high")]
        rows.append([times[0], f"{times[1]} to {times[2]}", size, f"{float(ds['step_p'][k]):.2g}", _event(ds, k)])
    head = ["about", "between (UTC)", "size, 95 %", "p", "noted"]
    return [Table("Steps, with the notes within the interval of their time", head, rows, numeric=False)] if rows else []


def _event(ds: xr.Dataset, k: int) -> str:
    return str(ds["step_event"].values[k]) or "nothing"


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
    first = max(0, ds.sizes["run"] - MOST_ROWS)
    for k in range(first, ds.sizes["run"]):
        value = estimate(factor * float(ds["value"][k]), factor * float(ds["expanded_uncertainty"][k]))
        remarks = [word for name, word in (("outside", "outside"), ("departing", "departs alone")) if ds[name][k]]
        rows.append(
            [
                date(ds, float(ds["time"][k])),
                str(ds["run"].values[k]),
                value.text,
                value.uncertainty,
                ", ".join(remarks),
            ]
        )
    caption = f"Values in {unit}" if unit else "Values"
    if first:
        caption += f", the newest {MOST_ROWS} of {ds.sizes['run']}"
    return Table(caption, ["started (UTC)", "run", "value", "U (k = 2)", "remark"], rows, numeric=False)
