"""Quality of every registration of a crossbeam campaign, the cold repeats, and artefacts that moved."""

from __future__ import annotations

import math

import numpy as np

from errormotion.arrays import Array
from errormotion.methods.crossbeam_scan.report.view import NO_REASON, Campaign, after, at_y, trimmed
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import Block, Cell, Table, Text, estimate, or_dash
from errormotion.report.fields import field, remarks, unit_of
from errormotion.report.text import DASH, finite, fixed, integer, listed, significant

_MAX_ROWS = 240  # of single registrations; if there are more, each cycle is one row
_NOTE = (
    "Predicted: the bound that follows from the slopes of the surface and the noise stated for the sensor. By "
    "registration: the uncertainty of the registration with the noise and the jitter found in the scans. Both are "
    "standard uncertainties (k = 1) at the carriage, the worst of three directions, without pose and lever. "
    "1 arcsec = 4.848 µrad."
)
_HEAD = ("shift / nm", "rotation / µrad", "shift / nm", "rotation / µrad", "rms / µm", "points", "noise / µm")
_JITTER = ("in z / µm", "in y / µm")
_GROUPS = (("", 1), ("predicted", 2), ("by registration", 2), ("residual", 2), ("found", 1), ("line jitter", 2))


def made(seen: Campaign) -> tuple[int, int]:
    """Return the numbers of registrations planned and made."""
    known = seen.known[seen.warm]
    return known.size, int(known.sum())


def lost(seen: Campaign) -> str:
    """Return the number of missing registrations by reason; empty where none is missing."""
    holes, absent = ~seen.known[seen.warm], seen.absent[seen.warm]
    silent = holes & ~absent & (seen.reason[seen.warm] == NO_REASON)
    kinds = ((absent, "without a scan"), (holes & ~absent & ~silent, "refused"), (silent, "without a stated reason"))
    return ", ".join(f"{integer(kind.sum())} {words}" for kind, words in kinds if kind.any())


def blocks(seen: Campaign) -> list[Block]:
    """Return the method's remarks, the counts, and the table of registrations."""
    found: list[Block] = [Text(note, "warning") for note in remarks(seen.errors)]
    planned, done = made(seen)
    if not planned:
        return [*found, Text("The campaign has no warm cycle to register.", "warning")]
    words = f"{integer(done)} of {integer(planned)} registrations were made"
    if done < planned:
        words += f"; {lost(seen)}"
    found.append(Text(f"{words}.", "plain" if done == planned else "warning"))
    if done and not np.isfinite(_numbers(seen)[seen.known]).any():
        return [*found, Text("The result does not contain data on the quality of the registrations.", "note")]
    found.append(_by_scan(seen) if planned <= _MAX_ROWS else _by_cycle(seen))
    drift = _drift(seen)
    return [*found, drift] if drift is not None else found


def _numbers(seen: Campaign) -> Array:
    """Return the table's columns over (time, position, column) in their units; NaN where not known."""
    columns: list[Array] = []
    for name in ("predicted_u", "registration_u"):
        sigma = seen.get(name, "dof")
        worst = [
            np.where(np.isfinite(part).any(-1), np.nan_to_num(part).max(-1), np.nan)
            for part in (sigma[..., :3], sigma[..., 3:])
        ]
        columns += [1e9 * worst[0], 1e6 * worst[1]]
    points = seen.get("points_used")
    jitter = 1e6 * seen.get("line_jitter", "jitter")
    return np.stack(
        [*columns, 1e6 * seen.get("residual_rms"), points, 1e6 * seen.get("noise_found"), *_jitter(seen, jitter)],
        axis=-1,
    )


def _jitter(seen: Campaign, jitter: Array) -> tuple[Array, Array]:
    """Return jitter in z and in y, (time, position) each."""
    if jitter.shape[-1] != 2:
        nothing = np.full(jitter.shape[:2], np.nan)
        return nothing, nothing
    labels = [str(label) for label in seen.errors["jitter"].values] if "jitter" in seen.errors.coords else ["z", "y"]
    return jitter[..., labels.index("z") if "z" in labels else 0], jitter[
        ..., labels.index("y") if "y" in labels else 1
    ]


def _cells(numbers: Array, reason: str = "not part of this result") -> list[Cell | str]:
    shift, turn, stated, stated_turn, rms, points, noise, jitter_z, jitter_y = numbers
    words = [
        _three(shift),
        _three(turn),
        _three(stated),
        _three(stated_turn),
        fixed(rms, 3),
        integer(points),
        fixed(noise, 3),
        fixed(jitter_z, 2),
        fixed(jitter_y, 2),
    ]
    return [or_dash(word, reason) for word in words]


def _three(value: float) -> str:
    return significant(value, 3) if value < 100 else integer(value)


def _by_scan(seen: Campaign) -> Table:
    numbers = _numbers(seen)
    rows: list[list[Cell | str]] = []
    for k in seen.warm:
        rows.append([f"{after(seen.time[k])} of warm-up"])
        for j in np.argsort(seen.position, kind="stable"):
            name = at_y(seen.position[j])
            if seen.known[k, j]:
                rows.append([name, *_cells(numbers[k, j])])
            else:
                rows.append([name, Cell(DASH, reason=str(seen.reason[k, j])), *[DASH] * 8])
    return Table(
        "Quality of every registration, by warm-up time and position.",
        ["artefact", *_HEAD, *_JITTER],
        rows,
        _GROUPS,
        notes=[_NOTE],
    )


