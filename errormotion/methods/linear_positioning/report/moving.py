"""The chapter of a moving axis: the ranges of ISO 230-3, then the generic chapter."""

from __future__ import annotations

import xarray as xr

from errormotion.datasets.results.places import coordinate_of
from errormotion.report.elements import Chapter, Column, On, Section, Table
from errormotion.report.parts import generic
from errormotion.report.text import fixed

MEASURES = {
    "range_60min": "first 60 min",
    "range_moving": "moving",
    "range_total": "whole test",
    "end_of_moving": "at the end of moving",
}


def _freedoms(errors: xr.Dataset) -> list[xr.Dataset]:
    """Return each measured freedom, with the positions of the ends as text."""
    place = 1e3 * errors[coordinate_of(errors, "position")].values
    ends = {f"P{k + 1}": fixed(value, 1) for k, value in enumerate(place)}
    found = []
    for name in map(str, errors["freedom"].values):
        one = errors.sel(freedom=name).assign_attrs(freedom=name, **ends)
        one["distortion"] = one["distortion"].assign_attrs(units="m" if name[1] in "XYZ" else "rad")
        found.append(one)
    return found


_DISTORTION = Table(
    "Ranges of {freedom}, and its change at the end of moving, at P1 = {P1} mm, P2 = {P2} mm, and of their difference. "
    "After ±: expanded uncertainty, k = 2.",
    tuple(
        Column(
            "distortion",
            select={"measure": measure},
            head=head,
            signed=measure == "end_of_moving",
            reason="test too short",
        )
        for measure, head in MEASURES.items()
    ),
    over="quantity",
    head="place",
)

CHAPTER = Chapter(
    "Thermal distortion by the moving axis {component}",
    (Section("distortion", "Figures of ISO 230-3", (On(_freedoms, (_DISTORTION,)),)), *generic.CHAPTER.parts),
)
