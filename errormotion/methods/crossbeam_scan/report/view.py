"""A campaign of crossbeam scans as arrays over (time, position); any part may be missing."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.estimation.extremes import Largest
from errormotion.kinematics.iso import iso_names
from errormotion.report.budget import FREEDOMS
from errormotion.report.fields import field
from errormotion.report.text import fixed

AXES = ("time", "position")
NO_REASON = "no value; the result states no reason"


def is_campaign(errors: xr.Dataset) -> bool:
    """Return whether a dataset is the result of a campaign of crossbeam scans."""
    return errors.attrs.get("method") == "crossbeam_scan" and set(AXES) <= set(errors["EX"].dims)


def is_pose(errors: xr.Dataset) -> bool:
    """Return whether a dataset is the pose of a profiler."""
    return errors.attrs.get("method") == "crossbeam_scan" and "profiler_pose" in errors and "beam" in errors.dims


@dataclass(frozen=True)
class Campaign:
    """The six errors of an axis over warm-up time and position, with further results of the method.

    Attributes
    ----------
    errors : Dataset
        The error dataset.
    time : (t,)
        Warm-up time of each cycle, s.
    position : (p,)
        Of the axis over each artefact, m.
    scan_time : (t, p)
        Warm-up time of each scan, s; that of the cycle where it is not known.
    values, sigma : (t, p, 6)
        Errors and standard uncertainties, m and rad; NaN where unknown.
    reason : (t, p) of str
        Why there is no value; empty where there is one.
    reference : (t,) of bool
        Which cycles are the cold state, to which all others are relative.
    """

    errors: xr.Dataset
    time: Array
    position: Array
    scan_time: Array
    values: Array
    sigma: Array
    reason: NDArray[np.str_]
    reference: NDArray[np.bool_]
    _extremes: dict[int, Largest | None] = dataclasses.field(default_factory=dict, repr=False)

    @property
    def names(self) -> dict[str, str]:
        """ISO 230-1 name of each freedom; the freedom's own where the standard has none."""
        try:
            return iso_names(str(self.errors.attrs.get("component", "")))
        except ValueError:
            return {name: name for name in FREEDOMS}

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether any freedom has a value, (t, p)."""
        return np.asarray(np.isfinite(self.values).any(axis=2))

    @property
    def warm(self) -> NDArray[np.intp]:
        """Indices of the cycles that are compared with the cold state."""
        return np.flatnonzero(~self.reference)

    @property
    def absent(self) -> NDArray[np.bool_]:
        """Whether the scan is missing, (t, p); False everywhere if the dataset does not state scan times."""
        if "scan_time" not in self.errors:
            return np.zeros_like(self.known)
        return np.asarray(~self.known & ~np.isfinite(field(self.errors, "scan_time", *AXES)))

    def get(self, name: str, *dims: str) -> Array:
        """Return a variable over (time, position, and these dims); NaN where the dataset does not contain it."""
        if name in self.errors and set(self.errors[name].dims) == {*AXES, *dims}:
            return field(self.errors, name, *AXES, *dims)
        sizes = tuple(self.errors.sizes.get(dim, 1) for dim in (*AXES, *dims))
        return np.full(sizes, np.nan)

    def largest(self, freedom: int) -> tuple[int, int] | None:
        """Return (cycle, artefact) of the largest error of a freedom when warm; None where it is unknown."""
        found = self.extreme(freedom)
        if found is None:
            return None
        dims = self.errors.em.dims
        place = np.unravel_index(found.place, [self.errors.sizes[dim] for dim in dims])
        cycle, artefact = (int(place[dims.index(dim)]) for dim in AXES)
        return cycle, artefact

    def extreme(self, freedom: int) -> Largest | None:
        """Return the largest error of a freedom when warm, with its bias by noise; None where it is unknown."""
        if freedom not in self._extremes:
            em = self.errors.em
            among = xr.DataArray(np.broadcast_to(~self.reference[:, None], self.values.shape[:2]), dims=AXES)
            self._extremes[freedom] = em.largest(FREEDOMS[freedom], among=among.transpose(*em.dims))
        return self._extremes[freedom]

    def shown(self) -> tuple[int, int] | None:
        """Return (cycle, artefact) of the registration to show: the last of the artefact with the largest error.

        The largest displacement is used; the largest rotation where no displacement is known.
        """
        warm = np.where(self.reference[:, None, None], np.nan, np.abs(self.values))
        for columns in (slice(0, 3), slice(3, 6)):
            if np.isfinite(warm[..., columns]).any():
                of_artefact = np.nanmax(np.where(np.isfinite(warm), warm, -1.0)[..., columns], axis=(0, 2))
                artefact = int(np.argmax(of_artefact))
                cycles = np.flatnonzero(self.known[:, artefact] & ~self.reference)
                return int(cycles[-1]), artefact
        return None

    def where(self, cycle: int, artefact: int) -> str:
        """Return position and time of one registration as text."""
        return f"{at_y(self.position[artefact])}, {after(self.time[cycle])}"


def campaign(errors: xr.Dataset) -> Campaign:
    """Return the view of a dataset over time and position."""
    values = np.stack([field(errors, name, *AXES) for name in FREEDOMS], axis=-1)
    variance = field(errors, "covariance", *AXES, "dof", "dof_")
    variance = np.diagonal(variance, axis1=2, axis2=3)
    sigma = np.sqrt(np.where(variance >= 0, variance, np.nan))
    shape = values.shape[:2]
    time = np.asarray(errors["time"].values, float) if "time" in errors.coords else np.arange(1.0, shape[0] + 1)
    scan_time = np.broadcast_to(time[:, None], shape)
    if "scan_time" in errors:
        stated = field(errors, "scan_time", *AXES)
        scan_time = np.where(np.isfinite(stated), stated, scan_time)
    zero = np.nan_to_num(values) == 0
    reference = (zero & (np.nan_to_num(sigma) == 0)).all(axis=(1, 2)) & (time <= 0)
    scan_time = np.where(reference[:, None], time[:, None], scan_time)  # the cold scan is at time 0
    return Campaign(errors, time, positions(errors), scan_time, values, sigma, _reasons(errors, values), reference)


def positions(errors: xr.Dataset) -> Array:
    """Return the position of the axis over each artefact, m."""
    for name in (str(errors.attrs.get("component", "")).lower(), "y", "position"):
        if name in errors.coords and errors[name].dims == ("position",) and errors[name].dtype.kind in "iuf":
            return np.asarray(errors[name].values, float)
    return np.arange(1.0, errors.sizes["position"] + 1) * 1e-3


def _reasons(errors: xr.Dataset, values: Array) -> NDArray[np.str_]:
    holes = ~np.isfinite(values).any(axis=2)
    stated = np.full(holes.shape, "", dtype=object)
    if "reason" in errors and set(errors["reason"].dims) == set(AXES):
        stated = errors["reason"].transpose(*AXES).values.astype(str).astype(object)
    text = [str(words).strip().rstrip(".") or NO_REASON for words in stated.ravel()]
    return np.where(holes, np.array(text, dtype=str).reshape(holes.shape), "")


def millimetres(position: float) -> str:
    """Return a position in mm, with decimals where it has any."""
    return trimmed(fixed(1e3 * position, 3))


def at_y(position: float) -> str:
    """Return a position as text without line breaks."""
    return f"y\u00a0=\u00a0{millimetres(position)}\u00a0mm"


def after(seconds: float) -> str:
    """Return a warm-up time as text."""
    return "cold" if seconds == 0 else f"{trimmed(fixed(seconds / 60, 1))}\u00a0min"


def trimmed(number: str) -> str:
    """Return a number without trailing zeros after its decimal sign."""
    return number.rstrip("0").rstrip(".,") if re.search("[.,]", number) else number
