"""Figures of merit: those of ISO 230-2 for the positioning, and the accuracy of the other freedoms."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from errormotion.datasets.results.merit import is_planned
from errormotion.estimation.extremes import expanded, largest
from errormotion.methods.linear_positioning.identification.standard import FIGURES
from errormotion.methods.linear_positioning.settings import LIMITS
from errormotion.plugins import FigureOfMerit

if TYPE_CHECKING:
    from collections.abc import Sequence

    import xarray as xr

OTHER_FIGURES = ("E", "R", "B")
"""Figures of merit of straightness, angles and diagonals."""
ALIGNED_FIGURES = ("A", "A_forward", "A_backward", "E", "E_forward", "E_backward", "M")
"""Figures of positioning that a cosine error changes."""
DISTORTIONS = {"range_60min": "within the first 60 min, range", "range_moving": "while the axis moved, range"}
"""Figures of merit of a test with a moving axis."""


def figures(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return the figures as the standard defines them; none for a plan.

    The expanded uncertainty is ``2 u`` plus the mean excess of an extreme value by scatter, for which the standard does
    not correct (JCGM 100, F.2.4.5).
    """
    if is_planned(errors):
        return []
    if "distortion" in errors:
        return _distortion(errors)
    if "squareness" in errors:
        return _diagonals(errors)
    merits = []
    for freedom in map(str, errors["freedom"].values):
        selected = errors.sel(freedom=freedom)
        along = freedom[1] == freedom[2]
        unit = "m" if freedom[1] in "XYZ" else "rad"
        for name in FIGURES if along else OTHER_FIGURES:
            limit = errors.attrs.get(LIMITS.get(name, "")) if along else None
            merits += _merit(selected, name, f"{name} of {freedom} (ISO 230-2)", unit, limit)
        if along and "aligned_value" in errors:
            for name in ALIGNED_FIGURES:
                merits += _merit(
                    selected, name, f"{name} of {freedom}, corrected for the alignment", unit, kind="aligned"
                )
    return merits


def _merit(
    errors: xr.Dataset, figure: str, title: str, unit: str, limit: float | None = None, kind: str = "figure"
) -> list[FigureOfMerit]:
    """Return a figure of one freedom or diagonal; nothing if it is unknown."""
    value, bias, u = (float(errors[f"{kind}_{part}"].sel(figure=figure)) for part in ("value", "bias", "u"))
    return [FigureOfMerit(title, value, float(expanded(bias, u)), unit, limit)] if math.isfinite(value) else []


def _diagonals(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return E, R and B of each diagonal, the largest E of the body diagonals, and squareness."""
    merits, body = list[FigureOfMerit](), list[str]()
    for name in map(str, errors["diagonal"].values):
        for figure in OTHER_FIGURES:
            merit = _merit(errors.sel(diagonal=name), figure, f"{figure} of {name} (ISO 230-6)", "m")
            merits += merit
            if merit and figure == "E" and "0" not in name:
                body.append(name)
    if len(body) > 1:
        merits.append(_largest_of(errors, body))
    for name in map(str, errors["squareness_of"].values):
        variance = errors["squareness_covariance"].sel(squareness_of=name, squareness_of_=name)
        value = float(errors["squareness"].sel(squareness_of=name))
        effects = errors["squareness_influence"].sel(squareness_of=name)
        influence = dict(zip(map(str, errors["source"].values), effects.values.tolist(), strict=True))
        U = 2.0 * math.sqrt(float(variance))
        merits.append(FigureOfMerit(f"squareness {name} by diagonals", value, U, "rad", influence=influence))
    return merits


def _largest_of(errors: xr.Dataset, diagonals: Sequence[str]) -> FigureOfMerit:
    """Return the largest E of some diagonals.

    The largest of several uncertain figures is too large on average. This excess is added to the bias of the figure.
    """
    of = errors.sel(diagonal=list(diagonals), figure="E")
    value, bias, u = (of[f"figure_{part}"].values for part in ("value", "bias", "u"))
    distribution = largest(value[:, None], (u**2)[:, None, None], np.zeros((0, value.size, 1)))
    U = float(expanded(bias[distribution.place] + distribution.bias, distribution.u))
    return FigureOfMerit("largest E of the body diagonals (ISO 230-6)", distribution.value, U, "m")


def _distortion(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return the ranges of the changes at both ends, and of the length between them."""
    merits = []
    for freedom in map(str, errors["freedom"].values):
        unit = "m" if freedom[1] in "XYZ" else "rad"
        for quantity in map(str, errors["quantity"].values):
            for measure, meaning in DISTORTIONS.items():
                value, u = (
                    float(errors[name].sel(freedom=freedom, quantity=quantity, measure=measure))
                    for name in ("distortion", "distortion_u")
                )
                if math.isfinite(value):
                    title = f"{freedom} at {quantity} {meaning} (ISO 230-3)"
                    merits.append(FigureOfMerit(title, value, 2.0 * u, unit))
    return merits
