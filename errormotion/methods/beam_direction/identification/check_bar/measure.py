"""A check bar for the verification of a calibrated beam: circle or cylinder through its points, and the residuals.

All points have the same weight, as in published tables of such measurements; the covariance is that of this estimate,
from the noise of each point and from shared sources (`Points.influence`). Outliers are ignored and reported. Residuals
larger than the noise, and systematic residuals (correlated along the bar), are reported. If the residuals are
systematic, a correct radius does not verify the beam, because a systematic error changes centre and radius but not
their uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.datasets.calibrations.inclination import InclinationCalibration
from errormotion.errors import MethodError
from errormotion.methods.beam_direction.identification.check_bar.correlation import neighbour_correlation
from errormotion.methods.beam_direction.identification.check_bar.estimate import (
    FALSE_ALARMS,
    Evaluation,
    evaluate,
    fit,
    start,
)
from errormotion.methods.beam_direction.identification.check_bar.scanning import Points, points
from errormotion.methods.beam_direction.identification.check_bar.surfaces import round_bar
from errormotion.methods.beam_direction.identification.reading import triangulation_normal

__all__ = ["BarFit", "fit_bar", "measure_bar"]


@dataclass(frozen=True, eq=False)
class BarFit:
    """A bar through points; lengths in m.

    Attributes
    ----------
    shape : {"circle", "cylinder"}
    centre : ndarray (3,)
        Point of the axis; of a cylinder the one at the middle height of its points.
    centre_covariance : ndarray (3, 3)
        Across the axis; 0 along it.
    axis : ndarray (3,)
        Unit vector along the bar: as given for a circle, fitted for a cylinder.
    axis_covariance : ndarray (3, 3)
        0 for a circle.
    radius, radius_u : float
        Radius and its standard uncertainty: the given ones if the radius was fixed.
    free_radius, free_radius_u : float
        Radius of a fit to the points with free radius.
    covariance : ndarray (p, p)
        Of `parameter_names`: independent and common part.
    common_covariance : ndarray (p, p)
        From sources that all points share: beam, calibration, a fixed radius.
    parameter_names : tuple of str
        ``across_1 across_2`` (along ``kinematics.beams.across(axis)``), for a cylinder ``tilt_1 tilt_2`` (rad), and
        ``radius`` if it is free.
    residuals : ndarray (n,)
        Of all points, outliers included; positive outside. NaN for missing readings.
    left_out : tuple of int
        Indices of the outliers, from 0.
    rms : float
        Of the residuals of the points that were used.
    explained : float
        The rms expected from the stated noise; NaN if none is stated.
    exceeds_noise : bool
        Whether the residuals are significantly larger than the stated noise.
    correlation : float
        Correlation of neighbouring residuals minus that caused by the fit itself; about 0 for noise.
    systematic : bool
        Whether this correlation is significant.
    chance : float
        Probability of this correlation or a larger one by noise alone.
    notes : tuple of str
    """

    shape: str
    centre: Array
    centre_covariance: Array
    axis: Array
    axis_covariance: Array
    radius: float
    radius_u: float
    free_radius: float
    free_radius_u: float
    covariance: Array
    common_covariance: Array
    parameter_names: tuple[str, ...]
    residuals: Array
    left_out: tuple[int, ...]
    rms: float
    explained: float
    exceeds_noise: bool
    correlation: float
    systematic: bool
    chance: float
    notes: tuple[str, ...]


def fit_bar(
    scanned: Points | ArrayLike,
    axis: ArrayLike,
    *,
    shape: Literal["circle", "cylinder"] = "circle",
    radius: float | None = None,
    radius_uncertainty: float = 0.0,
    hold_radius: bool = False,
    robust: bool = True,
    noise: float | None = None,
) -> BarFit:
    """Fit a bar to points.

    Parameters
    ----------
    scanned : Points, or array_like (n, 3)
        m, in the order of the scan. NaN for missing readings.
    axis : array_like (3,)
        Along the bar: exact for a circle, within about 20 degrees for a cylinder.
    shape : {"circle", "cylinder"}
        A circle is fitted in the plane across ``axis``; a cylinder requires points that spread along the bar.
    radius, radius_uncertainty : float, optional
        Calibrated radius of the bar and its standard uncertainty, with which the fitted one is compared.
    hold_radius : bool
        Fit with ``radius`` fixed.
    robust : bool
        Ignore and report outliers.
    noise : float, optional
        Standard deviation of each coordinate, m; for coordinates only, since `Points` state their noise.

    Raises
    ------
    MethodError
        Invalid input.
    FitError
        Points that do not determine the shape, or contradict one another.
    """
    p, own, influence, reading = _points(scanned, noise)
    u = np.asarray(axis, float)
    if u.shape != (3,) or not np.linalg.norm(u) > 0:
        raise MethodError(
            f"axis: expected the direction of the bar, three numbers; found {u.tolist()}.", code="beam.bar.axis"
        )
    if radius is not None and not radius > 0:
        raise MethodError(f"radius: expected a positive length; found {radius}.", code="beam.bar.radius")
    if hold_radius and radius is None:
        raise MethodError("hold_radius: expected the radius to be fixed; found none.", code="beam.bar.hold_radius")
    if shape not in ("circle", "cylinder"):
        raise MethodError(f"shape: expected 'circle' or 'cylinder'; found '{shape}'.", code="beam.bar.shape")
    u = u / np.linalg.norm(u)
    known = np.flatnonzero(np.isfinite(p).all(axis=1))
    initial, outliers = start(p[known], own[known], u, shape, robust)
    left_out = tuple(int(known[k]) for k in outliers)
    used = np.setdiff1d(known, left_out)

    fixed = radius if hold_radius else None
    bar = fit(p[used], initial, shape, fixed)
    free = bar if fixed is None else fit(p[used], initial, shape, None)
    result = evaluate(bar, p[used], own[used], influence[:, used], radius_uncertainty if hold_radius else 0.0)
    free_result = result if free is bar else evaluate(free, p[used], own[used], influence[:, used], 0.0)

    residuals = np.full(len(p), np.nan)
    residuals[known] = bar.residuals(p[known])[0]
    order = np.arange(len(used)) if shape == "cylinder" else bar.around(p[used])
    correlation, chance = neighbour_correlation(residuals[used][order], result.M[np.ix_(order, order)])
    systematic = bool(chance < FALSE_ALARMS)
    C, G = result.covariance, bar.centre_and_axis_jacobian()
    free_u = float(np.sqrt(free_result.covariance[-1, -1]))
    notes = [_outlier_note(k, residuals[k], reading, len(p)) for k in left_out]
    notes += _residual_notes(result, correlation, chance, systematic)
    if radius is not None:
        notes += _radius_notes(free.radius, free_u, radius, radius_uncertainty)
    return BarFit(
        shape=shape,
        centre=bar.centre,
        centre_covariance=G[:3] @ C @ G[:3].T,
        axis=bar.axis,
        axis_covariance=G[3:] @ C @ G[3:].T,
        radius=bar.radius,
        radius_u=radius_uncertainty if hold_radius else free_u,
        free_radius=free.radius,
        free_radius_u=free_u,
        covariance=C,
        common_covariance=result.common,
        parameter_names=bar.names,
        residuals=residuals,
        left_out=left_out,
        rms=result.rms,
        explained=result.explained,
        exceeds_noise=result.exceeds,
        correlation=correlation,
        systematic=systematic,
        chance=chance,
        notes=tuple(notes),
    )


def measure_bar(
    raw: xr.Dataset,
    origin: ArrayLike,
    direction: ArrayLike,
    covariance: ArrayLike | None = None,
    *,
    calibration: InclinationCalibration | None = None,
    moves: Literal["sensor", "target"] = "sensor",
    shape: Literal["circle", "cylinder"] = "circle",
    stage_noise: float = 0.0,
    radius_uncertainty: float = 0.0,
    hold_radius: bool = False,
    robust: bool = True,
    extrapolate: bool = False,
    receiver: Literal["left", "right"] | None = None,
) -> tuple[Points, BarFit]:
    """Return points and bar of the rows ``bar_...`` of a raw dataset, for a known beam.

    Parameters
    ----------
    raw : Dataset
        Schema ``errormotion.raw.beam_direction/1`` with a check bar.
    origin, direction, covariance
        The beam; see `errormotion.methods.beam_direction.identification.check_bar.scanning.points`.
    calibration, moves, stage_noise, extrapolate
        As of `points`; the normals are those of a round bar.
    shape, radius_uncertainty, hold_radius, robust
        See `fit_bar`.

    receiver : {"left", "right"}, optional
        Side of the receiver, for a dataset without the attribute.

    Raises
    ------
    MethodError
        No check bar in the dataset, a calibration and no side of the receiver, and as of `points` and `fit_bar`.
    FitError
        See `fit_bar`.
    """
    missing = [name for name in ("bar_distance", "bar_stage", "bar_axis") if name not in raw]
    if missing:
        raise MethodError(
            f"Expected readings of a check bar in the raw dataset; {', '.join(missing)} missing.",
            code="beam.bar.readings_missing",
        )
    axis = raw["bar_axis"].values
    speckle = float(raw["speckle"]) if "speckle" in raw else 0.0
    scanned = points(
        raw["bar_distance"].values,
        raw["bar_stage"].transpose("bar_reading", "direction").values,
        origin,
        direction,
        covariance=covariance,
        noise=float(np.hypot(float(raw["distance_noise"]), speckle)),
        stage_noise=stage_noise,
        calibration=calibration,
        triangulation_normal=triangulation_normal(raw, receiver) if calibration is not None else None,
        mid_range=float(raw["mid_range"]) if "mid_range" in raw else None,
        normals=round_bar(axis) if calibration is not None else None,
        moves=moves,
        extrapolate=extrapolate,
    )
    radius = float(raw["bar_radius"]) if "bar_radius" in raw and np.isfinite(raw["bar_radius"]) else None
    held = hold_radius and radius is not None
    return scanned, fit_bar(
        scanned,
        axis,
        shape=shape,
        radius=radius,
        radius_uncertainty=radius_uncertainty,
        hold_radius=held,
        robust=robust,
    )


def _residual_notes(result: Evaluation, correlation: float, chance: float, systematic: bool) -> list[str]:
    """Return a note on residuals that are systematic, or larger than the noise."""
    expected = f", expected from the stated noise {_um(result.explained)}" if result.exceeds else ""
    size = f"residual rms {_um(result.rms)}{expected}"
    if systematic:
        probability = f"once in {1 / chance:.0f}" if chance > 1e-4 else "less than once in 10 000"
        return [
            f"The residuals are systematic: {size}; neighbours along the bar are correlated (correlation "
            f"{correlation:.2f}, by chance {probability}). Centre and radius have an error that is not included in "
            "their uncertainty."
        ]
    if result.exceeds:
        return [
            f"The residuals exceed the noise: {size}. They are random along the bar; the uncertainties are increased "
            "accordingly. Check the stated noise, the surface of the bar, and vibrations of the stage."
        ]
    return []


def _points(scanned: Points | ArrayLike, noise: float | None) -> tuple[Array, Array, Array, Array | None]:
    """Return points (n, 3), their independent covariance, influence of shared sources, and their readings."""
    if isinstance(scanned, Points):
        if noise is not None:
            raise MethodError(
                "noise: expected for coordinates only; the points of a scan state their noise.", code="beam.bar.noise"
            )
        return scanned.points, scanned.covariance, scanned.influence, scanned.reading
    p = np.asarray(scanned, float)
    if p.ndim != 2 or p.shape[1] != 3:
        raise MethodError(f"Expected points (n, 3), one per row; found {p.shape}.", code="beam.bar.points")
    if noise is not None and not noise >= 0:
        raise MethodError(f"noise: expected a standard deviation in m; found {noise}.", code="beam.bar.noise")
    own = np.broadcast_to((noise or 0.0) ** 2 * np.eye(3), (len(p), 3, 3))
    return p, np.asarray(own), np.zeros((0, len(p), 3)), None


def _outlier_note(k: int, residual: float, reading: Array | None, n: int) -> str:
    shown = "" if reading is None else f", reading {1e3 * reading[k]:.3f} mm"
    side = "outside" if residual > 0 else "inside"
    return (
        f"Point {k + 1} of {n} (index {k}{shown}) is an outlier and was ignored: {_um(abs(residual))} {side} the bar."
    )


def _radius_notes(free: float, free_u: float, known: float, known_u: float) -> list[str]:
    """Return a note on a radius that differs from the calibrated one."""
    u = float(np.hypot(free_u, known_u))
    if not abs(free - known) > 2 * u:
        return []
    return [
        f"The radius of the points is {1e3 * free:.4f} mm. It differs by {1e6 * (free - known):+.1f} um from the "
        f"calibrated one, {1e3 * known:.4f} mm; the expanded uncertainty (k = 2) of the difference is {_um(2 * u)}."
    ]


def _um(length: float) -> str:
    return f"{1e6 * length:.3g} um"
