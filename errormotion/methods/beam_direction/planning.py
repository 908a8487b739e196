"""What to expect before anything is measured: of the set-up in the settings, of the paper's, and of the best one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.datasets import build_errors, provenance
from errormotion.datasets.calibration import InclinationCalibration
from errormotion.datasets.units import format_quantity
from errormotion.kinematics.beams import across, beam_errors, tilt
from errormotion.methods.beam_direction import design
from errormotion.methods.beam_direction.direction import bound
from errormotion.methods.beam_direction.slopes import gradient_covariance

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from errormotion.methods.beam_direction.design import Design, Limits
    from errormotion.methods.beam_direction.settings import Settings
    from errormotion.plugins import Method

    Array = NDArray[np.float64]

PAPER = ((np.radians(20.0), 0.0), (np.radians(20.0), np.radians(90.0)))
"""Two faces turned by 90 deg, the widest of the pairs in table 1 of Lu et al.; the inclination is not printed there."""
SETUPS = ("two planes, equal strokes", "as set", "two planes, best", "best")


def plan(method: Method, settings: Settings) -> xr.Dataset:
    """Return an error dataset of zeros with the covariance to expect of the set-up that the settings name.

    What it holds beside, over ``setup``: the expected uncertainty of the worse angle of the beam, ``angle_uncertainty``
    (rad), for as many readings in all, of the published set-up (two faces turned by 90 deg with strokes of one length),
    of that of the settings, and of the best that there is with two planes and with as many as the settings name. The
    last one is ``best_inclination``, ``best_rotation`` (rad), ``best_stroke`` (m) and ``best_readings``; its ``gain``
    is the factor over the published set-up. ``notes`` say all of it in words.

    Parameters
    ----------
    method : Method
    settings : Settings

    Raises
    ------
    MethodError
        Planes that leave the direction open; settings within which there is no set-up.
    """
    limits = design.limits_of(settings, slope_uncertainty=_slope_uncertainty(settings))
    number = len(settings.planes)
    own = as_set(settings, limits)
    pair = design.optimise(limits, np.array(PAPER))
    best = pair if number == 2 else design.optimise(limits, _angles(settings))
    setups = (design.equal_strokes(np.array(PAPER), limits), own, pair, best)
    expected = [expected_direction(setup, settings, limits) for setup in setups]
    totals = [readings + sources.T @ sources for readings, sources in expected]
    angles = np.array([_worse(total, limits) for total in totals])
    gain = float(angles[0] / angles[3])
    covariance = np.full((1, 6, 6), np.nan)
    covariance[0, 3:, 3:] = totals[1]
    u = limits.beam[None]
    origin = np.full((1, 3), np.nan)
    errors, covariance = beam_errors(origin, u, origin, u, covariance)
    turning = np.cross(limits.beam, expected[1][1])  # of the nominal direction, to first order
    influence = np.concatenate([np.zeros_like(turning), turning], axis=1)[:, None]
    plane = ("best_plane",)
    ds = build_errors(
        errors,
        covariance,
        dims=("beam",),
        coords={"beam": [settings.beam], "setup": list(SETUPS), "direction": list("xyz")},
        component="beam",
        machine="plan",
        frame="machine",
        functional_point=np.array(settings.layout.nominal_origin or (0.0, 0.0, 0.0)),
        reference="planned, not measured",
        method=method.info.id,
        method_version=method.info.version,
        provenance=provenance.make(settings, None, None, steps=["plan"]),
        influence=influence,
        sources=["scale of the sensor", *(f"inclination error left at plane {i + 1}" for i in range(number))],
        source_groups=["sensor", *["inclination"] * number],
        extras={
            "angle_uncertainty": xr.DataArray(angles, dims="setup", attrs={"units": "rad"}),
            "gain": xr.DataArray(gain, attrs={"units": "1"}),
            "best_inclination": xr.DataArray(best.planes[:, 0], dims=plane, attrs={"units": "rad"}),
            "best_rotation": xr.DataArray(best.planes[:, 1], dims=plane, attrs={"units": "rad"}),
            "best_stroke": xr.DataArray(best.strokes, dims=(*plane, "direction"), attrs={"units": "m"}),
            "best_readings": xr.DataArray(best.readings, dims=(*plane, "direction")),
        },
    )
    return ds.assign_attrs(notes=_notes(setups, angles, limits))


def as_set(settings: Settings, limits: Limits) -> Design:
    """Return the set-up that the settings name; places of a path count by their spread."""
    p, planes = settings.layout, _angles(settings)
    design.check_numbers(len(planes), limits)
    counts = np.full(3, p.readings // 3)
    counts[: p.readings % 3] += 1
    strokes = (
        design.longest_strokes(design.plane_normals(planes), limits)
        if p.strokes == "longest"
        else np.tile(np.array(p.strokes, np.float64), (len(planes), 1))
    )
    path = np.array(p.path, np.float64) if p.path else None
    return design.Design(planes, strokes, np.tile(counts, (len(planes), 1)), path)


def expected_direction(setup: Design, settings: Settings, limits: Limits) -> tuple[Array, Array]:
    """Return the bound (3, 3) of the direction by its readings, and what single sources add to it (source, 3).

    The sources are the sensor's scale, common to all planes, and what is left of the inclination error at each plane.
    """
    p, u, stages = settings.layout, limits.beam, setup.stages()
    noise = p.noise / np.sqrt(p.average)
    readings = bound(stages, setup.normals, u, noise, p.speckle, p.speckle_length)
    t = design.tilts(setup.normals, u)
    variance = [u @ gradient_covariance(stage, noise, p.speckle, p.speckle_length) @ u for stage in stages]
    # How the direction follows the conditions of the planes, weighted as the method weights them: by the noise alone.
    follow = readings @ across(u).T @ (t / np.array(variance)[:, None]).T
    left = limits.slope_uncertainty(t) if limits.slope_uncertainty is not None else np.zeros(len(t))
    return readings, np.concatenate([follow.sum(axis=1)[None] * limits.scale_uncertainty, (follow * left).T])


def _slope_uncertainty(settings: Settings) -> Callable[[Array], Array] | None:
    """Return what the calibration named in the settings leaves of the slope, as a function of the tilts (k, 2)."""
    if settings.compensation is None:
        return None
    calibration = InclinationCalibration.find(settings.compensation)
    u = np.array(settings.layout.nominal_direction, np.float64)
    u /= np.linalg.norm(u)
    normal = np.array(settings.layout.triangulation_normal or across(u)[0], np.float64)

    def uncertainty(t: Array) -> Array:
        normals = t @ across(u) - u
        q = tilt(u, normal, normals / np.linalg.norm(normals, axis=1, keepdims=True))
        # A tilt that the calibration does not speak for is as good as not compensated.
        return np.where(calibration.supported(q), calibration.slope(q)[1], _UNKNOWN_SLOPE)

    return uncertainty


_UNKNOWN_SLOPE = 0.03


def _angles(settings: Settings) -> Array:
    return np.array([(face.inclination, face.rotation) for face in settings.planes])


def _worse(covariance: Array, limits: Limits) -> float:
    basis = across(limits.beam)
    return design.worst_angle(basis @ covariance @ basis.T)


def _notes(setups: tuple[Design, ...], angles: Array, limits: Limits) -> list[str]:
    paper, own, pair, best = (format_quantity(float(angle), "arcsec", 3) for angle in angles)
    total = limits.readings
    notes = [
        f"With {total} readings in all the worse of the beam's two angles has a standard uncertainty of {own} as set, "
        f"and of {paper} with the published two planes at 20 deg, turned by 90 deg, strokes of one length.",
        f"The best two planes: {pair}, {angles[0] / angles[2]:.3g} times better than the published ones.",
    ]
    if setups[3] is not setups[2]:
        notes.append(f"The best {len(setups[3].planes)} planes: {best}, {angles[0] / angles[3]:.3g} times better.")
    for i, (face, strokes, counts) in enumerate(
        zip(setups[3].planes, setups[3].strokes, setups[3].readings, strict=True)
    ):
        ways = ", ".join(
            f"{n} readings over {length * 1e3:.1f} mm of {axis}"
            for axis, length, n in zip("XYZ", strokes, counts, strict=True)
        )
        a, b = np.degrees(face)
        notes.append(f"Best plane {i + 1}: inclination {a:.1f} deg, rotation {b:.1f} deg; {ways}.")
    return notes
