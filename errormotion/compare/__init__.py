"""Comparison of error datasets of one machine: agreement of several methods, and causes of differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.compare.comparable import ComparableErrors, comparable_errors
from errormotion.compare.consensus import consensus, random_effects
from errormotion.compare.diagnosis import Cause, diagnose
from errormotion.compare.diagnosis.shift import curves_of
from errormotion.compare.pairs import pair
from errormotion.compare.repeats import repeats
from errormotion.compare.result import build
from errormotion.compare.stack import Estimate
from errormotion.errors import DatasetError

__all__ = ["compare", "explain"]

DISAGREEMENT_P = 0.05
"""Probability of a pair, divided by the number of pairs, below which causes are searched."""
MAX_FOR_ALL_PAIRS = 40
"""Largest number of datasets for which all pairs are compared; the number of pairs grows with its square."""


def compare(
    datasets: Mapping[str, xr.Dataset],
    *,
    at: ArrayLike | None = None,
    freedoms: Sequence[str] = (),
    since: float | None = None,
    same_start: bool = False,
    causes: bool | None = None,
    against: str = "",
    groups: Mapping[str, str] | None = None,
) -> xr.Dataset:
    """Compare error datasets of one machine.

    Parameters
    ----------
    datasets : mapping of str to Dataset
        Name to error dataset; at least two.
    at, freedoms, since, same_start
        As for `errormotion.compare.comparable.comparable_errors`.
    causes : bool, optional
        Whether causes are searched. Default: for pairs that do not agree; not for repeats (``groups``).
    against : str, optional
        Dataset with which each of the others is compared. Default: all pairs of up to 40 datasets; for more, the
        first one with each of the others. The consensus includes all datasets.
    groups : mapping of str to str, optional
        Group of each dataset, such as its operator (`errormotion.compare.repeats.labels`): the result then
        contains repeatability within groups, and reproducibility. With ``same_start`` the datasets are repeats of one
        procedure at different times: time 0 of all datasets is treated as one instant, even if their starts differ.

    Returns
    -------
    Dataset
        Schema ``errormotion.comparison/1``.

    Raises
    ------
    DatasetError
        The datasets cannot be compared; the message states what is missing.
    """
    if groups and same_start:  # repeats at different dates
        datasets = {name: ds.copy() for name, ds in datasets.items()}
        for ds in datasets.values():
            ds.attrs.pop("start", None)
    common = comparable_errors(datasets, at=at, freedoms=freedoms, since=since, same_start=same_start)
    pairs = [pair(a, b) for a, b in _pairs(common, against)]
    by_name = {each.name: each for each in common.estimates}
    found: list[list[Cause] | None] = []
    for each in pairs:
        wanted = groups is None and each.joint.p < DISAGREEMENT_P / len(pairs) if causes is None else causes
        found.append(explain(by_name[each.a], by_name[each.b], datasets, common) if wanted else None)
    spread = repeats(common.estimates, [groups[each.name] for each in common.estimates]) if groups else None
    return build(common, pairs, consensus(common.estimates), random_effects(common.estimates), found, spread)


def explain(a: Estimate, b: Estimate, datasets: Mapping[str, xr.Dataset], common: ComparableErrors) -> list[Cause]:
    """Return the causes of the difference of two estimates on common ground that are more likely than chance."""
    time = np.asarray(common.coords["time"].values, dtype=float) if common.dim == "time" else None
    records = {each.name: common.records[each.name] for each in (a, b) if each.name in common.records}
    smoothed = {name: found for name, ds in records.items() if (found := curves_of(ds, common.freedoms))}
    temperatures = _temperatures(datasets, common)
    return diagnose(a, b, common.freedoms, common.stored, time=time, temperatures=temperatures, curves=smoothed)


def _pairs(common: ComparableErrors, against: str) -> list[tuple[Estimate, Estimate]]:
    estimates = common.estimates
    if against and against not in (names := [estimate.name for estimate in estimates]):
        raise DatasetError(
            f"against: expected one of the datasets {', '.join(names)}; found '{against}'",
            code="compare.against.unknown",
        )
    if not against and len(estimates) > MAX_FOR_ALL_PAIRS:
        against = estimates[0].name
        common.notes.append(f"Pairs: '{against}' with each of the others, of {len(estimates)} datasets.")
    if not against:
        return list(combinations(estimates, 2))
    first = next(estimate for estimate in estimates if estimate.name == against)
    return [(first, estimate) for estimate in estimates if estimate is not first]


def _temperatures(datasets: Mapping[str, xr.Dataset], common: ComparableErrors) -> dict[str, Array]:
    """Return the recorded temperatures of all datasets at the times of the grid, by name."""
    if common.dim != "time":
        return {}
    from errormotion.datasets.timing import between

    grid, temperatures = np.asarray(common.coords["time"].values, dtype=float), {}
    for name, ds in datasets.items():
        if "temperature" not in ds.coords or "time" not in ds["temperature"].dims:
            continue
        start = str(ds.attrs.get("start", ""))
        t = ds["time"].values + (between(common.start, start) if start and common.start else 0.0)
        temperature = ds["temperature"].transpose("time", ...).values.reshape(len(t), -1)
        labels = [str(each) for each in ds["sensor"].values] if "sensor" in ds.coords else [""]
        for k, label in enumerate(labels[: temperature.shape[1]]):
            if np.isfinite(temperature[:, k]).all():
                temperatures[f"temperature {label} of '{name}'".replace("  ", " ")] = np.interp(
                    grid, t, temperature[:, k]
                )
    return temperatures
