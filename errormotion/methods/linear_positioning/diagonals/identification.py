"""From displacements along diagonals to the figures of ISO 230-6, the errors along them, and squareness.

Each diagonal is a line of the measurement model, like the freedoms of an axis. The scale error of the instrument is the
same for all diagonals; errors of alignment and drift are independent.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.measurement import Observed, Places
from errormotion.methods.linear_positioning.diagonals.lines import squareness_of
from errormotion.methods.linear_positioning.identification import model
from errormotion.methods.linear_positioning.identification.identify import Evaluated, statistics_of
from errormotion.methods.linear_positioning.identification.reading import (
    MIN_TARGETS,
    Readings,
    approaches_of,
    by_approach,
    instrument,
    labels,
    point_of,
)
from errormotion.methods.linear_positioning.identification.standard import FIGURES
from errormotion.methods.linear_positioning.schema import APPROACHES
from errormotion.methods.linear_positioning.settings import LinearPositioningSettings

if TYPE_CHECKING:
    from errormotion.estimation.datum import Relative
    from errormotion.measurement.observed import Solved

DIMS = ("diagonal", "target")
MAX_OFF_LINE = 2e-6
"""Largest distance of a stop from the line of its diagonal, m: positions are commanded to 1 um."""
REFERENCE = "first stop of each diagonal, approached forward, at the temperature of the test"
_METRE = {"units": "m"}


def evaluate(raw: xr.Dataset, settings: LinearPositioningSettings) -> Evaluated:
    """Return the readings along the diagonals that follow their schema, and their variances.

    Raises
    ------
    MethodError
        Stops that are not on a line, diagonals of the same name, readings that do not determine the result.
    """
    names = labels(raw, "diagonal")
    if not names or len(set(names)) < len(names):
        raise MethodError(
            f"diagonal: expected a different name for each diagonal; found {', '.join(names) or 'none'}",
            code="diagonal.names",
        )
    notes: list[str] = []
    approach = approaches_of(raw)
    points = _points(raw)
    units = np.array([_unit(name, stops) for name, stops in zip(names, points, strict=True)])
    position = np.einsum("dsi,di->ds", points - points[:, :1], units)
    x = raw["diagonal_deviation"].transpose("diagonal", "approach", "run", "stop").values.astype(float)
    for name, values in zip(names, x, strict=True):
        if not np.isfinite(values).any():
            raise MethodError(f"Diagonal {name}: expected readings; found none", code="diagonal.no_reading")
        if count := int(np.isnan(values).sum()):
            notes.append(f"Diagonal {name}: {count} of {values.size} readings are missing; the others are evaluated.")
    lines = np.ones(len(names), dtype=bool)
    readings = Readings(
        names=names,
        x=by_approach(x, approach, axis=1),
        position=position,
        lever=position,
        **instrument(raw, settings, lines, notes),
        gain=np.zeros(len(names)),
        at_target=np.zeros(len(names)),
        straight=~lines,
        sides=(),
        approach=approach,
        order=np.arange(position.shape[1]),
        axis="",
        attrs=raw.attrs,
    )
    trends = model.trends_of(readings)
    notes += model.trend_notes(readings, trends)
    return Evaluated(readings, model.spreads_of(readings, settings, "Diagonal "), notes, trends, settings.cycle)


def observe(raw: xr.Dataset, evaluated: Evaluated, settings: LinearPositioningSettings) -> Observed:
    """Return the readings along diagonals as a measurement model, with the errors along each over its stops."""
    readings, notes = evaluated.readings, [*evaluated.notes]
    points, (count, m) = _points(raw), readings.position.shape
    units = np.array([_unit(name, stops) for name, stops in zip(readings.names, points, strict=True)])
    line, stop = (i.ravel() for i in np.indices((count, m)))
    known = model.known_of(readings).ravel()
    square = [name for name, *_ in squareness_of(list(units))]
    if np.abs(units).min() > 0.0:
        notes.append(
            "Body diagonals alone do not separate linear errors, straightness, angles and squareness of the axes: "
            "different combinations of errors result in the same four diagonals. Face diagonals show squareness."
        )
    return model.observed(
        readings,
        model.problem_of(readings, evaluated.spreads),
        readings.names,
        evaluated.trends,
        places=Places(
            lambda x, _: (x.target[np.arange(line.size), line] + known)[:, None], line.size, rows={"target": stop}
        ),
        sensitivity=np.concatenate([units[line], np.zeros((line.size, 3))], axis=1),
        recorded=("diagonal_deviation", ("run", "approach", "stop", "diagonal")),
        freedoms=("EX",),
        dims=DIMS,
        coords={
            "diagonal": ("diagonal", list(readings.names), {"long_name": "diagonal of the volume"}),
            "approach": list(APPROACHES),
            "figure": list(FIGURES),
            "direction": list("xyz"),
            "squareness_of": square,
            "squareness_of_": square,
        },
        component="tool",
        functional_point=point_of(raw, settings, notes).tolist(),
        reference=REFERENCE,
        extras={
            "distance": xr.DataArray(
                readings.position, dims=DIMS, attrs={**_METRE, "long_name": "from the first stop"}
            ),
            "stop_point": xr.DataArray(points, dims=(*DIMS, "direction"), attrs=_METRE),
        },
        notes=notes,
    )


def _points(raw: xr.Dataset) -> Array:
    """Return the commanded positions, (diagonal, stop, 3), m."""
    points = np.asarray(raw["stop_point"].transpose("diagonal", "stop", "direction").values, dtype=float)
    if "direction" in raw.coords:
        points = points[..., [labels(raw, "direction").index(axis) for axis in "xyz"]]
    return points


def _unit(name: str, points: Array) -> Array:
    """Return the direction of a diagonal with stops (stop, 3); MethodError if they are not on a line, in order."""
    if len(points) < MIN_TARGETS:
        raise MethodError(
            f"stop_point of {name}: expected {MIN_TARGETS} positions or more; found {len(points)}",
            code="diagonal.stops.too_few",
        )
    span = points[-1] - points[0]
    length = float(np.linalg.norm(span))
    if not (np.isfinite(points).all() and length > 0.0):
        raise MethodError(
            f"stop_point of {name}: expected positions on a line; found NaN, or a last stop that is the first one",
            code="diagonal.stops.no_line",
        )
    unit = span / length
    distance = (points - points[0]) @ unit
    off = np.linalg.norm(points - points[0] - distance[:, None] * unit, axis=1).max()
    if off > MAX_OFF_LINE or (np.diff(distance) <= 0.0).any():
        raise MethodError(
            f"stop_point of {name}: expected positions on a line, in order; found one {off * 1e6:.1f} um off the line, "
            "or out of order",
            code="diagonal.stops.no_line",
        )
    return np.asarray(unit)


def squareness(observed: Observed, relative: Relative) -> dict[str, xr.DataArray]:
    """Return each squareness that the diagonals determine, with covariance and the effect of every source.

    The slopes are those of least-squares lines through the mean bidirectional deviations.
    """
    distance, errors = observed.extras["distance"].values, relative.errors
    units = np.asarray(observed.sensitivity).reshape(*distance.shape, 6)[:, 0, :3]
    value, weights = np.reshape(errors.value, distance.shape), []
    for _, k, other, coefficient in squareness_of(list(units)):
        weight = np.zeros(distance.shape)
        for i, sign in ((k, 1.0), (other, -1.0)):
            known = np.isfinite(value[i])
            lever = np.where(known, distance[i] - distance[i, known].mean(), 0.0)
            weight[i] = sign * lever / (lever @ lever) / coefficient
        weights.append(weight.ravel())
    W = np.array(weights).reshape(len(weights), distance.size)
    influence = W @ np.nan_to_num(errors.influence[..., 0]).T
    covariance = (W * np.nan_to_num(errors.own[:, 0, 0])) @ W.T + influence @ influence.T
    dims, rad = ("squareness_of", "squareness_of_"), {"units": "rad"}
    return {
        "squareness": xr.DataArray(W @ np.nan_to_num(value).ravel(), dims=dims[:1], attrs=rad),
        "squareness_covariance": xr.DataArray(covariance, dims=dims, attrs={"units": "rad^2"}),
        "squareness_influence": xr.DataArray(influence, dims=(dims[0], "source"), attrs=rad),
    }


def extras(evaluated: Evaluated, solved: Solved, settings: LinearPositioningSettings) -> dict[str, xr.DataArray]:
    """Return the statistics of the standard at each stop, and the figures."""
    return statistics_of(evaluated, solved, settings, DIMS, _METRE)[1]
