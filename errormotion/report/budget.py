"""Uncertainty budget at one instant by group of sources, and the corresponding errors."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr

import errormotion.datasets  # noqa: F401 - registers ds.em
from errormotion.report.document import Cell, Table, estimate, or_dash
from errormotion.report.text import SECOND_OF_ARC, UM, decimals_of, fixed

FREEDOMS = ("EX", "EY", "EZ", "EA", "EB", "EC")
_INDEPENDENT = "independent noise"


def groups_at(errors: xr.Dataset) -> dict[str, np.ndarray]:
    """Return the standard uncertainty (n,) of every group of sources at one position or time, the independent last.

    Parameters
    ----------
    errors : Dataset
        An error dataset without dims of position or time (apply ``isel`` first).
    """
    budget = errors.em.budget()
    return {str(name): budget.sel(group=name).values for name in budget["group"].values}


def sigma(errors: xr.Dataset) -> np.ndarray:
    """Return the standard uncertainty of every estimate, (..., n); NaN where it is unknown."""
    variance = np.diagonal(errors.em.covariance().values, axis1=-2, axis2=-1)
    return np.sqrt(np.where(variance >= 0, variance, np.nan))


def table(errors: xr.Dataset, when: str, noise: str = _INDEPENDENT) -> Table:
    """Return the budget table at one position or time; ``errors`` has no such dims.

    ``noise`` is the name of the part that is independent from place to place.
    """
    groups = groups_at(errors)
    names, own = errors.em.names, errors.em.iso_names()
    units = [UM if i < 3 else SECOND_OF_ARC for i in range(len(names))]
    sizes = np.array([size for _, size in units])
    combined = sigma(errors)
    reason = "not determined by this method"
    decimals = [decimals_of(value, 3) for value in combined / sizes]

    def row(name: str, values: np.ndarray) -> list[Cell | str]:
        return [
            name,
            *(or_dash(fixed(v / s, places), reason) for v, s, places in zip(values, sizes, decimals, strict=True)),
        ]

    return Table(
        f"Uncertainty budget {when}: standard uncertainty (k = 1) of the "
        f"{'six error motions at the functional point' if len(names) > 1 else names[0]}, by group of sources.",
        ["source", *(f"{own[name]} / {unit}" for name, (unit, _) in zip(names, units, strict=True))],
        [
            *(row(noise if name == "independent" else readable(name), values) for name, values in groups.items()),
            row("combined, k = 1", combined),
            row("expanded, k = 2", 2 * combined),
        ],
    )


def readable(group: str) -> str:
    """Return the readable name of a group of sources."""
    return _INDEPENDENT if group == "independent" else group.replace("_", " ")


def largest(errors: xr.Dataset, freedom: str) -> tuple[str, str] | None:
    """Return the group with the largest share in the variance of one error, and this share; None if unknown."""
    index = FREEDOMS.index(freedom)
    shares = {name: float(values[index] ** 2) for name, values in groups_at(errors).items()}
    total = sum(share for share in shares.values() if math.isfinite(share))
    if not total > 0:
        return None
    name = max(shares, key=lambda group: shares[group] if math.isfinite(shares[group]) else -1.0)
    return readable(name), f"{fixed(100 * shares[name] / total, 0)} %"


def twist_table(errors: xr.Dataset, places: dict[str, xr.Dataset], names: dict[str, str]) -> Table:
    """Return the table of the six errors at a few positions; an undetermined error is a dash."""
    rows: list[list[Cell | str]] = []
    for i, freedom in enumerate(errors.em.names):
        unit, size = UM if i < 3 else SECOND_OF_ARC
        unseen = not np.isfinite(errors[freedom].values).any()
        reason = "not determined by this method" if unseen else "no valid reading at this position"
        cells = []
        for place in places.values():
            cells.append(estimate(float(place[freedom]) / size, 2 * sigma(place)[i] / size, reason=reason))
        rows.append([freedom, names.get(freedom, ""), unit, *cells])
    return Table(
        f"The {'six error motions at the functional point' if len(errors.em.names) > 1 else 'deviation'} "
        "(actual minus commanded, tool side relative to workpiece side). "
        "After ±: expanded uncertainty, k = 2.",
        ["freedom", "ISO 230-1", "unit", *places],
        rows,
    )
