"""The chapter of a crossbeam scan campaign: six thermal errors of an axis over time and position."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from errormotion.methods.crossbeam_scan.report import quality, registration, setup_drawing
from errormotion.methods.crossbeam_scan.report.view import AXES, Campaign, after, at_y, campaign, millimetres, positions
from errormotion.report import budget
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import Block, Cell, KeyFigure, Part, Source, Text, estimate
from errormotion.report.elements import (
    PROVENANCE,
    Budget,
    Chapter,
    Column,
    Curves,
    KeyFigures,
    Map,
    On,
    Own,
    Section,
    Spans,
    Table,
)
from errormotion.report.elements.chapter import written
from errormotion.report.fields import unit_of
from errormotion.report.text import fixed, integer, listed

SIX = tuple(Column(name, reason="reason") for name in FREEDOMS)


def part(source: Source, key: str) -> Part:
    """Return the chapter of one campaign; ``key`` distinguishes the identifiers of its figures."""
    seen = campaign(source.errors)
    planned, made = quality.made(seen)
    lost = quality.lost(seen) or "none missing, none refused"
    count = KeyFigure("registrations made", Cell(integer(made)), f"of {integer(planned)}", lost)
    found = CHAPTER.made(source, key)
    return replace(found, key_figures=[*found.key_figures, count])


def _sorted(errors: xr.Dataset) -> xr.Dataset | None:
    """Return a campaign with increasing positions; None without a warm result."""
    seen = campaign(errors)
    if not seen.known[seen.warm].any():
        return None
    return errors.isel(position=np.argsort(seen.position, kind="stable"))


def _several(cycles: int, artefacts: int, errors: xr.Dataset) -> xr.Dataset | None:
    """Return a sorted campaign with at least these numbers of warm cycles and artefacts; else None."""
    seen = campaign(errors)
    return _sorted(errors) if seen.warm.size >= cycles and seen.position.size >= artefacts else None


def _last(errors: xr.Dataset) -> xr.Dataset | None:
    """Return the last cycle with a result, and its time in words."""
    found, seen = _sorted(errors), campaign(errors)
    if found is None:
        return None
    k = next(int(k) for k in seen.warm[::-1] if seen.known[k].any())
    return found.isel(time=k).assign_attrs(cycle=after(seen.time[k]))


def _warm(errors: xr.Dataset) -> xr.Dataset | None:
    """Return the warm cycles."""
    seen = campaign(errors)
    return errors.isel(time=seen.warm) if seen.shown() is not None else None


def _at(errors: xr.Dataset) -> Sequence[int] | None:
    """Return the indices of the registration that is shown, along the dims of the errors."""
    place = campaign(errors).shown()
    return None if place is None else [place[AXES.index(dim)] for dim in errors.em.dims]


def _where(errors: xr.Dataset, dims: Sequence[str], index: Sequence[int]) -> str:
    at = dict(zip(dims, index, strict=True))
    return f"at {campaign(errors).where(at['time'], at['position'])} of warm-up"


def _position(errors: xr.Dataset, dims: Sequence[str], index: Sequence[int]) -> str:  # noqa: ARG001 - one dim
    return f"{millimetres(positions(errors)[index[0]])} mm"


def _known(source: Source, key: str) -> list[Block]:  # noqa: ARG001 - a text has no identifiers
    return [] if _sorted(source.errors) is not None else [Text("No scan has a valid result.", "warning")]


def _frame(source: Source, key: str) -> list[Block]:  # noqa: ARG001 - a text has no identifiers
    attributes = source.errors.attrs
    point = ", ".join(fixed(1e3 * float(value), 3) for value in np.atleast_1d(attributes["functional_point"]))
    if campaign(source.errors).shown() is None:
        return [Text("No value is known.", "warning")]
    return [
        Text(
            f"Functional point ({point}) mm in the frame '{attributes.get('frame', 'not stated')}'. Pose and "
            "lever have one error for all values; the cold scan of an artefact has one for all its warm scans. "
            "Differences take this correlation into account. The budget contains the named sources only.",
            "note",
        )
    ]


def _summary(source: Source) -> list[str]:
    seen = campaign(source.errors)
    warm = seen.warm
    if not (warm.size and seen.known[warm].any()):
        return ["No scan could be registered: there is no thermal error to report.", *_holes(seen)]
    words = [_procedure(seen)]
    extremes = {i: found for i in range(3) if (found := seen.extreme(i)) is not None}
    largest = max(extremes, key=lambda i: abs(extremes[i].value), default=None)
    at = None if largest is None else seen.largest(largest)
    if largest is not None and at is not None:
        name, (unit, size) = seen.names[FREEDOMS[largest]], unit_of(largest)
        value = written(estimate(extremes[largest].value / size, extremes[largest].expanded / size), unit)
        words.append(f"The largest displacement is {name}: {value} ({seen.where(*at)}).")
        words += _last_change(seen, largest, at[1])
    words += _holes(seen)
    words += [text.text for text in quality.stability(source, "") if text.kind == "warning"]
    if largest is not None and at is not None and "influence" in seen.errors:
        source_of = budget.largest(seen.errors.isel(time=at[0], position=at[1]), FREEDOMS[largest])
        if source_of:
            name = seen.names[FREEDOMS[largest]]
            words.append(f"The largest share in the variance of that {name}: {source_of[0]}, {source_of[1]}.")
    unseen = [seen.names[name] for i, name in enumerate(FREEDOMS) if not np.isfinite(seen.values[..., i]).any()]
    if unseen:
        words.append(f"Not observed by this test: {listed(unseen)}. It is reported as unknown, not as zero.")
    return words


def _procedure(seen: Campaign) -> str:
    n, position = seen.position.size, np.sort(seen.position)
    positions = f"one artefact at {at_y(position[0])}"
    if n > 1:
        positions = f"{n} artefacts from {at_y(position[0])} to {at_y(position[-1])}"
    times = seen.time[seen.warm]
    cycles = f"once, after {after(times[0])} of warm-up"
    if times.size > 1:
        cycles = f"{times.size} times between {after(times[0])} and {after(times[-1])} of warm-up"
    return (
        f"A line profiler scanned {positions} cold and then {cycles}; each warm scan was registered onto the cold one."
    )


def _last_change(seen: Campaign, i: int, artefact: int) -> list[str]:
    """Return the change of the largest error between the last two cycles."""
    last = [int(k) for k in seen.warm if math.isfinite(seen.values[k, artefact, i])][-2:]
    if len(last) < 2:
        return []
    weights = np.zeros(seen.time.size)
    weights[last] = -1.0, 1.0
    combined = seen.errors[[*FREEDOMS, "covariance", *(["influence"] if "influence" in seen.errors else [])]]
    change = combined.em.combine(weights, "time")
    value = float(change.value.isel(position=artefact, dof=i))
    variance = float(change.covariance.isel(position=artefact, dof=i, dof_=i))
    unit, size = unit_of(i)
    expanded = 2 * math.sqrt(variance) if variance >= 0 else math.nan
    state = "still changing" if abs(value) > expanded else "steady within the uncertainty"
    if not math.isfinite(expanded) or expanded == 0:
        state = "changing"
    cell = written(estimate(value / size, expanded / size), unit)
    times = f"between {after(seen.time[last[0]])} and {after(seen.time[last[1]])}"
    return [f"At the end of the test it is {state} there: {cell} {times}."]


def _holes(seen: Campaign) -> list[str]:
    by_reason: dict[str, list[str]] = {}
    for k in seen.warm:
        for j in np.flatnonzero(~seen.known[k]):
            by_reason.setdefault(str(seen.reason[k, j]), []).append(seen.where(int(k), int(j)))
    words = []
    for reason, places in by_reason.items():
        shown = "; ".join(places[:3]) + (f"; and {len(places) - 3} more" if len(places) > 3 else "")
        words.append(f"No value at {shown}: {reason}.")
    return words[:6] + ([f"{len(words) - 6} further reasons are listed under quality."] if len(words) > 6 else [])


LAST = (
    "The six errors in the last cycle, {cycle} of warm-up: those of the carriage at the functional point, actual minus "
    "commanded. After ±: expanded uncertainty, k = 2. All cycles are in the dataset."
)
SPANS = "Span of the six errors over the warm cycles and their expanded uncertainty, k = 2."
SURFACES = Map("The six thermal errors over warm-up time and position of the axis.", x="time", y="position")
ALONG = Curves(
    "The six thermal errors along the axis, by warm-up time.",
    over="position",
    columns=3,
    most=10,
    smooth=("smooth_position", "place"),
)
OVER_TIME = Curves(
    "The six thermal errors over time, by position.",
    over="time",
    columns=3,
    most=10,
    smooth=("smooth_time", "moment"),
    at="scan_time",
)

CHAPTER = Chapter(
    "Thermal errors of the {component} axis by crossbeam scan",
    (
        KeyFigures(signed=True),
        _summary,
        Section(
            "errors",
            "The six errors over time and position",
            (
                Own(_known),
                On(lambda errors: _several(2, 2, errors), (SURFACES,)),
                On(lambda errors: _several(1, 2, errors), (ALONG,)),
                On(lambda errors: _several(2, 1, errors), (OVER_TIME,)),
                Table(LAST, SIX, over="position", of=_last, place=_position),
            ),
        ),
        Section("registration", "One registration", (Own(registration.blocks),)),
        Section("setup", "Set-up", (Own(setup_drawing.blocks),)),
        Section("stability", "Cold repeat and artefacts", (Own(quality.stability), *quality.REPEATS)),
        Section(
            "uncertainty",
            "Uncertainty",
            (
                On(_warm, (Spans(SPANS),)),
                Budget(_at, _where, noise="noise of the warm scan, independent from scan to scan"),
                Own(_frame),
            ),
        ),
        Section("quality", "Quality of the registrations", (Own(quality.counts), *quality.TABLES, Own(quality.drift))),
        PROVENANCE,
    ),
)
