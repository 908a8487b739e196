"""Figures of merit of a result: the volumetric error over the targets, and the squareness of the axes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import xarray as xr

from errormotion.estimation.extremes import expanded
from errormotion.kinematics.iso import DOF
from errormotion.plugins import FigureOfMerit


def figures(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return the largest and the root mean square volumetric error, and every determined squareness."""
    return [*_volumetric(errors), *_squareness(errors)]


def root_mean_square(errors: xr.Dataset) -> tuple[float, float]:
    """Return the root mean square volumetric error of the known targets, and its U (k = 2), m."""
    mean = errors.em.root_mean_square(*DOF[:3])
    e = np.stack([errors[name].values for name in DOF[:3]], axis=-1)
    variance = np.einsum("ti,tij,tj->t", e, errors["covariance"].values[:, :3, :3], e)[np.isfinite(e).all(axis=1)]
    value = float(mean.value)
    # For any correlation of the errors of targets, an upper limit of u, to first order.
    most = float(np.mean(np.sqrt(variance))) / value if value > 0 else 0.0
    return value, float(expanded(mean.bias, np.maximum(mean.u, most)))


def _volumetric(errors: xr.Dataset) -> Iterator[FigureOfMerit]:
    if errors["EX"].dims != ("target",) or errors["covariance"].dims[:-2] != ("target",):
        return
    largest = errors.em.largest(*DOF[:3])
    if largest is None or not largest.value > 0:
        return
    targets = errors["target"].values if "target" in errors.coords else np.arange(1, errors.sizes["target"] + 1)
    name = f"largest volumetric error, target {targets[largest.place]}"
    yield FigureOfMerit(name, largest.value, largest.expanded, "m")
    known = int(np.isfinite(errors["EX"].values).sum())
    yield FigureOfMerit(f"root mean square volumetric error, {known} targets", *root_mean_square(errors), "m")


def _squareness(errors: xr.Dataset) -> Iterator[FigureOfMerit]:
    for name in sorted(str(name) for name in errors.data_vars):
        if len(name) == 4 and name[0] == "E" and name[2] == "0" and np.isfinite(errors[name].values).all():
            value, u = float(errors[name]), float(errors[f"{name}_u"])
            yield FigureOfMerit(f"squareness {name}", value, 2 * u, "rad")
