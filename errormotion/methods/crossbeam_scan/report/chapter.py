"""The chapter of a crossbeam scan campaign: six thermal errors of an axis over time and position."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import xarray as xr

from errormotion.methods.crossbeam_scan.report import drawings as crossbeam_figures
from errormotion.methods.crossbeam_scan.report import quality as crossbeam_quality
from errormotion.methods.crossbeam_scan.report import registration as crossbeam_registration
from errormotion.methods.crossbeam_scan.report import setup_drawing as crossbeam_setup
from errormotion.methods.crossbeam_scan.report.view import Campaign, after, at_y, campaign, millimetres
from errormotion.report import budget, provenance, quality
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import Block, Cell, Figure, KeyFigure, Part, Section, Source, Table, Text, estimate
from errormotion.report.fields import unit_of
from errormotion.report.text import decimals_of, fixed, integer, listed

_INDEPENDENT = "noise of the warm scan, independent from scan to scan"


def part(source: Source, key: str) -> Part:
    """Return the chapter of one campaign; ``key`` distinguishes the identifiers of its figures."""
    seen = campaign(source.errors)
    axis = str(source.errors.attrs.get("component", ""))
    return Part(
        f"Thermal errors of the {axis} axis by crossbeam scan",
        _key_figures(seen),
        _summary(seen),
        [
            Section("errors", "The six errors over time and position", _errors(seen, key)),
            Section("registration", "One registration", crossbeam_registration.blocks(seen, f"{key}-registration")),
            Section("setup", "Set-up", crossbeam_setup.blocks(seen, f"{key}-setup")),
            Section("stability", "Cold repeat and artefacts", crossbeam_quality.stability(seen)),
            Section("uncertainty", "Uncertainty", _uncertainty(seen)),
            Section("quality", "Quality of the registrations", _quality(seen, source)),
            Section("provenance", "Provenance", provenance.blocks(source)),
        ],
    )


def _value(seen: Campaign, cycle: int, artefact: int, i: int) -> Cell:
    size = unit_of(i)[1]
    reason = str(seen.reason[cycle, artefact]) or "not observed by this method"
    return estimate(seen.values[cycle, artefact, i] / size, 2 * seen.sigma[cycle, artefact, i] / size, reason=reason)


def _largest(seen: Campaign, i: int) -> Cell:
    size, largest = unit_of(i)[1], seen.extreme(i)
    if largest is None:
        return Cell("—", reason="not observed by this method")
    return estimate(largest.value / size, largest.expanded / size)


def _key_figures(seen: Campaign) -> list[KeyFigure]:
    found = []
    for i, freedom in enumerate(FREEDOMS):
        place = seen.largest(i)
        if place is not None:
            found.append(
                KeyFigure(f"largest {seen.names[freedom]}", _largest(seen, i), unit_of(i)[0], seen.where(*place))
            )
    planned, made = crossbeam_quality.made(seen)
    lost = crossbeam_quality.lost(seen) or "none missing, none refused"
    found.append(KeyFigure("registrations made", Cell(integer(made)), f"of {integer(planned)}", lost))
    return found


def _with_unit(cell: Cell, unit: str) -> str:
    return f"{cell.text} ± {cell.uncertainty} {unit}" if cell.uncertainty else f"{cell.text} {unit}"


def _summary(seen: Campaign) -> list[str]:
    warm = seen.warm
    if not (warm.size and seen.known[warm].any()):
        return ["No scan could be registered: there is no thermal error to report.", *_holes(seen)]
    words = [_procedure(seen)]
    shown = seen.shown()
    largest = max(range(3), key=lambda i: _extent(seen, i))
    at = seen.largest(largest)
    if at is not None and shown is not None:
        name = seen.names[FREEDOMS[largest]]
        value = _with_unit(_largest(seen, largest), unit_of(largest)[0])
        words.append(f"The largest displacement is {name}: {value} ({seen.where(*at)}).")
        words += _last_change(seen, largest, at[1])
    words += _holes(seen)
    words += [
        block.text for block in crossbeam_quality.stability(seen) if isinstance(block, Text) and block.kind == "warning"
    ]
    if at is not None and "influence" in seen.errors:
        found = budget.largest(seen.errors.isel(time=at[0], position=at[1]), FREEDOMS[largest])
        if found:
            words.append(
                f"The largest share in the variance of that {seen.names[FREEDOMS[largest]]}: {found[0]}, {found[1]}."
            )
    unseen = [name for i, name in enumerate(FREEDOMS) if not np.isfinite(seen.values[..., i]).any()]
    if unseen:
        names = listed([seen.names[name] for name in unseen])
        words.append(f"Not observed by this test: {names}. It is reported as unknown, not as zero.")
    return words


def _extent(seen: Campaign, i: int) -> float:
    largest = seen.extreme(i)
    return abs(largest.value) if largest is not None else -1.0


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
    cell = _with_unit(estimate(value / size, expanded / size), unit)
    times = f"between {after(seen.time[last[0]])} and {after(seen.time[last[1]])}"
    return [f"At the end of the test it is {state} there: {cell} {times}."]


def _holes(seen: Campaign) -> list[str]:
    by_reason: dict[str, list[str]] = {}
    for k in seen.warm:
        for j in np.flatnonzero(~seen.known[k]):
            by_reason.setdefault(str(seen.reason[k, j]), []).append(seen.where(int(k), int(j)))
    words = []
    for reason, positions in by_reason.items():
        shown = "; ".join(positions[:3]) + (f"; and {len(positions) - 3} more" if len(positions) > 3 else "")
        words.append(f"No value at {shown}: {reason}.")
    return words[:6] + ([f"{len(words) - 6} further reasons are listed under quality."] if len(words) > 6 else [])


def _errors(seen: Campaign, key: str) -> list[Block]:
    made: list[Figure | None] = [
        crossbeam_figures.surfaces(seen, f"{key}-surface"),
        crossbeam_figures.by_position(seen, f"{key}-position"),
        crossbeam_figures.by_time(seen, f"{key}-time"),
    ]
    if not seen.known[seen.warm].any():
        return [Text("No scan has a valid result.", "warning")]
    return [*(figure for figure in made if figure is not None), _last(seen)]


def _last(seen: Campaign) -> Table:
    cycles = [int(k) for k in seen.warm if seen.known[k].any()]
    k = cycles[-1] if cycles else seen.time.size - 1
    order = np.argsort(seen.position, kind="stable")
    return Table(
        f"The six errors in the last cycle, {after(seen.time[k])} of warm-up: those of the carriage at the functional "
        "point, actual minus commanded. After ±: expanded uncertainty, k = 2. All cycles are in the dataset.",
        ["position", *(f"{seen.names[name]} / {unit_of(i)[0]}" for i, name in enumerate(FREEDOMS))],
        [[f"{millimetres(seen.position[j])} mm", *(_value(seen, k, int(j), i) for i in range(6))] for j in order],
    )


def _uncertainty(seen: Campaign) -> list[Block]:
    place = seen.shown()
    if place is None:
        return [Text("No value is known.", "warning")]
    there = seen.errors.isel(time=place[0], position=place[1])
    point = ", ".join(fixed(1e3 * float(value), 3) for value in np.atleast_1d(seen.errors.attrs["functional_point"]))
    return [
        _spans(seen),
        _budget(there, seen.where(*place)),
        Text(
            f"Functional point ({point}) mm in the frame '{seen.errors.attrs.get('frame', 'not stated')}'. Pose and "
            "lever have one error for all values; the cold scan of an artefact has one for all its warm scans. "
            "Differences take this correlation into account. The budget contains the named sources only.",
            "note",
        ),
    ]


def _budget(there: xr.Dataset, where: str) -> Table:
    made = budget.table(there, f"at {where} of warm-up")
    rest = budget.readable("independent")
    return replace(made, rows=[[_INDEPENDENT if row[0] == rest else row[0], *row[1:]] for row in made.rows])


def _spans(seen: Campaign) -> Table:
    rows: list[list[Cell | str]] = []
    for i, freedom in enumerate(FREEDOMS):
        unit, size = unit_of(i)
        values, expanded = seen.values[seen.warm, :, i] / size, 2 * seen.sigma[seen.warm, :, i] / size
        known = np.isfinite(values)
        if not known.any():
            rows.append([seen.names[freedom], unit, *[Cell("—", reason="not observed by this method")] * 4, "0"])
            continue
        stated = expanded[np.isfinite(expanded)]
        spread = (np.median(stated), stated.max()) if stated.size else (math.nan, math.nan)
        cells = [fixed(values[known].min(), 2, signed=True), fixed(values[known].max(), 2, signed=True)]
        cells += [fixed(float(value), decimals_of(float(value), 2)) for value in spread]
        rows.append([seen.names[freedom], unit, *cells, f"{integer(known.sum())} / {integer(known.size)}"])
    return Table(
        "Span of the six errors over the warm cycles and their expanded uncertainty, k = 2.",
        ["error", "unit", "lowest", "highest", "U, median", "U, largest", "determined"],
        rows,
    )


def _quality(seen: Campaign, source: Source) -> list[Block]:
    blocks = crossbeam_quality.blocks(seen)
    counted = quality.counts(source.errors, source.raw)
    if counted:
        words = ", ".join(f"{name} {number}" for name, number in counted.items())
        blocks.append(Text(f"Counted during the measurement: {words}."))
    return blocks
