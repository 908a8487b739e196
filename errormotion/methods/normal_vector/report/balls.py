"""The balls and touches of a result: which centres are well known, where the balls went, which readings were used."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.methods.normal_vector.schema import EACH
from errormotion.report.elements import Of

USED, MISSING, WRONG, MOVED, UNDETERMINED = range(5)
"""Values of ``left_out``."""
KINDS = (
    (MISSING, "missing"),
    (WRONG, "outliers"),
    (MOVED, "of a ball that had moved"),
    (UNDETERMINED, "of a cycle that is not determined"),
)
MAX_UNCERTAINTY = 5.0
"""Uncertainty of a centre, relative to the median of all, above which it is not drawn."""
_CENTRES = ("time", "ball", "direction")


def names_of(errors: xr.Dataset) -> list[str]:
    """Return the names of the balls, or numbers."""
    if "ball" in errors.coords:
        return [str(name) for name in errors["ball"].values]
    return [f"B{i + 1}" for i in range(errors.sizes.get("ball", 0))]


def displacement(errors: xr.Dataset) -> Array:
    """Return the apparent displacements of the balls, (time, ball, 3), m; NaN where unknown."""
    if not {"centre", "ball_displacement"} <= set(errors.data_vars):
        return np.full((errors.sizes["time"], 0, 3), np.nan)
    return np.asarray(errors["ball_displacement"].transpose(*_CENTRES).values, float)


def centres(errors: xr.Dataset) -> tuple[Array, Array]:
    """Return the apparent centres of the balls and their standard uncertainties, (time, ball, 3), m."""
    found = Of("centre").read(errors)
    assert found is not None
    values = np.asarray(found.values.transpose(*_CENTRES).values, float)
    u = np.full_like(values, np.nan) if found.u is None else np.asarray(found.u.transpose(*_CENTRES).values, float)
    return values, u


def well_known(errors: xr.Dataset) -> NDArray[np.bool_]:
    """Return centres with usual uncertainty, (time, ball): with missing touches one can be nearly undetermined."""
    moved = displacement(errors)
    measured = np.isfinite(moved).all(axis=2)
    if not measured.size:
        return measured
    worst = centres(errors)[1].max(axis=2)
    known = worst[np.isfinite(worst)]
    return np.asarray(measured & ~(worst > (MAX_UNCERTAINTY * float(np.median(known)) if known.size else np.inf)))


def moved(errors: xr.Dataset) -> NDArray[np.bool_]:
    """Return whether a ball had moved on the table, (time, ball)."""
    if "ball_moved" not in errors:
        return np.zeros(displacement(errors).shape[:2], bool)
    return np.asarray(np.nan_to_num(errors["ball_moved"].transpose("time", "ball").values) > 0)


def moved_names(errors: xr.Dataset) -> list[str]:
    """Return the balls that moved on the table at any time."""
    return [name for name, own in zip(names_of(errors), moved(errors).T, strict=False) if own.any()]


def travelled(errors: xr.Dataset) -> xr.Dataset | None:
    """Return the cold centre of each ball, and its displacement in the last cycle in which it is well known."""
    away, known = displacement(errors), well_known(errors)
    if not away.size:
        return None
    (centre, u), every, had = centres(errors), np.arange(away.shape[1]), moved(errors)
    first, last = known.argmax(axis=0), len(known) - 1 - known[::-1].argmax(axis=0)
    never = ~known.any(axis=0)
    # The cold and the last centre have independent uncertainties from their own touches.
    cold, step, step_u = centre[first, every], away[last, every], np.hypot(u[last, every], u[first, every])
    size = np.where(known, np.linalg.norm(away, axis=2), 0.0).max(axis=0)
    since = np.where(had.any(axis=0), [f"from cycle {k}" for k in had.argmax(axis=0)], "no")
    metre = {"units": "m"}
    for values in (cold, step, step_u, size):
        values[never] = np.nan
    return xr.Dataset(
        {
            "cold": (("ball", "direction"), cold, metre),
            "moved": (("ball", "direction"), step, metre),
            "moved_u": (("ball", "direction"), step_u, metre),
            "largest": ("ball", size, metre),
            "since": ("ball", np.where(never, "no cycle", since)),
        },
        {"ball": names_of(errors), "direction": list("xyz")},
    )


# ---------------------------------------------------------------------- touches


def what(errors: xr.Dataset) -> str:
    """Return the name of the measured numbers."""
    return "touches" if "residual" not in errors or EACH in errors["residual"].dims else "coordinates"


def residuals(errors: xr.Dataset) -> tuple[Array, NDArray[np.int64]]:
    """Return the residuals in m and the codes of their use, (time, ball, touch)."""
    if "residual" not in errors:
        return np.full((errors.sizes["time"], 0, 0), np.nan), np.zeros((errors.sizes["time"], 0, 0), np.int64)
    values = errors["residual"].transpose("time", "ball", ...)
    code = errors["left_out"].transpose(*values.dims).values if "left_out" in errors else np.full(values.shape, np.nan)
    return np.asarray(values.values, float), np.nan_to_num(code, nan=MISSING).astype(np.int64)


def used(errors: xr.Dataset) -> Array:
    """Return the residuals of the used readings, m; NaN elsewhere."""
    values, code = residuals(errors)
    return np.where(code == USED, values, np.nan)


def kept(errors: xr.Dataset) -> xr.DataArray | None:
    """Return the residuals of the used readings."""
    if "residual" not in errors:
        return None
    dims = errors["residual"].transpose("time", "ball", ...).dims
    return xr.DataArray(used(errors), dims=dims, attrs={"units": "m"})


def counted(code: int) -> Callable[[xr.Dataset], xr.DataArray | None]:
    """Return the reader of which readings have a code of use."""

    def of(errors: xr.Dataset) -> xr.DataArray | None:
        found = kept(errors)
        return None if found is None else found.copy(data=residuals(errors)[1] == code).assign_attrs(units="1")

    return of
