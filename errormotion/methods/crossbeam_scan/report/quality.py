"""Quality of every registration of a crossbeam campaign, the cold repeats, and artefacts that moved."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.methods.crossbeam_scan.report.view import (
    AXES,
    NO_REASON,
    Campaign,
    after,
    at_y,
    campaign,
    positions,
    trimmed,
)
from errormotion.report import quality
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import Block, Source, Text
from errormotion.report.elements import Column, Table
from errormotion.report.fields import field, remarks
from errormotion.report.text import finite, fixed, integer, listed, significant

_MAX_ROWS = 240  # of single registrations; if there are more, each cycle is one row
_NOTE = (
    "Predicted: the bound that follows from the slopes of the surface and the noise stated for the sensor. By "
    "registration: the uncertainty of the registration with the noise and the jitter found in the scans. Both are "
    "standard uncertainties (k = 1) at the carriage, the worst of three directions, without pose and lever. "
    "1 arcsec = 4.848 µrad."
)
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


def counts(source: Source, key: str) -> list[Block]:  # noqa: ARG001 - texts have no identifiers
    """Return the method's remarks and the counts."""
    seen = campaign(source.errors)
    found: list[Block] = [Text(note, "warning") for note in remarks(seen.errors)]
    planned, done = made(seen)
    if not planned:
        return [*found, Text("The campaign has no warm cycle to register.", "warning")]
    words = f"{integer(done)} of {integer(planned)} registrations were made"
    if done < planned:
        words += f"; {lost(seen)}"
    found.append(Text(f"{words}.", "plain" if done == planned else "warning"))
    if done and not _stated(seen):
        found.append(Text("The result does not contain data on the quality of the registrations.", "note"))
    return found


_VARIABLES = (("predicted_u", "dof"), ("registration_u", "dof"), ("residual_rms",), ("points_used",), ("noise_found",))


def _stated(seen: Campaign) -> bool:
    """Return whether the result states the quality of any registration."""
    return any(np.isfinite(seen.get(*each)[seen.known]).any() for each in _VARIABLES)


def _worst(name: str, rows: slice) -> Callable[[xr.Dataset], xr.DataArray]:
    """Return the largest standard uncertainty of three directions."""
    return lambda errors: _all(errors, name, "dof").isel(dof=rows).max("dof").where(_made(errors))


def _jitter(axis: str) -> Callable[[xr.Dataset], xr.DataArray]:
    def of(errors: xr.Dataset) -> xr.DataArray:
        found = _all(errors, "line_jitter", "jitter")
        labels = [str(label) for label in errors["jitter"].values] if "jitter" in errors.coords else ["z", "y"]
        return found.isel(jitter=labels.index(axis)) if found.sizes["jitter"] == 2 else found.max("jitter") * np.nan

    return of


def _one(name: str) -> Callable[[xr.Dataset], xr.DataArray]:
    return lambda errors: _all(errors, name).where(_made(errors))


def _all(errors: xr.Dataset, name: str, *dims: str) -> xr.DataArray:
    return xr.DataArray(campaign(errors).get(name, *dims), dims=(*AXES, *dims))


def _made(errors: xr.Dataset) -> xr.DataArray:
    return xr.DataArray(campaign(errors).known, dims=AXES)


def _three(value: float) -> str:
    return significant(value, 3) if value < 100 else integer(value)


COLUMNS = tuple(
    replace(column, uncertainty="none", reason="why", signed=False)
    for column in (
        Column(_worst("predicted_u", slice(0, 3)), head="shift", unit="nm", format=_three, reduce="highest"),
        Column(_worst("predicted_u", slice(3, 6)), head="rotation", unit="urad", format=_three, reduce="highest"),
        Column(_worst("registration_u", slice(0, 3)), head="shift", unit="nm", format=_three, reduce="highest"),
        Column(_worst("registration_u", slice(3, 6)), head="rotation", unit="urad", format=_three, reduce="highest"),
        Column(_one("residual_rms"), head="rms", unit="um", format=".3", reduce="highest"),
        Column(_one("points_used"), head="points", format="integer", reduce="lowest"),
        Column(_one("noise_found"), head="noise", unit="um", format=".3", reduce="highest"),
        Column(_jitter("z"), head="in z", unit="um", format=".2", reduce="highest"),
        Column(_jitter("y"), head="in y", unit="um", format=".2", reduce="highest"),
    )
)


def _rows(single: bool) -> Callable[[xr.Dataset], xr.Dataset | None]:
    """Return what selects the warm cycles, if their registrations are shown one by one or by cycles."""

    def select(errors: xr.Dataset) -> xr.Dataset | None:
        seen = campaign(errors)
        planned, done = made(seen)
        if not done or not _stated(seen) or (planned <= _MAX_ROWS) != single:
            return None
        found = errors.assign(why=(AXES, np.where(seen.known, "not part of this result", seen.reason)))
        if not single:
            reasons = [
                "not part of this result" if known.any() else "; ".join(dict.fromkeys(map(str, reason)))
                for known, reason in zip(seen.known, seen.reason, strict=True)
            ]
            found = found.assign(why=("time", reasons))
        return found.isel(time=seen.warm, position=np.argsort(seen.position, kind="stable"))

    return select


def _row(errors: xr.Dataset, dims: Sequence[str], index: Sequence[int]) -> str:
    """Return the cycle of a group of rows, or the artefact of a row."""
    if dims[0] == "time":
        return f"{after(float(errors['time'][index[0]]))} of warm-up"
    return at_y(positions(errors)[index[0]])


