"""Chapter of a warm-up with probed balls: errors and temperatures, balls, residuals, normals, sensors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import xarray as xr

from errormotion.estimation.extremes import Largest
from errormotion.methods.normal_vector.report import drawings
from errormotion.methods.normal_vector.report.view import MISSING, MOVED, UNDETERMINED, WRONG, Probing, probing
from errormotion.methods.normal_vector.schema import flag_text
from errormotion.report import budget, provenance, quality
from errormotion.report.budget import FREEDOMS
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
    estimate,
    or_dash,
)
from errormotion.report.drawings import timeline
from errormotion.report.drawings.series import commanded_speed, events
from errormotion.report.parts import sensors
from errormotion.report.parts.generic import unit_at
from errormotion.report.text import finite, fixed, integer, listed, significant

_TILT = (
    "The position of the tip in the spindle is constant. A tilt of the spindle relative to the last axis therefore "
    "displaces all balls equally: it is part of the displacements, and of no rotation. The rotations are those of the "
    "frame of axes relative to the table."
)
_TOUCHES = "touches of the cycle itself"
_KINDS = (
    (MISSING, "missing"),
    (WRONG, "outliers"),
    (MOVED, "of a ball that had moved"),
    (UNDETERMINED, "of a cycle that is not determined"),
)


def part(source: Source, key: str) -> Part:
    """Return the chapter of one result; ``key`` makes the identifiers of its figures unique."""
    errors = source.errors
    seen = probing(errors, source.raw)
    found = sensors.of_dataset(errors, source)
    balls = (seen.balls, seen.centre[0]) if len(seen.centre) else None
    return Part(
        "Thermal errors by probing of balls",
        _key_figures(seen),
        _summary(source, seen, found),
        [
            Section("errors", "Errors and temperatures", errors_over_time(source, f"{key}-errors", seen)),
            Section("balls", "Balls", [drawings.balls(seen, f"{key}-balls"), _balls(seen)]),
            Section("residuals", "Touches and residuals", _residuals(seen, f"{key}-residuals")),
            Section("normals", "Published normals compared with the fit", _normals(seen, f"{key}-normals")),
            Section("sensors", "Temperature sensors", sensors.blocks(found, f"{key}-sensors", balls)),
            Section("uncertainty", "Uncertainty", _uncertainty(errors, seen)),
            Section("quality", "Data quality", _quality(source)),
            Section("provenance", "Provenance", provenance.blocks(source)),
        ],
    )


def _strongest(errors: xr.Dataset, first: int) -> Largest | None:
    """Return the largest displacement (0) or rotation (3) by its known freedoms; None where it is always zero."""
    names = [name for name in FREEDOMS[first : first + 3] if np.isfinite(errors[name].values).any()]
    found = errors.em.largest(*names) if names else None
    return found if found is not None and found.value > 0 else None


def _when(seen: Probing, cycle: int) -> str:
    return f"after {fixed(seen.time[cycle] / 60, 1)} min"


def _key_figures(seen: Probing) -> list[KeyFigure]:
    figures = []
    if seen.last is not None:
        for i in (0, 1, 2, 3, 4, 5):
            unit, size = unit_at(i)
            value, sigma = seen.values[seen.last, i] / size, seen.sigma[seen.last, i] / size
            if math.isfinite(value):
                figures.append(KeyFigure(FREEDOMS[i], estimate(value, 2 * sigma), unit, _when(seen, seen.last)))
    rms = _rms(seen.residual[seen.used])
    if math.isfinite(rms):
        note = f"rms; noise of a touch: {fixed(1e6 * seen.noise, 2)} µm" if seen.by_touch else "rms"
        figures.append(KeyFigure("residual", Cell(fixed(1e6 * rms, 2)), "µm", note))
    ratio = finite(np.median, seen.loss)
    if math.isfinite(ratio):
        note = "times that of the fit, median"
        figures.append(KeyFigure("uncertainty by the published normals", Cell(fixed(ratio, 2)), "", note))
    return figures


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(finite(np.mean, values**2)))


def _summary(source: Source, seen: Probing, found: list[sensors.Sensor]) -> list[str]:
    errors = source.errors
    cycles, known = len(seen.time), int(np.isfinite(seen.values).any(axis=1).sum())
    words = [
        f"{integer(cycles)} cycles over {integer(len(seen.balls))} balls in "
        f"{fixed(float(np.ptp(seen.time)) / 60 if cycles else math.nan, 1)} min; "
        + ("all errors are known." if known == cycles else f"the errors of {integer(cycles - known)} are unknown.")
    ]
    for first, what, (unit, size) in ((0, "displacement", unit_at(0)), (3, "rotation", unit_at(3))):
        strongest = _strongest(errors, first)
        if strongest is not None:
            value = estimate(abs(strongest.value) / size, strongest.expanded / size, signed=False)
            length = f"{value.text} ± {value.uncertainty}" if value.uncertainty else value.text
            words.append(f"The largest {what} is {length} {unit}, {_when(seen, strongest.place)}.")
    speed, commanded = np.array([]), commanded_speed(source)
    if "spindle_speed" in errors:
        speed = np.abs(np.asarray(errors["spindle_speed"].values, float))
    if commanded is not None and commanded.any():
        mean = f"; the highest mean between two cycles was {integer(finite(np.max, speed))} /min"
        known = np.isfinite(speed).any()
        words.append(f"Commanded spindle speed: up to {integer(commanded.max())} /min{mean if known else ''}.")
    elif np.isfinite(speed).any():
        words.append(f"The highest mean spindle speed between two cycles was {integer(finite(np.max, speed))} /min.")
    if found:
        words.append(sensors.warmest(found))
    out = {name: int((seen.left_out == kind).sum()) for kind, name in _KINDS}
    if any(out.values()):
        counts = listed([f"{integer(count)} {name}" for name, count in out.items() if count])
        words.append(f"Excluded of {integer(seen.left_out.size)} {seen.what}: {counts}.")
    if seen.moved_balls:
        words.append(f"Moved on the table: {listed([seen.balls[i] for i in seen.moved_balls])}.")
    unseen = [name for i, name in enumerate(FREEDOMS) if not np.isfinite(seen.values[:, i]).any()]
    if unseen:
        words.append(f"Not determined: {listed(unseen)}. Reported as unknown, not as zero.")
    return words


def errors_over_time(source: Source, key: str, seen: Probing) -> list[Block]:
    """Return errors, temperatures and working parameters on one time axis, and the table of the errors."""
    errors = source.errors
    commanded = commanded_speed(source)
    names = timeline.sensor_names(errors)
    values = errors["temperature"].transpose("time", "sensor").values if names else np.empty((len(seen.time), 0))
    panels = [
        *timeline.errors(errors, source.limits),
        *timeline.temperatures(names, np.asarray(values, float)),
        *timeline.working(errors, held=True, commanded=commanded),
    ]
    if not panels:
        return [Text("The errors are unknown at all times.", "warning"), _table(errors, seen)]
    done = events(source)
    point = ", ".join(fixed(1e3 * float(value), 1) for value in np.atleast_1d(errors.attrs["functional_point"]))
    caption = (
        f"Errors of the tool side relative to the workpiece side at ({point}) mm since the cold cycle, temperatures "
        "and spindle speed on one time axis. Bands: expanded uncertainty, k = 2 (about 95 %). Mean speeds are those "
        f"since the previous cycle; the spindle stands still for probing.{timeline.events_in_words(done)}"
    )
    words = ". ".join(panel.in_words() for panel in panels)
    figure = Figure(timeline.draw(seen.time, panels, key, done), caption, f"Over time: {words}.")
    return [figure, _table(errors, seen)]


def _table(errors: xr.Dataset, seen: Probing) -> Table:
    reasons = {name: seen.reason(i) for i, name in enumerate(FREEDOMS)}
    return timeline.table(errors, "The six errors. The cold cycle is zero by definition.", reasons)


def _balls(seen: Probing) -> Block:
    if not seen.balls:
        return Text("The result lists no balls.", "note")
    rows: list[list[Cell | str]] = []
    size = np.where(seen.well_known, np.linalg.norm(seen.displacement, axis=2), np.nan)
    for i, name in enumerate(seen.balls):
        known = np.flatnonzero(seen.well_known[:, i])
        lost = Cell("—", reason="never determined")
        if not known.size:
            rows.append([name, *[lost] * 7, "no cycle"])
            continue
        k, largest = int(known[-1]), finite(np.max, size[:, i])
        rows.append(
            [
                name,
                *(fixed(1e3 * v, 3) for v in seen.centre[known[0], i]),
                # The cold and the last centre have independent uncertainties from their own touches.
                *(
                    estimate(1e6 * v, 2e6 * math.hypot(a, b), reason="not determined")
                    for v, a, b in zip(
                        seen.displacement[k, i], seen.centre_u[k, i], seen.centre_u[known[0], i], strict=True
                    )
                ),
                fixed(1e6 * largest, 1),
                f"from cycle {integer(int(np.argmax(seen.moved[:, i])))}" if seen.moved[:, i].any() else "no",
            ]
        )
    return Table(
        "Apparent centres of the balls: in the cold cycle, and displacement in the last cycle in which they were "
        "determined. After ±: expanded uncertainty, k = 2.",
        ["ball", "x / mm", "y / mm", "z / mm", "x / µm", "y / µm", "z / µm", "largest / µm", "moved on the table"],
        rows,
        [("", 1), ("cold", 3), ("displacement", 4), ("", 1)],
    )


def _residuals(seen: Probing, key: str) -> list[Block]:
    found: list[Block] = [drawings.residuals(seen, key)]
    if not seen.balls or not seen.left_out.size:
        return found
    rows: list[list[Cell | str]] = []
    every = list(range(len(seen.balls)))
    for name, own in [*((seen.balls[i], [i]) for i in every), ("all", every)]:
        kind, residual = seen.left_out[:, own], seen.residual[:, own]
        kept = residual[kind == 0]
        rows.append(
            [
                name,
                integer(int((kind == 0).sum())),
                *(integer(int((kind == code).sum())) for code, _ in _KINDS),
                or_dash(fixed(1e6 * _rms(kept), 3), "none was used"),
                or_dash(fixed(1e6 * finite(np.max, np.abs(kept)), 3), "none was used"),
            ]
        )
    found.append(
        Table(
            f"The {seen.what} by ball: used ones with their residuals, and those that are missing, outliers, of a ball "
            "that had moved, or of a cycle that is not determined.",
            ["ball", "used", "missing", "outliers", "ball moved", "cycle lost", "rms / µm", "largest / µm"],
            rows,
            [("", 1), (seen.what, 5), ("residual", 2)],
        )
    )
    noise = fixed(1e6 * seen.noise, 3)
    found.append(Text(f"Standard deviation of a touch used in the identification: {noise} µm."))
    found += _flagged(seen)
    return found


def _flagged(seen: Probing) -> list[Block]:
    """Return the flags that the probe set."""
    if seen.flag is None:
        return []
    if not seen.flag.any():
        return [Text("The probe flagged no touch.")]
    words = []
    for code in np.unique(seen.flag[seen.flag > 0]):
        where = np.argwhere(seen.flag == code)
        first = f"the first of {seen.balls[where[0, 1]]} in cycle {where[0, 0]}"
        words.append(f"{flag_text(code)}: {integer(len(where))} ({first})")
    return [Text(f"Flagged by the probe: {'; '.join(words)}.", "warning")]


def _normals(seen: Probing, key: str) -> list[Block]:
    found: list[Block] = []
    if seen.by_normals:
        found.append(
            Text(
                "The result of this page is that of the published normals, not that of the fit of all touches.", "note"
            )
        )
    figure = drawings.normals(seen, key)
    found.append(figure)
    if isinstance(figure, Text):
        return found
    rows: list[list[Cell | str]] = []
    for i, name in enumerate(FREEDOMS):
        unit, size = unit_at(i)
        reason = seen.reason(i)
        difference = _rms((seen.normals[:, i] - seen.values[:, i]) / size) if not seen.by_normals else math.nan
        own = "the result is that of the normals" if seen.by_normals else reason
        last = np.flatnonzero(np.isfinite(seen.normals[:, i]))
        value = (
            estimate(seen.normals[last[-1], i] / size, 2 * seen.normals_u[last[-1], i] / size, reason=reason)
            if last.size
            else Cell("—", reason=reason)
        )
        rows.append(
            [
                name,
                unit,
                value,
                or_dash(significant(difference), own),
                *(or_dash(fixed(finite(f, seen.loss[:, i]), 2), reason) for f in (np.median, np.max)),
            ]
        )
    found.append(
        Table(
            "The published normals. Ratio: standard uncertainty by the normals over that of the fit of all touches. "
            "After ±: expanded uncertainty, k = 2.",
            ["error", "unit", "last known", "rms, minus fit", "ratio, median", "ratio, largest"],
            rows,
        )
    )
    return found


def _uncertainty(errors: xr.Dataset, seen: Probing) -> list[Block]:
    if seen.last is None:
        return [Text("No cycle determines the errors.", "warning")]
    made = budget.table(errors.isel(time=seen.last), f"in the last known cycle, {_when(seen, seen.last)}")
    own = budget.readable("independent")
    rows = [[_TOUCHES if row[0] == own else row[0], *row[1:]] for row in made.rows]
    return [
        replace(made, rows=rows),
        Text("The cold cycle is the reference of all others: the uncertainty of its touches is common to all cycles."),
        Text(_TILT, "note"),
    ]


def _quality(source: Source) -> list[Block]:
    found = [*quality.notes(source.errors), *quality.sentences(source.errors, source.raw)]
    return found or [Text("The method reported no remarks.")]