def _by_cycle(seen: Campaign) -> Table:
    numbers = _numbers(seen)
    rows: list[list[Cell | str]] = []
    for k in seen.warm:
        each = numbers[k][seen.known[k]]
        of_cycle = f"{after(seen.time[k])}: {len(each)} of {seen.position.size}"
        if not len(each):
            reasons = "; ".join(dict.fromkeys(seen.reason[k]))
            rows.append([of_cycle, Cell(DASH, reason=reasons), *[DASH] * 8])
            continue
        worst = [finite(np.min if i == 5 else np.max, column) for i, column in enumerate(each.T)]
        rows.append([of_cycle, *_cells(np.array(worst))])
    holes = [(k, j) for k in seen.warm for j in range(seen.position.size) if not seen.known[k, j]]
    by_reason: dict[str, list[str]] = {}
    for k, j in holes:
        by_reason.setdefault(str(seen.reason[k, j]), []).append(seen.where(k, j))
    notes = [
        f"{reason}: {'; '.join(positions[:6])}{' …' if len(positions) > 6 else ''}."
        for reason, positions in by_reason.items()
    ]
    return Table(
        "Quality of the registrations: the worst of each cycle (of the points: the fewest), and how many were made.",
        ["cycle", *_HEAD, *_JITTER],
        rows,
        _GROUPS,
        notes=[_NOTE, *notes],
    )


def _drift(seen: Campaign) -> Text | None:
    strain = 1e6 * seen.get("strain", "direction")
    if "strain" not in seen.errors or not np.isfinite(strain).any():
        return None
    largest = [finite(np.max, np.abs(strain[..., k])) for k in range(strain.shape[-1])]
    words = listed([f"{trimmed(fixed(value, 1))} µm/m in {axis}" for value, axis in zip(largest, "xyz", strict=False)])
    return Text(
        "The error of the axis changes during a scan: a cold and a warm surface differ by more than a rigid motion. "
        f"Drift of the profiler that was taken into account: at most {words}.",
        "note",
    )


def stability(seen: Campaign) -> list[Block]:
    """Return the result of the cold repeats and of the check for moved artefacts."""
    found: list[Block] = [*_moved(seen)]
    repeat = _repeats(seen)
    if repeat is None:
        return [*found, Text("No cold repeat was scanned: the repeatability of the cold state is not known.", "note")]
    return [*found, *repeat]


def _moved(seen: Campaign) -> list[Block]:
    if "moved" not in seen.errors or seen.errors["moved"].dims != ("position",):
        return [Text("The result does not state whether artefacts moved.", "note")]
    moved = np.nan_to_num(np.asarray(seen.errors["moved"].values, float)).astype(bool)
    if not moved.any():
        return [Text("No artefact was found to have moved on the table.")]
    since = np.full(moved.size, np.nan)
    if "moved_since" in seen.errors and seen.errors["moved_since"].dims == ("position",):
        since = np.asarray(seen.errors["moved_since"].values, float)
    warnings: list[Block] = []
    for j in np.flatnonzero(moved):
        when = f" since the scan at {after(since[j])}" if math.isfinite(since[j]) else ""
        warnings.append(
            Text(
                f"The artefact at {at_y(seen.position[j])} moved on the table{when}. From then on its values "
                "contain that movement in addition to the error of the axis.",
                "warning",
            )
        )
    return warnings


def _repeats(seen: Campaign) -> list[Block] | None:
    errors = seen.errors
    dims = ("repeat", "position", "dof")
    if "cold_repeat" not in errors or set(errors["cold_repeat"].dims) != set(dims) or not errors["cold_repeat"].size:
        return None
    values = field(errors, "cold_repeat", *dims)
    sigma = field(errors, "cold_repeat_u", *dims) if "cold_repeat_u" in errors else np.full_like(values, np.nan)
    if not np.isfinite(values).any():
        return [Text("The cold repeat has no valid result.", "warning")]
    rows: list[list[Cell | str]] = []
    for r in range(values.shape[0]):
        if values.shape[0] > 1:
            rows.append([f"cold repeat {r + 1}"])
        for j in np.argsort(seen.position, kind="stable"):
            cells = []
            for i in range(6):
                size = unit_of(i)[1]
                cells.append(
                    estimate(
                        values[r, j, i] / size, 2 * sigma[r, j, i] / size, reason="no cold repeat of this artefact"
                    )
                )
            rows.append([at_y(seen.position[j]), *cells])
    table = Table(
        "Cold repeat: the six errors between two scans of the cold machine, which are zero if machine and artefacts "
        "did not change. After ±: expanded uncertainty, k = 2.",
        ["artefact", *(f"{seen.names[name]} / {unit_of(i)[0]}" for i, name in enumerate(FREEDOMS))],
        rows,
    )
    return [_assessment(seen, values, sigma), table]


def _assessment(seen: Campaign, values: Array, sigma: Array) -> Text:
    expanded = np.where(sigma > 0, 2 * sigma, np.nan)
    ratio = np.abs(values) / expanded
    judged = np.isfinite(ratio)
    if not judged.any():
        return Text("The cold repeat has no stated uncertainty: it cannot be assessed.", "note")
    outside = int((ratio[judged] > 1).sum())
    _, j, i = np.unravel_index(int(np.nanargmax(ratio)), ratio.shape)
    words = (
        f"Cold repeat: {integer(judged.sum() - outside)} of {integer(judged.sum())} values are within their expanded "
        f"uncertainty (expected: 95 %); relative to it, the largest is {seen.names[FREEDOMS[int(i)]]} at "
        f"{at_y(seen.position[int(j)])} with {trimmed(fixed(float(np.nanmax(ratio)), 2))} times its uncertainty."
    )
    by_chance = 0.05 * judged.sum() + 3 * math.sqrt(0.05 * 0.95 * judged.sum())
    if outside > by_chance or np.nanmax(ratio) > 2:
        return Text(f"{words} This is significant: machine or artefacts changed between the two scans.", "warning")
    return Text(words)
