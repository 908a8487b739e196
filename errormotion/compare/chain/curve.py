"""Errors of an axis at positions, relative to reference positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.results.reduction import influence_of
from errormotion.estimation.low_rank import root_of
from errormotion.kinematics.iso import is_straightness

REFERENCE = "reference position"
"""Group of the sources from the uncertainty of the errors at the reference positions."""


@dataclass(frozen=True)
class Curve:
    """Errors of an axis at n positions: values (n, 6), own (n, 6, 6), influence (s, n, 6); unknown values are NaN."""

    value: Array
    own: Array
    influence: Array
    source: list[str]
    group: list[str]
    identity: list[str]

    def relative(self, weights: Array) -> Curve:
        """Return the errors minus a weighted sum of those at reference positions; ``weights`` (n, n, 6)."""
        known = ~np.isnan(weights).any(axis=(0, 1))
        W = np.where(known, weights, 0.0)
        value = np.where(known, self.value, np.nan)
        E, F, own = np.nan_to_num(value), np.nan_to_num(self.influence), np.nan_to_num(self.own).copy()
        rows, names = [], []
        for j in np.flatnonzero((W != 0).any(axis=(0, 2))):
            effect = -W[:, j]
            effect[j] += 1.0
            for k, part in enumerate(root_of(own[j]).T):
                rows.append(effect * part)
                names.append(f"{REFERENCE} {j + 1}, part {k + 1}")
            own[j] = 0.0
        gone = np.isnan(value)
        E = np.where(gone, np.nan, E - np.einsum("njk,jk->nk", W, E))
        F = np.concatenate([F - np.einsum("njk,sjk->snk", W, F), np.reshape(rows, (-1, *E.shape))])
        F[np.abs(F) < 1e-15 * np.abs(F).max(axis=(0, 1), initial=0.0)] = (
            0.0  # rounding errors at the reference positions
        )
        F[:, gone] = np.nan
        own[gone[:, :, None] | gone[:, None, :]] = np.nan
        return Curve(
            E, own, F, [*self.source, *names], [*self.group, *[REFERENCE] * len(names)],
            [*self.identity, *[""] * len(names)],
        )  # fmt: skip


def measured(ds: xr.Dataset, letter: str, positions: Array) -> Curve:
    """Return the errors of a dataset at some of its positions."""
    rows = [int(np.abs(ds[letter].values - q).argmin()) for q in positions]
    one = ds.isel(position=rows)
    F = influence_of(one)
    C = np.asarray(one["covariance"].values, dtype=float)
    return Curve(one.em.twist().values, C - np.einsum("sni,snj->nij", F, F), F, *sources_of(one))


def reference_weights(values: Sequence[Array], positions: Array, axis: str) -> Array:
    """Return the weights (n, n, 6) of the subtracted reference positions; NaN for freedoms that cannot be compared."""
    n = positions.size
    W = np.zeros((n, n, 6))
    for dof in range(6):
        known = np.flatnonzero(np.all([np.isfinite(each[:, dof]) for each in values], axis=0))
        line = is_straightness(dof, axis)
        if known.size < (3 if line else 2):
            W[:, :, dof] = np.nan
            continue
        a, z = known[0], known[-1]
        share = (positions - positions[a]) / (positions[z] - positions[a]) if line else np.zeros(n)
        W[:, a, dof] = 1.0 - share
        W[:, z, dof] += share
    return W


def sources_of(ds: xr.Dataset) -> tuple[list[str], list[str], list[str]]:
    """Return name, group and identity of each source."""
    size = ds.sizes.get("source", 0)
    return tuple(
        [str(each) for each in ds[name].values.tolist()] if size and name in ds.coords else [""] * size
        for name in ("source", "source_group", "source_id")
    )  # type: ignore[return-value]
