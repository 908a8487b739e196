"""One figure of many runs as a series: a figure of merit, or an error at a place.

A source that several runs share is recognised by its identity in their error datasets. Its effect on an error is its
``influence``. Its effect on a figure of merit is that stated by the method, otherwise the change of the figure when the
errors change by one standard uncertainty of the source. For a figure from other variables without a stated influence
this change is zero, and its runs are treated as independent.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.datasets.results.effects import change_of, influence_of
from errormotion.errors import DatasetError, ErrormotionError, RunError
from errormotion.plugins import FigureOfMerit
from errormotion.record.runs.entry import Entry
from errormotion.record.series import Series
from errormotion.tolerances.conformity import matches

if TYPE_CHECKING:
    import xarray as xr

MAX_VALUES = 1000
"""Largest number of values of a series; of more runs the newest are used."""
MAX_LISTED = 30
"""Number of names of figures in a message."""
MAX_DISTANCE = 1e-3
"""Largest distance of a target from the requested place, m."""
FREEDOM = re.compile(r"(E[XYZABC]|deviation)(?: after (\d{1,6}(?:\.\d+)?) min)?")


@dataclass(frozen=True)
class Reading:
    """Figure of one run, SI, k = 1, with the signed effect of each source that has an identity."""

    run: str
    name: str
    time: float
    value: float
    u: float
    unit: str
    influence: Mapping[str, float] = field(default_factory=dict)
    origin: tuple[str, ...] = ()
    version: str = ""


@dataclass(frozen=True)
class FigureOverTime:
    """A figure over time, with the runs that are left out and notes for the user."""

    series: Series
    figure: str
    left_out: tuple[str, ...]
    notes: tuple[str, ...]


def figure_over_time(
    runs: Sequence[tuple[Path, Entry]], figure: str, at: Sequence[float] | None = None
) -> FigureOverTime:
    """Return a figure of runs over time.

    Parameters
    ----------
    runs : sequence of (path, entry)
    figure : str
        Name of a figure of merit, in which ``*`` stands for any characters, or a short form such as ``d(Z)60``, which
        contains parts of the name in their order. Or a freedom of the error datasets: ``EZ`` for its last known value
        over time, or ``EZ after 60 min``.
    at : sequence of float, optional
        Place of the freedom, m: functional point of errors over time, otherwise commanded position.

    Raises
    ------
    RunError
        No run states the figure, or a run states several; the message lists the known figures.
    """
    dated = sorted(((path, each) for path, each in runs if each.time is not None), key=lambda run: _time(run[1]))
    left_out = [f"{each.folder}: its time is unknown" for _, each in runs if each.time is None]
    if len(dated) > MAX_VALUES:
        left_out.append(f"{len(dated) - MAX_VALUES} older runs: only the {MAX_VALUES} newest are used")
        dated = dated[-MAX_VALUES:]
    freedom = FREEDOM.fullmatch(figure.strip())
    if at is not None and freedom is None:
        raise RunError(
            f"--at: expected --figure with a freedom, such as EZ; found '{figure}'", code="figure.place.without_figure"
        )
    names = {} if freedom else _names(dated, figure)
    readings = list[Reading]()
    for path, entry in dated:
        if not freedom and path not in names:
            left_out.append(f"{entry.folder}: does not state the figure")
            continue
        try:
            readings.append(_of_freedom(path, entry, freedom, at) if freedom else _of_merit(path, entry, names[path]))
        except ErrormotionError as error:
            left_out.append(f"{entry.folder}: {error}")
        except Exception as error:  # noqa: BLE001 - of a foreign plugin, or a damaged file
            left_out.append(f"{entry.folder}: {type(error).__name__}: {error}")
    if not readings:
        reasons = "".join(f"\n  - {reason}" for reason in left_out[:5])
        raise RunError(
            f"No value of '{figure}' in {len(runs)} runs. Known figures: {_available(dated)}{reasons}",
            code="figure.no_value",
        )
    return FigureOverTime(_series(readings), figure, tuple(left_out), tuple(_remarks(readings, at)))


def _time(entry: Entry) -> float:
    return entry.time.timestamp() if entry.time is not None else np.nan


def _available(runs: Sequence[tuple[Path, Entry]]) -> str:
    """Return the names of the figures of runs, the most frequent first, and how freedoms are stated."""
    counts = Counter(each.name for _, entry in runs for each in entry.figures or ())
    listed = [f"'{name}'" for name, _ in counts.most_common(MAX_LISTED)]
    more = f", and {len(counts) - MAX_LISTED} more" if len(counts) > MAX_LISTED else ""
    freedoms = "a freedom of the error datasets, EX to EC, at a place with --at"
    return "; ".join([", ".join(listed) + more, freedoms] if listed else [freedoms])


def _names(runs: Sequence[tuple[Path, Entry]], figure: str) -> dict[Path, FigureOfMerit]:
    """Return the figure of each run that states it, by the strictest match of the name in any run."""
    for agrees in (str.__eq__, lambda wanted, name: "*" in wanted and matches(wanted, name), _short):
        names = {}
        for path, entry in runs:
            own = [each for each in entry.figures or () if agrees(figure, each.name)]
            if len(own) > 1:
                several = ", ".join(f"'{each.name}'" for each in own[:MAX_LISTED])
                raise RunError(
                    f"'{figure}' matches several figures of {entry.folder}: {several}. State one of them",
                    code="figure.ambiguous",
                )
            if own:
                names[path] = own[0]
        if names:
            return names
    raise RunError(
        f"No value of '{figure}' in {len(runs)} runs. Known figures: {_available(runs)}", code="figure.no_value"
    )


def _short(wanted: str, name: str) -> bool:
    """Return whether a name starts with the first part of a short form and contains the others in their order."""
    parts, words = _parts(wanted[:100]), _parts(name)
    if not parts or not words or words[0] != parts[0]:
        return False
    rest = iter(words)
    return all(part in rest for part in parts)


def _parts(text: str) -> list[str | float]:
    """Return the words and numbers of a name."""
    parts = re.findall(r"\d+(?:\.\d+)?|[^\d\s]+", text)
    return [float(each) if each[0].isdigit() else each for each in parts]


def _of_merit(path: Path, entry: Entry, stated: FigureOfMerit) -> Reading:
    """Return a figure of merit with the effects of shared sources, as far as the error dataset states them."""
    u = _checked(stated.value, stated.expanded_uncertainty / 2)
    effects = dict[str, float]()
    origin: tuple[str, ...] = (entry.method,)
    version = ""
    if entry.errors and (path / entry.errors).exists():
        from errormotion import datasets

        errors = datasets.load(path / entry.errors)
        origin, version = _origin(errors), _version(errors)
        given = _influence(errors, stated.name)
        for row, identity in _identified(errors):
            source = str(errors["source"].values[row])
            effect = change_of(errors, row, stated.name) if given is None else float(given.get(source, 0.0))
            if np.isfinite(effect):
                effects[identity] = effects.get(identity, 0.0) + effect
    return Reading(entry.folder, stated.name, _time(entry), stated.value, u, stated.unit, effects, origin, version)


def _influence(errors: xr.Dataset, name: str) -> Mapping[str, float] | None:
    """Return the effects of the sources on a figure by name, as stated by the method."""
    from errormotion.datasets.results.merit import figures_of

    return next((each.influence for each in figures_of(errors) if each.name == name), None)


def _identified(errors: xr.Dataset) -> list[tuple[int, str]]:
    """Return row and identity of the sources that have an identity."""
    influence = influence_of(errors)
    if "source_id" not in errors.variables or influence not in errors.variables:
        return []
    return [(row, str(each)) for row, each in enumerate(errors["source_id"].values) if str(each)]


def _of_freedom(path: Path, entry: Entry, freedom: re.Match[str], at: Sequence[float] | None) -> Reading:
    """Return a freedom of the error dataset of a run, at a place and an instant."""
    from errormotion import datasets

    if not entry.errors:
        raise RunError("the run has no error dataset yet", code="run.no_errors")
    errors = datasets.load(path / entry.errors)
    name, minutes = freedom[1], freedom[2]
    origin = _origin(errors)
    if name not in errors.em.names:
        raise DatasetError(
            f"has no {name}; its freedoms are {', '.join(errors.em.names)}", code="errors.freedom.missing"
        )
    errors, place = _at_place(errors, at)
    if minutes is not None:
        if errors.em.dims != ("time",):
            raise DatasetError("has no errors over time, as 'after' requires", code="errors.time.missing")
        errors = errors.em.to_times([60.0 * float(minutes)])
        place = 0
    k = errors.em.names.index(name)
    values = errors.em.estimates().values.reshape(-1, len(errors.em.names))[:, k]
    if place is None:
        known = np.flatnonzero(np.isfinite(values))
        if not known.size:
            raise DatasetError(
                f"{name} is unknown{'' if at is None else ' at this point, because a rotation is unknown'}",
                code="errors.freedom.value_unknown",
            )
        place = int(known[-1])
    u = errors.em.expanded(1.0).values.reshape(-1, len(errors.em.names))[place, k]
    effects = dict[str, float]()
    influence = influence_of(errors)
    for row, identity in _identified(errors):
        F = errors[influence].transpose("source", ..., *(["dof"] if influence == "influence" else [])).values[row]
        effect = F.reshape(-1, len(errors.em.names))[place, k]
        effects[identity] = effects.get(identity, 0.0) + float(effect)
    value = float(values[place])
    unit = str(errors[name].attrs.get("units", "m"))
    u = _checked(value, float(u))
    return Reading(entry.folder, freedom[0], _time(entry), value, u, unit, effects, origin, _version(errors))


def _at_place(errors: xr.Dataset, at: Sequence[float] | None) -> tuple[xr.Dataset, int | None]:
    """Return errors that contain a place, and the index of the place; None for the last known value over time."""
    dims = errors.em.dims
    if dims in ((), ("time",)):
        return (errors if at is None else errors.em.at(at)), (0 if dims == () else None)
    if at is None:
        raise DatasetError(
            f"states errors over {', '.join(dims)}; state the place by --at", code="figure.place.required"
        )
    own = [axis for axis in "xyz" if axis in errors.variables]
    if dims == ("position",):
        moving = [axis for axis in own if errors[axis].dims == dims]
        if len(moving) == 1:
            return errors.em.to_positions([at["xyz".index(moving[0])]], moving[0]), 0
    if len(dims) != 1 or len(own) < 3:
        raise DatasetError(
            f"states errors over {', '.join(dims)} without x, y and z, so that no place can be found",
            code="figure.place.no_coordinates",
        )
    away = np.sqrt(sum((errors[axis].values - at["xyz".index(axis)]) ** 2 for axis in own))
    nearest = int(np.nanargmin(away))
    if not away[nearest] <= MAX_DISTANCE:
        raise DatasetError(
            f"its nearest position is {1e3 * away[nearest]:.1f} mm away from the requested place",
            code="figure.place.too_far",
        )
    return errors, nearest


def _checked(value: float, u: float) -> float:
    if not np.isfinite(value):
        raise DatasetError("the value is unknown", code="figure.value.unknown")
    if not (np.isfinite(u) and u > 0):
        raise DatasetError("the uncertainty is unknown", code="figure.uncertainty.unknown")
    return u


def _origin(errors: xr.Dataset) -> tuple[str, ...]:
    """Return what comparable values must have in common: method, component, frame and functional point."""
    point = ", ".join(f"{1e3 * each:g}" for each in np.asarray(errors.attrs["functional_point"], dtype=float))
    names = ("method", "component", "frame")
    return (*(str(errors.attrs.get(name, "")) for name in names), point)


def _version(errors: xr.Dataset) -> str:
    """Return method and version of a result; empty if it does not state them."""
    parts = [str(errors.attrs.get(name, "")) for name in ("method", "method_version")]
    return " ".join(parts) if all(parts) else ""


def _series(readings: list[Reading]) -> Series:
    """Return readings as a series; sources of a single run are part of its uncertainty."""
    units = {reading.unit for reading in readings}
    if len(units) > 1:
        raise RunError(
            f"The figure has several units: {', '.join(sorted(units))}. State a name of one figure only",
            code="figure.units.several",
        )
    counts = Counter(identity for reading in readings for identity, effect in reading.influence.items() if effect)
    shared = sorted(identity for identity, count in counts.items() if count > 1)
    F = np.array([[reading.influence.get(identity, 0.0) for reading in readings] for identity in shared])
    u = np.array([reading.u for reading in readings])
    return Series(
        np.array([reading.time for reading in readings]),
        np.array([reading.value for reading in readings]),
        np.maximum(u, np.sqrt((F**2).sum(axis=0))) if shared else u,
        F if shared else np.zeros((0, len(readings))),
        shared,
        [reading.run for reading in readings],
        [reading.name for reading in readings],
        units.pop(),
        [reading.version for reading in readings],
    )


def _remarks(readings: list[Reading], at: Any) -> list[str]:
    """Return notes on differences between the runs that affect the comparison."""
    known = [reading.origin for reading in readings if len(reading.origin) == 4]
    notes = []
    for k, what in ((0, "methods"), (1, "components"), (2, "frames"), (3, "functional points (mm)")):
        values = sorted({origin[k] for origin in known})
        if len(values) > 1 and not (k == 3 and at is not None):
            advice = (
                " Choose one by --method."
                if k == 0
                else " Choose one by --at."
                if k == 3
                else " Choose one by --method or --test."
            )
            notes.append(f"The runs state several {what}: {'; '.join(values[:5])}.{advice}")
    lacking = len(readings) - len(known)
    if lacking and known:
        notes.append(
            f"{lacking} of {len(readings)} runs have no error dataset; their sources are treated as independent."
        )
    return notes
