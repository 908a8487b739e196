"""Figures of merit of a result: the volumetric error over the targets, and the squareness of the axes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import xarray as xr

from errormotion.plugins import FigureOfMerit


def figures(errors: xr.Dataset) -> list[FigureOfMerit]:
    """Return the largest and the root mean square volumetric error, and every determined squareness."""
    return [*_volumetric(errors), *_squareness(errors)]


def _volumetric(errors: xr.Dataset) -> Iterator[FigureOfMerit]:
    if errors["EX"].dims != ("target",) or errors["covariance"].dims[:-2] != ("target",):
        return
    e = np.stack([errors[name].values for name in ("EX", "EY", "EZ")], axis=-1)
    C = errors["covariance"].values[:, :3, :3]
    size = np.linalg.norm(e, axis=1)
    known = np.isfinite(size) & (size > 0)
    if not known.any():
        return
    e, C, size = e[known], C[known], size[known]
    sigma = np.sqrt(np.einsum("ti,tij,tj->t", e, C, e)) / size
    worst, rms = int(np.argmax(size)), float(np.sqrt(np.mean(size**2)))
    name = errors["target"].values[known][worst] if "target" in errors.coords else np.flatnonzero(known)[worst] + 1
    yield FigureOfMerit(f"largest volumetric error, target {name}", float(size[worst]), 2 * float(sigma[worst]), "m")
    # For any correlation of the errors of targets, an upper limit of u of the root mean square, to first order.
    spread = float(np.mean(size * sigma)) / rms
    yield FigureOfMerit(f"root mean square volumetric error, {len(size)} targets", rms, 2 * spread, "m")


def _squareness(errors: xr.Dataset) -> Iterator[FigureOfMerit]:
    for name in sorted(str(name) for name in errors.data_vars):
        if len(name) == 4 and name[0] == "E" and name[2] == "0" and np.isfinite(errors[name].values).all():
            value, u = float(errors[name]), float(errors[f"{name}_u"])
            yield FigureOfMerit(f"squareness {name}", value, 2 * u, "rad")
