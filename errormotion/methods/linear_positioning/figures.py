"""Figures of merit: those of ISO 230-2 for the positioning, and the accuracy of the other freedoms."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from errormotion.datasets.results.merit import is_planned
from errormotion.methods.linear_positioning.identification.standard import FIGURES
from errormotion.plugins import FigureOfMerit

if TYPE_CHECKING:
    import xarray as xr

LIMITS = {"A": "accuracy_limit", "R": "repeatability_limit", "B": "reversal_limit"}
OTHERS = ("E", "R", "B")
"""Figures that are shown of straightness and angles."""
DISTORTIONS = {"range_60min": "within the first 60 min, range", "range_moving": "while the axis moved, range"}
"""Figures that are shown of a test with a moving axis."""


def figures(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return the figures as the standard defines them; none for a plan.

    The expanded uncertainty is ``2 u`` plus the mean excess that scatter gives to an extreme value, which the standard
    does not remove (JCGM 100, F.2.4.5).
    """
    if is_planned(errors):
        return []
    if "distortion" in errors:
        return _distortion(errors)
    if "squareness" in errors:
        return _diagonals(errors)
    found = []
    for freedom in map(str, errors["freedom"].values):
        of = errors.sel(freedom=freedom)
        along = freedom[1] == freedom[2]
        unit = "m" if freedom[1] in "XYZ" else "rad"
        for name in FIGURES if along else OTHERS:
            value, bias, u = (float(of[part].sel(figure=name)) for part in ("figure_value", "figure_bias", "figure_u"))
            if math.isfinite(value):
                limit = errors.attrs.get(LIMITS.get(name, "")) if along else None
                title = f"{name} of {freedom} (ISO 230-2)"
                found.append(FigureOfMerit(title, value, 2.0 * u + abs(bias), unit, limit))
    return found


def _diagonals(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return E, R and B of each diagonal, the largest E of the body diagonals, and squareness."""
    found, body = [], []
    for name in map(str, errors["diagonal"].values):
        of = errors.sel(diagonal=name)
        for figure in OTHERS:
            value, bias, u = (
                float(of[part].sel(figure=figure)) for part in ("figure_value", "figure_bias", "figure_u")
            )
            if math.isfinite(value):
                found.append(FigureOfMerit(f"{figure} of {name} (ISO 230-6)", value, 2.0 * u + abs(bias), "m"))
                if figure == "E" and "0" not in name:
                    body.append(found[-1])
    if len(body) > 1:
        largest = max(body, key=lambda each: each.value)
        found.append(replace(largest, name="largest E of the body diagonals (ISO 230-6)"))
    for name in map(str, errors["squareness_of"].values):
        variance = errors["squareness_covariance"].sel(squareness_of=name, squareness_of_=name)
        value = float(errors["squareness"].sel(squareness_of=name))
        effects = errors["squareness_influence"].sel(squareness_of=name)
        influence = dict(zip(map(str, errors["source"].values), effects.values.tolist(), strict=True))
        U = 2.0 * math.sqrt(float(variance))
        found.append(FigureOfMerit(f"squareness {name} by diagonals", value, U, "rad", influence=influence))
    return found


def _distortion(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return the largest changes at both ends, and of the length between them."""
    found = []
    for freedom in map(str, errors["freedom"].values):
        unit = "m" if freedom[1] in "XYZ" else "rad"
        for quantity in map(str, errors["quantity"].values):
            for measure, words in DISTORTIONS.items():
                value, u = (
                    float(errors[name].sel(freedom=freedom, quantity=quantity, measure=measure))
                    for name in ("distortion", "distortion_u")
                )
                if math.isfinite(value):
                    title = f"{freedom} at {quantity} {words} (ISO 230-3)"
                    found.append(FigureOfMerit(title, value, 2.0 * u, unit))
    return found
