"""The effect of a compensation: two results of one machine, before and after, at the same points."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.compare.comparable import ComparableErrors, comparable_errors
from errormotion.compare.stack import Estimate, gathered
from errormotion.compensation.effect.figures import paired
from errormotion.compensation.effect.magnitude import Curve, Interval, magnitude, ratio
from errormotion.compensation.effect.result import Effect, Part
from errormotion.datasets.results.merit import is_planned
from errormotion.datasets.results.reduction import REFERENCE
from errormotion.errors import DatasetError
from errormotion.kinematics.iso import DOF
from errormotion.plugins import FigureOfMerit
from errormotion.tolerances.conformity import judge, judge_figures
from errormotion.tolerances.table import Tolerances

DISPLACEMENT = "displacement"
"""Name of the part of EX, EY and EZ together: the length of the vector."""

ANY_START = "1970-01-01T00:00:00+00:00"
"""Start of results without start; the difference of the starts is not used."""


def effect(
    before: xr.Dataset,
    after: xr.Dataset,
    *,
    at: ArrayLike | None = None,
    freedoms: Sequence[str] = (),
    since: float | None = None,
    tolerances: Tolerances | None = None,
) -> Effect:
    """Compare two results of one machine, without and with compensation.

    Errors over time are compared at equal time since time 0 of each result, as changes since the first common time;
    other errors at the common positions or targets.

    Parameters
    ----------
    before, after : Dataset
        Error datasets.
    at, freedoms, since
        As of `errormotion.compare.comparable.comparable_errors`.
    tolerances : Tolerances, optional
        Limits of figures and freedoms, also of figures such as ``reduction of EX``.

    Returns
    -------
    Effect

    Raises
    ------
    DatasetError
        The results cannot be compared.
    """
    results = {"before": before, "after": after}
    if planned := [name for name, ds in results.items() if is_planned(ds)]:
        raise DatasetError(
            f"'{planned[0]}': a plan contains no measured errors; expected a measurement", code="effect.dataset.planned"
        )
    common = comparable_errors(_aligned(results), at=at, freedoms=freedoms, since=since)
    names = [*common.freedoms]
    groups: list[tuple[tuple[int, ...], str]] = [((k,), name) for k, name in enumerate(names)]
    linear = tuple(k for k, name in enumerate(names) if name in DOF[:3])
    if len(linear) > 1:
        groups.append((linear, DISPLACEMENT))
    references = _references(common.estimates[1], after)
    parts = tuple(_part(common, columns, name, references) for columns, name in groups)
    figures, failures = paired(before, after)
    notes = [*common.notes, *_remarks(common, parts, results), *failures]
    judged = [None if tolerances is None else judge(ds, tolerances) for ds in (before, after)]
    gained = None if tolerances is None else judge_figures([_as_figure(part) for part in parts], tolerances)
    return Effect(parts, figures, common, judged[0], judged[1], gained, tuple(notes))


def _aligned(results: dict[str, xr.Dataset]) -> dict[str, xr.Dataset]:
    """Return the results with a common start: time 0 of both is the same time of the warm-up."""
    start = results["before"].attrs.get("start", "") or ANY_START
    return {name: ds.assign_attrs(start=start) for name, ds in results.items()}


def _part(common: ComparableErrors, columns: tuple[int, ...], name: str, references: set[str]) -> Part:
    """Return one freedom, or several as one vector."""
    before, after = (_columns(each, columns) for each in common.estimates)
    known: NDArray[np.bool_] = np.isfinite(np.sum(before.value + after.value, axis=1))
    if common.dim == "time":
        known[0] = False  # the reference: 0 by definition
    unit = "rad" if common.freedoms[columns[0]] in DOF[3:] else "m"
    correctable = unit == "m"
    if not known.any():
        nothing = Interval(math.nan, math.nan, math.nan)
        return Part(name, unit, nothing, nothing, nothing, correctable, math.nan, math.nan)
    keys = tuple(dict.fromkeys((*before.source, *after.source)))
    curves = [Curve.of(each.value[known], each.own[known], gathered(each, keys)[:, known]) for each in (before, after)]
    found = ratio(curves[1], curves[0])
    reduction = Interval(1 - found.value, 1 - found.high, 1 - found.low)
    count = int(known.sum())
    of_reference = after.influence[[key in references for key in after.source]][:, known]
    return Part(
        name,
        unit,
        magnitude(curves[0]),
        magnitude(curves[1]),
        reduction,
        correctable,
        math.sqrt(curves[1].expected / count),
        float(np.sqrt((of_reference**2).sum() / count)),
    )


def _references(estimate: Estimate, ds: xr.Dataset) -> set[str]:
    """Return the keys of the sources that are the uncertainty of a reference state."""
    found = {key for key in estimate.source if key.startswith(f"{estimate.name}: {REFERENCE}")}
    if "source_reference" in ds.coords:
        size = ds.sizes["source"]
        identities = ds["source_id"].values if "source_id" in ds.coords else np.full(size, "")
        rows = zip(ds["source"].values, identities, ds["source_reference"].values, strict=True)
        found |= {str(identity) or f"{estimate.name}: {name}" for name, identity, reference in rows if reference}
    return found


def _columns(estimate: Estimate, columns: tuple[int, ...]) -> Estimate:
    k = list(columns)
    return Estimate(
        estimate.name,
        estimate.value[:, k],
        estimate.own[:, k][:, :, k],
        estimate.influence[:, :, k],
        estimate.source,
    )


def _as_figure(part: Part) -> FigureOfMerit:
    """Return the reduction as a figure with the wider side of its interval as U."""
    low, value, high = part.reduction.low, part.reduction.value, part.reduction.high
    return FigureOfMerit(f"reduction of {part.name}", value, max(value - low, high - value), "1")


def _remarks(common: ComparableErrors, parts: Sequence[Part], results: dict[str, xr.Dataset]) -> list[str]:
    found = []
    if common.dim == "time":
        found.append(
            "Time 0 of both results is treated as the same time of the warm-up. The reduction is that of the "
            "compensation if both had the same duty."
        )
        if text := _heat(common, results):
            found.append(text)
    if any(not part.correctable for part in parts):
        found.append(
            "Linear axes compensate displacements at the functional point. Rotations remain, and displace the tool by "
            "0.1 um for each urad and 100 mm of distance from it."
        )
    return found


def _heat(common: ComparableErrors, results: dict[str, xr.Dataset]) -> str:
    """Return the temperature whose rise differs most between both results; empty without common temperatures."""
    last = float(common.coords["time"].values[-1])
    rises: list[dict[str, float]] = []
    for ds in results.values():
        if "temperature" not in ds.variables or set(ds["temperature"].dims) != {"time", "sensor"}:
            return ""
        t = np.asarray(ds["time"].values, dtype=float)
        values = np.asarray(ds["temperature"].transpose("sensor", "time").values, dtype=float)
        rises.append({str(name): _rise(t, row, last) for name, row in zip(ds["sensor"].values, values, strict=True)})
    before, after = rises
    known = {name for name in before if math.isfinite(before[name]) and math.isfinite(after.get(name, math.nan))}
    if not known:
        return ""
    name = max(sorted(known), key=lambda each: abs(after[each] - before[each]))
    return (
        f"Of the temperatures, the rise of {name} differs most: {before[name]:.2f} K before, {after[name]:.2f} K after."
    )


def _rise(t: Array, values: Array, last: float) -> float:
    known = np.isfinite(values) & (t <= last + 1e-6)
    return float(values[known][-1] - values[known][0]) if known.sum() > 1 else math.nan
