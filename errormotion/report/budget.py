"""The uncertainty budget at one instant, by group of sources, and the twist that it belongs to."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr

import errormotion.datasets  # noqa: F401 - registers ds.em
from errormotion.report.document import Cell, Table, estimate, or_dash
from errormotion.report.text import SECOND_OF_ARC, UM, decimals_of, fixed

FREEDOMS = ("EX", "EY", "EZ", "EA", "EB", "EC")
_INDEPENDENT = "sensor noise, independent from instant to instant"


def groups_at(errors: xr.Dataset) -> dict[str, np.ndarray]:
    """Return the standard uncertainty (6,) of every group of sources at one place, the independent rest last.

    Parameters
    ----------
    errors : Dataset
        An error dataset without dims of place left (``isel`` it first).
    """
    budget = errors.em.budget()
    return {str(name): budget.sel(group=name).values for name in budget["group"].values}


def table(errors: xr.Dataset, when: str) -> Table:
    """Return the budget table at one place; ``errors`` has no dims of place left."""
    groups = groups_at(errors)
    sizes = np.array([UM[1]] * 3 + [SECOND_OF_ARC[1]] * 3)
    variance = np.array([float(errors["covariance"].isel(dof=i, dof_=i)) for i in range(6)])
    combined = np.sqrt(np.where(variance >= 0, variance, np.nan))
    reason = "not observed by this method"
    decimals = [decimals_of(value, 3) for value in combined / sizes]

    def row(name: str, values: np.ndarray) -> list[Cell | str]:
        return [
            name,
            *(or_dash(fixed(v / s, places), reason) for v, s, places in zip(values, sizes, decimals, strict=True)),
        ]

    return Table(
        f"Uncertainty budget {when}: standard uncertainty (k = 1) of the six error motions at the functional point, "
        "by group of sources.",
        ["source", *(f"{name} / {UM[0] if i < 3 else SECOND_OF_ARC[0]}" for i, name in enumerate(FREEDOMS))],
        [
            *(row(readable(name), values) for name, values in groups.items()),
            row("combined, k = 1", combined),
            row("expanded, k = 2", 2 * combined),
        ],
    )


def readable(group: str) -> str:
    """Return the name of a group of sources in words."""
    return _INDEPENDENT if group == "independent" else group.replace("_", " ")


def largest(errors: xr.Dataset, freedom: str) -> tuple[str, str] | None:
    """Return the group with the largest share in the variance of one freedom, and that share; None where unknown."""
    index = FREEDOMS.index(freedom)
    shares = {name: float(values[index] ** 2) for name, values in groups_at(errors).items()}
    total = sum(share for share in shares.values() if math.isfinite(share))
    if not total > 0:
        return None
    name = max(shares, key=lambda group: shares[group] if math.isfinite(shares[group]) else -1.0)
    return readable(name), f"{fixed(100 * shares[name] / total, 0)} %"


def twist_table(errors: xr.Dataset, places: dict[str, xr.Dataset], names: dict[str, str]) -> Table:
    """Return the six error motions at a few places; a freedom that the method does not see is a dash."""
    rows: list[list[Cell | str]] = []
    for i, freedom in enumerate(FREEDOMS):
        unit, size = UM if i < 3 else SECOND_OF_ARC
        unseen = not np.isfinite(errors[freedom].values).any()
        reason = "not observed by this method" if unseen else "no valid reading at this place"
        cells = []
        for place in places.values():
            variance = float(place["covariance"].isel(dof=i, dof_=i))
            expanded = 2 * math.sqrt(variance) if variance >= 0 else math.nan
            cells.append(estimate(float(place[freedom]) / size, expanded / size, reason=reason))
        rows.append([freedom, names.get(freedom, ""), unit, *cells])
    return Table(
        "The six error motions at the functional point (actual minus commanded, tool side relative to workpiece side). "
        "After ±: expanded uncertainty, k = 2.",
        ["freedom", "ISO 230-1", "unit", *places],
        rows,
    )
