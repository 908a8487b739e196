"""The result of probing balls as arrays over cycles, balls and touches; NaN for missing variables."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.methods.normal_vector.schema import EACH, RESULT
from errormotion.report.budget import FREEDOMS
from errormotion.report.provenance import read

USED, MISSING, WRONG, MOVED, UNDETERMINED = range(5)
"""Values of ``left_out``."""


def is_normal_vector(errors: xr.Dataset) -> bool:
    """Return whether a dataset is a result of probing balls over time."""
    return errors.attrs.get("method") == "normal_vector" and errors["EX"].dims == ("time",)


MAX_UNCERTAINTY = 5.0
"""Uncertainty of a centre, relative to the median of all, above which it is not drawn."""


@dataclass(frozen=True)
class Probing:
    """Result of a warm-up with probing, SI; NaN where unknown.

    Attributes
    ----------
    time : (t,)
        s since the cold cycle.
    balls : list of str
    values, sigma : (t, 6)
        Errors and standard uncertainties.
    centre, centre_u : (t, ball, 3)
        Apparent centres of the balls.
    displacement : (t, ball, 3)
        Of the centres since the cold cycle.
    moved : (t, ball) of bool
        Whether a ball had moved on the table.
    residual, left_out : (t, ball, touch)
        Of touches, or of coordinates if only centres were given.
    flag : (t, ball, touch) of int, or None
        Flags of the probe; None if unknown.
    normals, normals_u, loss : (t, 6)
        Published construction: errors, standard uncertainty, and its ratio to that of the fit.
    noise : float
        Of a touch, as used in the identification.
    by_touch : bool
        Whether residuals are of touches.
    by_normals : bool
        Whether the result itself is that of the published construction.
    tool_axes : str
    """

    time: Array
    balls: list[str]
    values: Array
    sigma: Array
    centre: Array
    centre_u: Array
    displacement: Array
    moved: NDArray[np.bool_]
    residual: Array
    left_out: NDArray[np.int64]
    flag: NDArray[np.int64] | None
    normals: Array
    normals_u: Array
    loss: Array
    noise: float
    by_touch: bool
    by_normals: bool
    tool_axes: str

    @property
    def used(self) -> NDArray[np.bool_]:
        """Used touches, (t, ball, touch)."""
        return np.asarray(self.left_out == USED)

    @property
    def well_known(self) -> NDArray[np.bool_]:
        """Centres with usual uncertainty, (t, ball): with missing touches a centre can be nearly undetermined."""
        worst = np.max(self.centre_u, axis=2) if self.centre_u.size else np.empty(self.displacement.shape[:2])
        known = worst[np.isfinite(worst)]
        limit = MAX_UNCERTAINTY * float(np.median(known)) if known.size else np.inf
        measured = np.isfinite(self.displacement).all(axis=2)
        return np.asarray(measured & ~(worst > limit))

    @property
    def moved_balls(self) -> list[int]:
        """Balls that moved on the table at any time."""
        return [i for i in range(len(self.balls)) if bool(self.moved[:, i].any())]

    @property
    def last(self) -> int | None:
        """Last cycle with a known error; None if there is none."""
        known = np.flatnonzero(np.isfinite(self.values).any(axis=1))
        return int(known[-1]) if known.size else None

    @property
    def what(self) -> str:
        """Name of the measured numbers."""
        return "touches" if self.by_touch else "coordinates"

    def reason(self, index: int) -> str:
        """Return the reason why an error is unknown in all cycles."""
        if self.tool_axes and self.tool_axes != "XYZ" and index >= 3:
            return (
                f"not determined: only {' and '.join(self.tool_axes)} carry the tool, and the balls do not show this "
                "rotation of the frame of axes"
            )
        return "not determined by this method"


def probing(errors: xr.Dataset, raw: xr.Dataset | None = None) -> Probing:
    """Return the arrays of a dataset; the flags of the probe are in ``raw``."""
    each = EACH if "residual" not in errors or EACH in errors["residual"].dims else "direction"
    t, b = errors.sizes["time"], errors.sizes.get("ball", 0)
    m = errors.sizes.get(each, 0) if "residual" in errors else 0
    sizes = {"time": t, "ball": b, each: m, "direction": 3, "dof": 6, "dof_": 6, "direction_": 3}

    def get(name: str) -> Array:
        dims = [each if dim == EACH else dim for dim in RESULT[name][0]]
        shape = tuple(sizes[dim] for dim in dims)
        if name not in errors or set(errors[name].dims) != set(dims) or errors[name].dtype.kind not in "iufb":
            return np.full(shape, np.nan)
        values = np.asarray(errors[name].transpose(*dims).values, float)
        return values if values.shape == shape else np.full(shape, np.nan)

    def deviation(variance: Array) -> Array:
        return np.sqrt(np.where(variance >= 0, variance, np.nan))

    spread, plain = get("centre_covariance"), get("normals_covariance")
    procedure = read(errors).get("settings", {})
    procedure = procedure.get("procedure") if isinstance(procedure, dict) else None
    return Probing(
        np.asarray(errors["time"].values, float),
        [str(name) for name in errors["ball"].values] if "ball" in errors.coords else [f"B{i + 1}" for i in range(b)],
        np.stack([np.asarray(errors[name].values, float) for name in FREEDOMS], axis=-1),
        deviation(np.diagonal(errors["covariance"].transpose("time", "dof", "dof_").values, axis1=1, axis2=2)),
        get("centre"),
        deviation(np.diagonal(spread, axis1=2, axis2=3)),
        get("ball_displacement"),
        np.nan_to_num(get("ball_moved")) > 0,
        get("residual"),
        np.nan_to_num(get("left_out"), nan=MISSING).astype(np.int64),
        _flags(raw, (t, b, m)),
        get("normals_errors"),
        deviation(np.diagonal(plain, axis1=1, axis2=2)),
        get("normals_loss"),
        float(get("noise")),
        each == EACH,
        procedure == "normals",
        str(errors.attrs.get("tool_axes", "")),
    )


def _flags(raw: xr.Dataset | None, shape: tuple[int, ...]) -> NDArray[np.int64] | None:
    """Return the flags of the probe if the raw dataset contains them for the same touches."""
    if raw is None or "touch_flag" not in raw or set(raw["touch_flag"].dims) != {"time", "ball", "touch"}:
        return None
    flag = np.asarray(raw["touch_flag"].transpose("time", "ball", "touch").values)
    return flag.astype(np.int64) if flag.shape == shape else None
