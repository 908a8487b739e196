"""Report chapter of a monitor's log: temperatures and working parameters over time, sensors, gaps."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from errormotion.campaign.monitor.log import AXES, BINS, NUMBERS, Channel, Gap, Log, read_log
from errormotion.report import provenance
from errormotion.report.canvas import COLOURS
from errormotion.report.document import (
    Block,
    Cell,
    Figure,
    KeyFigure,
    Part,
    Section,
    Source,
    Table,
    Text,
    or_dash,
)
from errormotion.report.drawings import timeline
from errormotion.report.elements import sensors
from errormotion.report.page.language import texts_of
from errormotion.report.text import fixed, integer, listed, percent

_LISTED = 20
"""Most gaps that are listed."""
_STRIPS = 8
"""Most instruments whose missing readings are drawn."""


def texts(language: str) -> dict[str, str]:
    """Return the catalogue of these chapters: English text = text in the language."""
    return texts_of("errormotion.campaign.monitor", language)


def chapters(source: Source) -> list[Part]:
    """Return the chapter of a log."""
    log, key = read_log(source.errors), source.key
    shown = _sensors(log, source)
    chapter = Part(
        "Log of a monitor",
        _key_figures(log, shown),
        _summary(log, shown),
        [
            Section("log", "Temperatures and working parameters", [*_over_time(log, f"{key}-log"), *_numbers(log)]),
            Section("sensors", "Temperature sensors", sensors.blocks(shown, f"{key}-sensors")),
            Section("gaps", "Gaps", _gaps(log)),
            Section("provenance", "Provenance", provenance.blocks(source)),
        ],
        kind="Log",
        stated=False,
    )
    return [chapter]


def duration(seconds: float) -> str:
    """Return a duration in a suitable unit."""
    if not math.isfinite(seconds):
        return "unknown"
    for size, unit, least in ((86400.0, "days", 2.0), (3600.0, "h", 2.0), (60.0, "min", 2.0)):
        if seconds >= least * size:
            return f"{fixed(seconds / size, 1)} {unit}"
    return f"{fixed(seconds, 1)} s"


def _sensors(log: Log, source: Source) -> list[sensors.Sensor]:
    where = sensors.places(source)
    shown = []
    for channel, place, why in zip(log.temperatures, log.place, log.why, strict=True):
        reasons = listed([f"{reason} in {integer(count)} rows" for reason, count in why.items()])
        shown.append(
            sensors.Sensor(
                channel.name,
                place if np.isfinite(place).all() else where.get(channel.name, place),
                channel.first,
                channel.low,
                channel.high,
                channel.last,
                channel.known / max(log.rows, 1),
                np.stack([log.time, channel.values]),
                reasons,
            )
        )
    return shown


def _key_figures(log: Log, shown: Sequence[sensors.Sensor]) -> list[KeyFigure]:
    length, unit = duration(log.duration).rsplit(" ", 1)
    figures = [KeyFigure("duration", Cell(length), unit, f"{integer(log.rows)} rows")]
    known = [sensor for sensor in shown if math.isfinite(sensor.change)]
    if known:
        most = max(known, key=lambda sensor: abs(sensor.change))
        figures.append(KeyFigure("largest change", Cell(fixed(most.change, 1, signed=True)), "K", most.name))
        warm = max(known, key=lambda sensor: sensor.high)
        figures.append(KeyFigure("highest", Cell(fixed(warm.high, 1)), "°C", warm.name))
    speed = log.numbers.get("spindle_speed")
    if speed is not None and speed.known:
        top = max(abs(speed.low), abs(speed.high))
        figures.append(KeyFigure("highest speed", Cell(integer(top)), "/min", "spindle"))
    count = sum(map(len, log.gaps.values()))
    figures.append(KeyFigure("gaps", Cell(integer(count)), "", f"of {integer(len(log.gaps))} instruments"))
    return figures


def _summary(log: Log, shown: list[sensors.Sensor]) -> list[str]:
    words = [f"{integer(log.rows)} rows over {duration(log.duration)}, one every {duration(log.interval)}."]
    if shown:
        words.append(sensors.warmest(shown))
    silent = [name for name, gaps in log.gaps.items() if gaps]
    if silent:
        counts = listed([f"{name} ({integer(len(log.gaps[name]))})" for name in silent])
        words.append(f"Instruments that did not answer at times, with the number of gaps: {counts}.")
    else:
        words.append("Every instrument answered in all rows.")
    if log.missing:
        lost = sum(gap.end - gap.start for gap in log.missing)
        where = "one interval" if len(log.missing) == 1 else f"{integer(len(log.missing))} intervals"
        words.append(f"No rows were written in {where}, {duration(lost)} in total.")
    return words


def _over_time(log: Log, key: str) -> list[Block]:
    names = [channel.name for channel in log.temperatures]
    values = np.stack([c.values for c in log.temperatures], axis=1) if names else np.empty((log.time.size, 0))
    panels = timeline.temperatures(names, values)
    for name, title, unit, size in NUMBERS:
        channel = log.numbers.get(name)
        if channel is not None and channel.known and (name == "spindle_speed" or channel.high > 0):
            line = timeline.Line(title, size * channel.values, None, "#bbbbbb")
            panels.append(timeline.Panel(title, unit, [line], 0.3, strip=True))
    panels += _position(log)
    panels += [
        timeline.Panel(f"No answer: {name}", "", [timeline.Line(name, silent, None, timeline.UNKNOWN)], 0.1, strip=True)
        for name, silent in list(log.silent.items())[:_STRIPS]
        if silent.any()
    ]
    if not panels or log.time.size < 2:
        return [Text("The log contains no data to draw.", "warning")]
    words = ". ".join(panel.in_words() for panel in panels if panel.unit)
    thinned = (
        f" Reduced to {integer(BINS)} intervals; the lowest and highest value of each are drawn."
        if log.time.size != log.rows and log.rows > 2 * BINS
        else ""
    )
    red = " Red: an instrument did not answer." if any(silent.any() for silent in log.silent.values()) else ""
    caption = f"Temperatures and working parameters since the start of the log, on one time axis.{red}{thinned}"
    return [Figure(timeline.draw(log.time, panels, key), caption, f"Over time: {words}.")]


def _position(log: Log) -> list[timeline.Panel]:
    axes = [log.numbers[name] for name in AXES if name in log.numbers and log.numbers[name].known]
    if not any(channel.high > channel.low for channel in axes):
        return []
    lines = [
        timeline.Line(channel.name, 1e3 * channel.values, None, COLOURS[AXES.index(channel.name)]) for channel in axes
    ]
    return [timeline.Panel("Position", "mm", lines, 0.9)]


def _numbers(log: Log) -> list[Block]:
    """Return the table of working parameters."""
    units = {name: (title, unit, size) for name, title, unit, size in NUMBERS}
    rows: list[list[Cell | str]] = []
    for name, channel in log.numbers.items():
        title, unit, size = units.get(name, (f"Position {name}", "mm", 1e3))
        rows.append([title, unit, *_spans(channel, size), percent(channel.known / max(log.rows, 1))])
    if not rows:
        return [Text("The bench had no controller: working parameters were not recorded.", "note")]
    return [Table("Working parameters.", ["parameter", "unit", "lowest", "mean", "highest", "last", "known"], rows)]


def _spans(channel: Channel, size: float) -> list[Cell | str]:
    never = "unknown in all rows"
    places = 0 if abs(size) == 1.0 else 1
    values = (channel.low, channel.mean, channel.high, channel.last)
    return [or_dash(fixed(size * value, places), never) for value in values]


def _gaps(log: Log) -> list[Block]:
    if not log.gaps:
        return [Text("The log lists no instruments.", "warning")]
    rows: list[list[Cell | str]] = []
    for name, gaps in log.gaps.items():
        lost = sum(gap.rows for gap in gaps)
        rows.append(
            [
                name,
                integer(len(gaps)),
                integer(lost),
                percent(lost / max(log.rows, 1)),
                duration(max(gap.end - gap.start for gap in gaps)) if gaps else "none",
                "yes" if gaps and gaps[-1].end >= log.time[-1] and log.silent[name][-1] > 0 else "no",
            ]
        )
    blocks: list[Block] = [
        Table(
            "Rows without a recent reading, by instrument. A gap ends with the next row that has a reading.",
            ["instrument", "gaps", "rows", "fraction", "longest", "no answer at the end"],
            rows,
        )
    ]
    every = [(name, gap) for name, gaps in log.gaps.items() for gap in gaps]
    every += [("no rows written", gap) for gap in log.missing]
    if every:
        blocks.append(_gap_list(sorted(every, key=lambda entry: entry[1].start)))
    return blocks


def _gap_list(every: Sequence[tuple[str, Gap]]) -> Table:
    longest = sorted(every, key=lambda entry: entry[1].start - entry[1].end)[:_LISTED]
    shown = [entry for entry in every if entry in longest]
    more = f" The {_LISTED} longest of {integer(len(every))}." if len(every) > len(shown) else ""
    rows: list[list[Cell | str]] = [
        [name, fixed(gap.start / 60, 2), fixed(gap.end / 60, 2), duration(gap.end - gap.start), integer(gap.rows)]
        for name, gap in shown
    ]
    return Table(
        f"Gaps in chronological order; times since the start of the log.{more}",
        ["instrument", "from / min", "to / min", "duration", "rows"],
        rows,
    )