def _cycle(errors: xr.Dataset, dims: Sequence[str], index: Sequence[int]) -> str:  # noqa: ARG001 - one dim
    seen = campaign(errors)
    return f"{after(seen.time[index[0]])}: {int(seen.known[index[0]].sum())} of {seen.position.size}"


def _reasons(errors: xr.Dataset) -> list[str]:
    """Return the registrations without a value, by reason."""
    seen, by_reason = campaign(errors), dict[str, list[str]]()
    for k, j in np.argwhere(~seen.known):
        by_reason.setdefault(str(seen.reason[k, j]), []).append(seen.where(int(k), int(j)))
    return [
        f"{reason}: {'; '.join(places[:6])}{' …' if len(places) > 6 else ''}." for reason, places in by_reason.items()
    ]


TABLES = (
    Table(
        "Quality of every registration, by warm-up time and position.",
        COLUMNS,
        over=AXES,
        head="artefact",
        place=_row,
        groups=_GROUPS,
        notes=(_NOTE,),
        of=_rows(single=True),
    ),
    Table(
        "Quality of the registrations: the worst of each cycle (of the points: the fewest), and how many were made.",
        COLUMNS,
        over="time",
        head="cycle",
        place=_cycle,
        groups=_GROUPS,
        notes=(_NOTE, _reasons),
        of=_rows(single=False),
    ),
)


def drift(source: Source, key: str) -> list[Block]:  # noqa: ARG001 - texts have no identifiers
    """Return the drift during a scan, and what was counted during the measurement."""
    seen, found = campaign(source.errors), list[Block]()
    strain = 1e6 * seen.get("strain", "direction")
    if made(seen)[1] and "strain" in seen.errors and np.isfinite(strain).any():
        largest = [finite(np.max, np.abs(strain[..., k])) for k in range(strain.shape[-1])]
        each = zip(largest, "xyz", strict=False)
        words = listed([f"{trimmed(fixed(value, 1))} µm/m in {axis}" for value, axis in each])
        found.append(
            Text(
                "The error of the axis changes during a scan: a cold and a warm surface differ by more than a rigid "
                f"motion. Drift of the profiler that was taken into account: at most {words}.",
                "note",
            )
        )
    counted = quality.counts(source.errors, source.raw)
    if counted:
        words = ", ".join(f"{name} {number}" for name, number in counted.items())
        found.append(Text(f"Counted during the measurement: {words}."))
    return found


def stability(source: Source, key: str) -> list[Text]:  # noqa: ARG001 - texts have no identifiers
    """Return the check for moved artefacts, and the assessment of the cold repeats."""
    seen = campaign(source.errors)
    found = _moved(seen)
    repeats = _repeats(seen.errors)
    if repeats is None:
        return [*found, Text("No cold repeat was scanned: the repeatability of the cold state is not known.", "note")]
    if not np.isfinite(repeats["cold_repeat"].values).any():
        return [*found, Text("The cold repeat has no valid result.", "warning")]
    return [*found, _assessment(seen)]


def _moved(seen: Campaign) -> list[Text]:
    if "moved" not in seen.errors or seen.errors["moved"].dims != ("position",):
        return [Text("The result does not state whether artefacts moved.", "note")]
    moved = np.nan_to_num(np.asarray(seen.errors["moved"].values, float)).astype(bool)
    if not moved.any():
        return [Text("No artefact was found to have moved on the table.")]
    since = np.full(moved.size, np.nan)
    if "moved_since" in seen.errors and seen.errors["moved_since"].dims == ("position",):
        since = np.asarray(seen.errors["moved_since"].values, float)
    warnings: list[Text] = []
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


_REPEAT = ("repeat", "position", "dof")


def _repeats(errors: xr.Dataset) -> xr.Dataset | None:
    """Return a campaign whose artefacts were scanned cold again, with increasing positions; else None."""
    if "cold_repeat" not in errors or set(errors["cold_repeat"].dims) != set(_REPEAT) or not errors["cold_repeat"].size:
        return None
    return errors.isel(position=np.argsort(campaign(errors).position, kind="stable"))


def _known_repeats(errors: xr.Dataset) -> xr.Dataset | None:
    found = _repeats(errors)
    return found if found is not None and np.isfinite(found["cold_repeat"].values).any() else None


def _repeated(errors: xr.Dataset, dims: Sequence[str], index: Sequence[int]) -> str:
    if dims[0] == "repeat":
        return f"cold repeat {index[0] + 1}"
    return at_y(positions(errors)[index[0]])


REPEATS = (
    Table(
        "Cold repeat: the six errors between two scans of the cold machine, which are zero if machine and "
        "artefacts did not change. After ±: expanded uncertainty, k = 2.",
        tuple(
            Column("cold_repeat", select={"dof": name}, reason="no cold repeat of this artefact") for name in FREEDOMS
        ),
        over=("repeat", "position"),
        head="artefact",
        place=_repeated,
        of=_known_repeats,
    ),
)


def _assessment(seen: Campaign) -> Text:
    values = field(seen.errors, "cold_repeat", *_REPEAT)
    sigma: Array = np.full_like(values, np.nan)
    if "cold_repeat_u" in seen.errors:
        sigma = field(seen.errors, "cold_repeat_u", *_REPEAT)
    ratio = np.abs(values) / np.where(sigma > 0, 2 * sigma, np.nan)
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
