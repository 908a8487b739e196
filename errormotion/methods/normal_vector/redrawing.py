"""Redrawing of touches of balls for the Monte Carlo method; their noise is the only source."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.methods.normal_vector.identification.identify import fitted
from errormotion.methods.normal_vector.identification.reading import read
from errormotion.plugins import Redraw, Redrawing, replaced

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.arrays import Array
    from errormotion.methods.normal_vector.settings import Settings


def redrawing(raw: xr.Dataset, settings: Settings, errors: xr.Dataset) -> Redrawing:
    """Return the touches or centres that the result is based on, and their noise."""
    touched = "touch" in raw.variables
    name, dims = ("touch", ("time", "ball", "touch")) if touched else ("centre", ("time", "ball", "direction"))
    used = errors["left_out"].transpose(*dims).values == 0
    used = used[..., None] if touched else used.all(axis=-1, keepdims=True)
    order = (*dims, "direction") if touched else dims
    values = np.asarray(raw.variables[name].transpose(*order).values, dtype=float)
    reduced = raw.load().assign({name: (order, np.where(used, values, np.nan), raw.variables[name].attrs)})
    stated = settings.model_copy(
        update={"robust": False, "functional_point": tuple(map(float, errors.attrs["functional_point"]))}
    )
    noise, freedom = float(errors["noise"]), None
    data = read(raw, settings, [])
    if not np.isfinite(data.noise):
        fit = fitted(data, settings)[2].fit
        noise, freedom = float(np.sqrt(fit.chi2 / fit.freedom)), fit.freedom
    return Redrawing(reduced, stated, {"touches": _noise(noise, freedom, name, reduced, values, errors)})


def _noise(
    noise: float,
    freedom: int | None,
    name: str,
    raw: xr.Dataset,
    values: Array,
    errors: xr.Dataset,
) -> Redraw:
    """Return the noise of the touches along their normals, or of the centres from their covariance.

    A noise that was estimated from residuals with ``freedom`` degrees of freedom is drawn as well, so that the values
    have a t-distribution: JCGM 101, 6.4.9.
    """
    if name == "touch":
        outward = values - errors["centre"].transpose("time", "ball", "direction").values[:, :, None]
        factor = np.nan_to_num(outward / np.linalg.norm(outward, axis=-1, keepdims=True))[..., None]
    elif "centre_covariance" in raw:
        C = raw["centre_covariance"].transpose("time", "ball", "direction", "direction_").values
        known = np.isfinite(C).all(axis=(2, 3), keepdims=True)
        factor = np.linalg.cholesky(np.where(known, C, np.eye(3)))
    else:
        factor = np.broadcast_to(np.eye(3), (*values.shape, 3))

    def draw(changed: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        size = noise if freedom is None else noise * float(np.sqrt(freedom / generator.chisquare(freedom)))
        shift = factor @ generator.normal(0.0, size, (*factor.shape[:-2], factor.shape[-1], 1))
        return replaced(changed, {name: changed.variables[name].values + shift[..., 0]}), settings

    return Redraw(draw, groups=("cold reference",), own=True)
