"""Effects of the sources of uncertainty on a figure of merit."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from errormotion.plugins import FigureOfMerit

if TYPE_CHECKING:
    import xarray as xr

MAX_SOURCES = 64
"""Sources whose effects are computed from changed errors; each requires two evaluations of the figures."""


def effects_of(errors: xr.Dataset, figure: FigureOfMerit) -> Mapping[str, float] | None:
    """Return the effect of one standard uncertainty of each source on a figure, by the name of the source.

    It is the stated one, else computed from the change of the figure with the errors. None if it is unknown: the figure
    comes from other variables, or the errors state too many sources.
    """
    if figure.influence is not None:
        return figure.influence
    influence = influence_of(errors)
    if influence not in errors or not 0 < errors.sizes.get("source", 0) <= MAX_SOURCES:
        return None
    effects = {str(name): change_of(errors, row, figure.name) for row, name in enumerate(errors["source"].values)}
    known = [effect for effect in effects.values() if np.isfinite(effect)]
    return effects if known and len(known) == len(effects) and any(known) else None


def influence_of(errors: xr.Dataset) -> str:
    """Return the name of the variable with the effects of the sources on the errors."""
    return "influence" if len(errors.em.names) > 1 else "deviation_influence"


def change_of(errors: xr.Dataset, row: int, name: str) -> float:
    """Return the change of a figure, by its name, for one standard uncertainty of a source in the errors."""
    high, low = (_figure(_moved(errors, row, sign), name) for sign in (1.0, -1.0))
    return 0.5 * (high - low)


def _figure(errors: xr.Dataset, name: str) -> float:
    from errormotion.datasets.results.merit import figures_of

    return next((each.value for each in figures_of(errors) if each.name == name), np.nan)


def _moved(errors: xr.Dataset, row: int, sign: float) -> xr.Dataset:
    """Return errors changed by one standard uncertainty of a source."""
    names = errors.em.names
    changed = {}
    for k, name in enumerate(names):
        F = errors[influence_of(errors)].isel(source=row)
        F = F.isel(dof=k, drop=True) if "dof" in F.dims else F
        changed[name] = errors[name].copy(data=errors[name].values + sign * F.transpose(*errors[name].dims).values)
    return errors.assign(changed)
