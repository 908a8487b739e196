"""Input of the identification from a raw dataset: arrays in a fixed order, names, and first checks."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.normal_vector.identification.spheres import Observations
from errormotion.methods.normal_vector.schema import flag_text

if TYPE_CHECKING:
    import xarray as xr
    from numpy.typing import NDArray

    from errormotion.methods.normal_vector.settings import NormalVectorSettings

AXES = ("XYZ", "XY", "XZ", "YZ", "X", "Y", "Z", "")
"""Linear axes that may carry the tool."""


@dataclass(frozen=True)
class Readings:
    """Raw data as arrays.

    Attributes
    ----------
    seen : Observations
        With unit weights (1 / noise^2 where the noise is stated).
    names : list of str
        Names of the balls.
    tool_axes : str
    noise : float
        Stated standard deviation of a number, m; 1 if the weights are stated covariances; NaN if neither is stated.
    nominal : ndarray (b, 3) or None
        Approximate centres, m.
    radius : ndarray (b,)
        Nominal radius of ball plus tip, m; NaN if unknown.
    timed : bool
        Whether the time of each touch is known.
    """

    seen: Observations
    names: list[str]
    tool_axes: str
    noise: float
    nominal: Array | None
    radius: Array
    timed: bool

    @property
    def what(self) -> str:
        """What was read."""
        return "the touches" if self.seen.touched else "the centres"


def read(raw: xr.Dataset, settings: NormalVectorSettings, notes: list[str]) -> Readings:
    """Return the readings of a raw dataset.

    Raises
    ------
    MethodError
        No data, no cold cycle, or invalid ``tool_axes``, noise or covariances.
    """
    touched = "touch" in raw.variables  # has the name of a dimension, so that xarray treats it as a coordinate
    names = _names(raw)
    start = _array(raw, "time", "time")
    position = _array(raw, "touch", "time", "ball", "touch", "direction") if touched else _coordinates(raw)
    valid = np.all(np.isfinite(position), axis=-1)
    if "touch_flag" in raw:
        flag = _array(raw, "touch_flag", "time", "ball", "touch")
        notes += _flag_notes(flag)
        valid = valid & ~(flag > 0)
    if not valid.any():
        raise MethodError(
            "Expected touches of balls; found none that is good. Check the function of the probe.",
            code="probing.no_touches",
        )
    if settings.reference == "cold":
        _check_cold(start, valid)
    lost = int(valid.size - valid.sum()) // (1 if touched else 3)
    if lost:
        what = "touches" if touched else "centres"
        notes.append(f"{lost} of {valid.size // (1 if touched else 3)} {what} are missing.")
    timed = touched and "touch_time" in raw
    time = (
        _array(raw, "touch_time", "time", "ball", "touch")
        if timed
        else np.broadcast_to(start[:, None, None], valid.shape)
    )
    if timed:
        valid = valid & np.isfinite(time)
        _check_times(time, valid)
    elif settings.interpolate and touched:
        notes.append("The data have no times of the touches (touch_time): drift within a cycle is not corrected.")
    weight, noise = _weights(raw, settings, valid, touched)
    position = np.where(valid[..., None], position, 0.0)
    seen = Observations(position, weight, np.where(valid, time, 0.0), start, touched)
    nominal = _array(raw, "ball_nominal", "ball", "direction") if "ball_nominal" in raw else None
    radius = np.full(len(names), np.nan)
    if "ball_radius" in raw and touched:
        radius = _array(raw, "ball_radius", "ball") + float(raw["tip_radius"])
    axes = str(raw.attrs.get("tool_axes", settings.tool_axes))
    if axes not in AXES:
        raise MethodError(
            f"tool_axes: expected the linear axes that carry the tool, such as XYZ or Z; found '{axes}'",
            code="probing.tool_axes.form",
        )
    if "tool_axes" not in raw.attrs and "tool_axes" not in settings.model_fields_set:
        notes.append("Assumed, because it is not stated: X, Y and Z carry the tool (tool_axes = XYZ).")
    if "tool_axes" in raw.attrs and axes != settings.tool_axes and "tool_axes" in settings.model_fields_set:
        notes.append(
            f"The data state that {axes or 'no axis'} carries the tool; the setting {settings.tool_axes} was not used."
        )
    return Readings(seen, names, axes, noise, nominal, radius, timed)


def coordinates(raw: xr.Dataset, data: Readings) -> dict[str, Any]:
    """Return the coordinates of the result."""
    coords: dict[str, Any] = {
        "time": ("time", data.seen.cycle_time, {"units": "s"}),
        "cycle_time": ("time", data.seen.cycle_time, {"units": "s", "long_name": "start of the probing cycle"}),
        "ball": data.names,
        "direction": list("xyz"),
        "direction_": list("xyz"),
    }
    for name in ("temperature", "spindle_speed", "feed"):
        if name in raw:
            dims = ("time", "sensor") if name == "temperature" else ("time",)
            coords[name] = (
                dims,
                np.array(raw[name].transpose(*dims).values, float),
                {"units": raw[name].attrs["units"]},
            )
    if "sensor" in raw.coords and "temperature" in raw:
        coords["sensor"] = [str(name) for name in raw["sensor"].values]
    return coords


def check_balls(centre: Array, radius: Array, data: Readings, tolerance: float) -> None:
    """Raise MethodError if balls found at ``centre`` (b, 3) with ``radius`` (b,), m, differ from the stated ones."""
    nominal = data.nominal
    if nominal is not None and np.isfinite(nominal).all():
        away = np.linalg.norm(centre[:, None] - nominal, axis=2)
        off = np.diagonal(away)
        if (off > tolerance).any():
            i = int(np.argmax(off))
            j = int(np.argmin(away[i]))
            if j != i and away[i, j] < min(tolerance, off[i] / 2):
                raise MethodError(
                    f"Ball {data.names[i]} was found at the position of ball {data.names[j]}: expected the same order "
                    "of the balls in the program and in ball_nominal.",
                    code="probing.balls.order",
                )
            raise MethodError(
                f"Ball {data.names[i]} was found {off[i] * 1e3:.4g} mm from its nominal position; expected within "
                f"{tolerance * 1e3:g} mm (ball_tolerance). Check that both are in m and in machine coordinates.",
                code="probing.ball.elsewhere",
            )
    wrong = np.abs(radius - data.radius) > tolerance
    if wrong.any():
        i = int(np.argmax(wrong))
        raise MethodError(
            f"The touches of ball {data.names[i]} lie on a sphere of radius {radius[i] * 1e3:.4g} mm; expected "
            f"{data.radius[i] * 1e3:.4g} mm, ball plus tip. Check ball_radius and tip_radius, and their unit (m).",
            code="probing.ball.radius",
        )


def check_jumps(seen: Observations, names: list[str], tolerance: float) -> None:
    """Raise MethodError if touches of a cycle are far from those of the other cycles."""
    valid = seen.valid
    position = np.where(valid[..., None], seen.position, np.nan)
    median = np.nanmedian(position, axis=0) if valid.any(axis=0).all() else _median(position)
    off = np.linalg.norm(position - median, axis=-1)
    if not np.nanmax(off) > tolerance:
        return
    k, i, j = np.unravel_index(int(np.nanargmax(off)), off.shape)
    other = np.linalg.norm(position[k, i, j] - median[:, j], axis=-1)
    other[i] = np.inf
    where = f"In cycle {k} ball {names[i]}"
    if np.nanmin(other) < tolerance:
        raise MethodError(
            f"{where} was touched at the position of ball {names[int(np.nanargmin(other))]} in the other cycles: "
            "expected the same order of the balls in all cycles. Check the program and the record for lost touches.",
            code="probing.balls.order",
        )
    raise MethodError(
        f"{where} was touched {off[k, i, j] * 1e3:.4g} mm from its touches in the other cycles; expected within "
        f"{tolerance * 1e3:g} mm (ball_tolerance). Check whether the ball was displaced or another object was touched.",
        code="probing.ball.moved",
    )


def _median(position: Array) -> Array:
    import warnings

    with warnings.catch_warnings():  # directions without touches have no median
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.nanmedian(position, axis=0))


def _check_cold(start: Array, valid: NDArray[np.bool_]) -> None:
    late = len(start) > 1 and start[0] > (start[1] - start[0]) / 2
    if late:
        raise MethodError(
            f"The cold cycle is missing: expected the first cycle at 0 s; found it at {start[0]:g} s. Probe the cold "
            'machine, or use the first cycle as the reference (reference = "first").',
            code="probing.cold.missing",
        )
    if not valid[0].any():
        raise MethodError(
            "The cold cycle is missing: cycle 0 has no good touch. Probe the cold machine, or remove the empty cycle "
            'and use the first remaining one as the reference (reference = "first").',
            code="probing.cold.missing",
        )


def _check_times(time: Array, valid: NDArray[np.bool_]) -> None:
    first = np.min(np.where(valid, time, np.inf), axis=(1, 2))
    last = np.max(np.where(valid, time, -np.inf), axis=(1, 2))
    used = np.flatnonzero(valid.any(axis=(1, 2)))
    for before, after in pairwise(used):
        if last[before] > first[after]:
            raise MethodError(
                f"touch_time: expected cycle {before} to end before cycle {after} starts; found {last[before]:g} s and "
                f"{first[after]:g} s. The times of the touches must be on the clock of `time`.",
                code="probing.times.order",
            )


def _weights(
    raw: xr.Dataset, settings: NormalVectorSettings, valid: NDArray[np.bool_], touched: bool
) -> tuple[Array, float]:
    k, b, m = valid.shape
    diagonal = np.zeros((k, b, m, m))
    diagonal[..., range(m), range(m)] = valid
    if touched:
        stated = float(raw["touch_noise"]) if "touch_noise" in raw else settings.touch_noise
        if stated is None:
            return diagonal, float("nan")
        if not stated > 0:
            raise MethodError(
                f"touch_noise: expected more than 0 m; found {stated:g} m. Omit it if it is unknown.",
                code="raw.noise.not_positive",
            )
        return diagonal, stated
    if "centre_covariance" not in raw:
        return diagonal, float("nan")
    C = _array(raw, "centre_covariance", "time", "ball", "direction", "direction_")
    there = np.all(valid, axis=-1)
    known = np.all(np.isfinite(C), axis=(2, 3)) & there
    if (there & ~known).any():
        raise MethodError(
            "centre_covariance: expected a covariance for every centre; found NaN. Omit it if it is unknown.",
            code="probing.covariance.unknown",
        )
    C = np.where(known[..., None, None], C, np.eye(3))
    if not (np.linalg.eigvalsh(C) > 0).all():
        raise MethodError(
            "centre_covariance: expected positive definite matrices; found one that is not.",
            code="probing.covariance.form",
        )
    return np.linalg.inv(C) * known[..., None, None], 1.0


def _flag_notes(flag: Array) -> list[str]:
    counts = [
        (value, int(np.count_nonzero(flag == value))) for value in np.unique(flag[np.isfinite(flag)]) if value > 0
    ]
    return [f"{count} touches are flagged: {flag_text(value)}." for value, count in counts]


def _coordinates(raw: xr.Dataset) -> Array:
    """Return the centres, each repeated for its three coordinates, (k, b, 3, 3)."""
    centre = _array(raw, "centre", "time", "ball", "direction")
    return np.array(np.broadcast_to(centre[:, :, None], (*centre.shape, 3)))


def _array(raw: xr.Dataset, name: str, *dims: str) -> Array:
    return np.array(raw[name].transpose(*dims).values, dtype=np.float64)


def _names(raw: xr.Dataset) -> list[str]:
    if "ball" in raw.coords:
        return [str(name) for name in raw["ball"].values]
    return [str(i + 1) for i in range(raw.sizes["ball"])]
