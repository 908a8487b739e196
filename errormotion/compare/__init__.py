"""Comparison of error datasets: do several methods agree on one machine, where not, and what explains it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.compare.consensus import consensus, random_effects
from errormotion.compare.diagnosis import Cause, diagnose
from errormotion.compare.ground import Ground, common_ground
from errormotion.compare.pairs import pair
from errormotion.compare.repeats import repeats
from errormotion.compare.result import build

__all__ = ["compare"]

SUSPICIOUS = 0.05
"""Probability of a pair below which causes are looked for, divided by the number of pairs."""


def compare(
    datasets: Mapping[str, xr.Dataset],
    *,
    at: ArrayLike | None = None,
    freedoms: Sequence[str] = (),
    since: float | None = None,
    same_start: bool = False,
    causes: bool | None = None,
    groups: Mapping[str, str] | None = None,
) -> xr.Dataset:
    """Compare error datasets of one machine.

    Parameters
    ----------
    datasets : mapping of str to Dataset
        Name to error dataset; at least two.
    at, freedoms, since, same_start
        As of `errormotion.compare.ground.common_ground`.
    causes : bool, optional
        Whether causes are looked for. Default: for pairs that do not agree; not for repeats (``groups``).
    groups : mapping of str to str, optional
        Group of each dataset, such as its operator (`errormotion.compare.repeats.labels`): the result then holds
        repeatability within groups, and reproducibility. With ``same_start`` the datasets are repeats of one procedure
        at different times: time 0 of all of them counts as one instant, whatever their start.

    Returns
    -------
    Dataset
        Schema ``errormotion.comparison/1``.

    Raises
    ------
    DatasetError
        The datasets cannot be compared; what is missing.
    """
    if groups and same_start:  # repeats on other days
        datasets = {name: ds.copy() for name, ds in datasets.items()}
        for ds in datasets.values():
            ds.attrs.pop("start", None)
    ground = common_ground(datasets, at=at, freedoms=freedoms, since=since, same_start=same_start)
    pairs = [pair(a, b) for a, b in combinations(ground.estimates, 2)]
    by_name = {each.name: each for each in ground.estimates}
    found: list[list[Cause]] = []
    time = np.asarray(ground.coords["time"].values, dtype=float) if ground.dim == "time" else None
    for each in pairs:
        wanted = groups is None and each.joint.p < SUSPICIOUS / len(pairs) if causes is None else causes
        heat = _temperatures(datasets, ground) if wanted else {}
        a, b = by_name[each.a], by_name[each.b]
        found.append(
            diagnose(a, b, ground.freedoms, time=time, temperatures=heat, turns=ground.turns) if wanted else []
        )
    spread = repeats(ground.estimates, [groups[each.name] for each in ground.estimates]) if groups else None
    return build(ground, pairs, consensus(ground.estimates), random_effects(ground.estimates), found, spread)


def _temperatures(datasets: Mapping[str, xr.Dataset], ground: Ground) -> dict[str, Array]:
    """Return the recorded temperatures of all datasets at the instants of the grid, by name."""
    if ground.dim != "time":
        return {}
    from errormotion.datasets.timing import between

    grid, found = np.asarray(ground.coords["time"].values, dtype=float), {}
    for name, ds in datasets.items():
        if "temperature" not in ds.coords or "time" not in ds["temperature"].dims:
            continue
        start = str(ds.attrs.get("start", ""))
        t = ds["time"].values + (between(ground.start, start) if start and ground.start else 0.0)
        temperature = ds["temperature"].transpose("time", ...).values.reshape(len(t), -1)
        labels = [str(each) for each in ds["sensor"].values] if "sensor" in ds.coords else [""]
        for k, label in enumerate(labels[: temperature.shape[1]]):
            if np.isfinite(temperature[:, k]).all():
                found[f"temperature {label} of '{name}'".replace("  ", " ")] = np.interp(grid, t, temperature[:, k])
    return found
