"""The few numbers of an error dataset that a person looks at first."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr

SHOWN = {"m": (1e6, "um"), "rad": (648000 / np.pi, "arcsec")}


def last_values(errors: xr.Dataset) -> list[dict[str, Any]]:
    """Return value and expanded uncertainty (k = 2) of every freedom at the end of a drift.

    A dataset without ``time`` has no end, and gives an empty list.
    """
    if "time" not in errors.dims or errors.sizes["time"] == 0:
        return []
    found = []
    for k, name in enumerate(errors["dof"].values):
        values = np.asarray(errors[str(name)].values, dtype=float)
        seen = np.flatnonzero(np.isfinite(values))
        if values.ndim != 1 or seen.size == 0:
            continue
        last = int(seen[-1])
        factor, unit = SHOWN[errors[str(name)].attrs["units"]]
        variance = float(errors["covariance"].values[last, k, k])
        found.append(
            {
                "name": str(name),
                "value": float(values[last]) * factor,
                "expanded_uncertainty": 2.0 * np.sqrt(variance) * factor,
                "unit": unit,
                "time_min": float(errors["time"].values[last]) / 60.0,
            }
        )
    return found


def notes_of(errors: xr.Dataset) -> list[str]:
    """Return what is to be said of a result: figures that have no time, then what is missing, doubtful or assumed."""
    notes = [str(note) for note in np.atleast_1d(errors.attrs.get("notes", [])) if str(note)]
    if "planned" in str(errors.attrs.get("reference", "")):
        return notes
    figures = {"beam": _beams, "tool": _volume}.get(str(errors.attrs.get("component")))
    return [*(figures(errors) if figures is not None else ()), *notes]


def _beams(errors: xr.Dataset) -> Iterator[str]:
    """Yield the errors of each beam's zero point and direction, and the check bar that was measured with it."""
    if errors["covariance"].dims[:-2] == ("beam",):
        for i, beam in enumerate(errors["beam"].values):
            seen = [_told(errors, k, str(name), i) for k, name in enumerate(errors["dof"].values)]
            if any(seen):
                yield f"{beam} against nominal (U: k = 2): {', '.join(filter(None, seen))}."
    if "bar_radius_fitted" in errors:
        radius, u = float(errors["bar_radius_fitted"]), float(errors["bar_radius_u"])
        used = errors["bar_residual"].values[errors["bar_left_out"].values == 0]
        yield (
            f"Check bar: radius {1e3 * radius:.4f} mm (U = {2e3 * u:.4f} mm, k = 2), residual "
            f"{1e6 * np.sqrt(np.nanmean(used**2)):.2f} um rms."
        )


def _told(errors: xr.Dataset, k: int, name: str, beam: int) -> str:
    value, variance = float(errors[name].values[beam]), float(errors["covariance"].values[beam, k, k])
    if not np.isfinite(value):
        return ""
    factor, unit = SHOWN[errors[name].attrs["units"]]
    return f"{name} {value * factor:+.2f} {unit} (U = {2 * np.sqrt(variance) * factor:.2f})"


def _volume(errors: xr.Dataset) -> Iterator[str]:
    """Yield the largest and the root mean square volumetric error over targets."""
    if errors["EX"].dims != ("target",) or errors["covariance"].dims[:-2] != ("target",):
        return
    e = np.stack([errors[name].values for name in ("EX", "EY", "EZ")], axis=-1)
    C = errors["covariance"].values[:, :3, :3]
    size = np.linalg.norm(e, axis=1)
    known = np.isfinite(size) & (size > 0)
    if not known.any():
        return
    e, C, size = e[known], C[known], size[known]
    variance = np.einsum("ti,tij,tj->t", e, C, e) / size**2
    worst, rms = int(np.argmax(size)), float(np.sqrt(np.mean(size**2)))
    name = errors["target"].values[known][worst] if "target" in errors.coords else np.flatnonzero(known)[worst] + 1
    # However errors of targets go together, U of the rms is no more than this, to first order.
    spread = float(np.mean(size * np.sqrt(variance))) / rms
    yield (
        f"Volumetric error over {len(size)} targets: largest {1e6 * size[worst]:.2f} um at target {name} "
        f"(U = {2e6 * np.sqrt(variance[worst]):.2f} um, k = 2), root mean square {1e6 * rms:.2f} um "
        f"(U at most {2e6 * spread:.2f} um)."
    )
