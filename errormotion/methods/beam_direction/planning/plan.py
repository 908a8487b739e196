"""Expected uncertainty of a measurement, for the set-up of the settings, the published one, and the best one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from scipy.ndimage import map_coordinates

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.datasets.calibrations.inclination import InclinationCalibration
from errormotion.datasets.units import format_quantity
from errormotion.errors import MethodError
from errormotion.kinematics.beams import across, beam_errors, error_jacobian, tilt
from errormotion.methods.beam_direction.identification.direction import bound
from errormotion.methods.beam_direction.identification.propagation import Propagated, expected_beam
from errormotion.methods.beam_direction.identification.reading import NORMAL_NEEDED, with_receiver_right
from errormotion.methods.beam_direction.identification.slopes import gradient_covariance
from errormotion.methods.beam_direction.planning import design

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from errormotion.methods.beam_direction.planning.design import Design, Limits
    from errormotion.methods.beam_direction.settings import Settings
    from errormotion.plugins import Method


PUBLISHED = ((np.radians(20.0), 0.0), (np.radians(20.0), np.radians(90.0)))
"""Two faces turned by 90 deg, the largest angle in table 1 of Lu et al., which does not state the inclination."""
_TABLE_STEP = np.radians(1.0)
_UNCOMPENSATED = 0.03
"""Slope of an inclination error that is not compensated."""
_NOTED_RATIO = 1.05
"""Ratio of the uncertainty to that by noise alone, from which on the latter is stated in a note."""
SETUPS = ("two planes, equal strokes", "as set", "two planes, best", "best")


def plan(method: Method, settings: Settings) -> xr.Dataset:
    """Return an error dataset of zeros with the expected covariance of the set-up in the settings.

    Additional variables over ``setup``: the larger expected uncertainty of the two angles of the beam,
    ``angle_uncertainty`` (rad), and its contribution from the noise of the readings, ``readings_uncertainty``, for the
    published set-up (two faces turned by 90 deg with strokes of the same length), that of the settings, and the best
    ones with two planes and with the number of planes in the settings, all with the same total number of readings. The
    last one is ``best_inclination``, ``best_rotation`` (rad), ``best_stroke`` (m) and ``best_readings``; ``gain`` is
    the ratio of the published uncertainty to its. ``notes`` state the same as text.

    Parameters
    ----------
    method : Method
    settings : Settings

    Raises
    ------
    MethodError
        Planes that do not determine the direction; no set-up within the settings.
    """
    remaining = _remaining(settings)
    slope_uncertainty = remaining.table(settings.layout.max_inclination) if remaining is not None else None
    limits = design.limits_of(settings, slope_uncertainty=slope_uncertainty)
    number = len(settings.planes)
    stated = stated_setup(settings, limits)
    pair = design.optimise(limits, np.array(PUBLISHED))
    best = pair if number == 2 else design.optimise(limits, _angles(settings))
    setups = (design.equal_strokes(np.array(PUBLISHED), limits), stated, pair, best)
    expected = [expected_direction(setup, settings, limits, remaining) for setup in setups]
    totals = [readings + sources.T @ sources for readings, sources in expected]
    angles = np.array([_larger_u(total, limits) for total in totals])
    by_noise = np.array([_larger_u(readings, limits) for readings, _ in expected])
    gain = float(angles[0] / angles[3])
    beam, u = expected_with_origin(stated, settings, limits, remaining), limits.beam[None]
    known = np.isfinite(beam.covariance[0, 0])
    origin = np.array([settings.layout.nominal_origin if known else (np.nan,) * 3], np.float64)
    total = beam.covariance + beam.influence.T @ beam.influence
    errors, covariance = beam_errors(origin, u, origin, u, total[None])
    influence = (np.nan_to_num(beam.influence) @ error_jacobian(u, u)[0].T)[:, None]
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
        provenance=provenance.make(settings, None, None, steps=["plan"])
        | ({"calibration": remaining.calibration.reference()} if remaining is not None else {}),
        influence=influence,
        sources=["scale", "triangulation plane", *(f"inclination calibration {i + 1}" for i in range(number))],
        source_groups=["sensor", "triangulation plane", *["inclination calibration"] * number],
        extras={
            "angle_uncertainty": xr.DataArray(angles, dims="setup", attrs={"units": "rad"}),
            "readings_uncertainty": xr.DataArray(by_noise, dims="setup", attrs={"units": "rad"}),
            "gain": xr.DataArray(gain, attrs={"units": "1"}),
            "best_inclination": xr.DataArray(best.planes[:, 0], dims=plane, attrs={"units": "rad"}),
            "best_rotation": xr.DataArray(best.planes[:, 1], dims=plane, attrs={"units": "rad"}),
            "best_stroke": xr.DataArray(best.strokes, dims=(*plane, "direction"), attrs={"units": "m"}),
            "best_readings": xr.DataArray(best.readings, dims=(*plane, "direction")),
        },
    )
    return ds.assign_attrs(notes=_notes(setups, angles, by_noise, limits, remaining))


def stated_setup(settings: Settings, limits: Limits) -> Design:
    """Return the set-up of the settings, with the positions of a path if one is given."""
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


def expected_direction(
    setup: Design, settings: Settings, limits: Limits, remaining: RemainingError | None
) -> tuple[Array, Array]:
    """Return the bound (3, 3) of the direction by its readings, and the influence of each source on it (source, 3).

    The sources are the sensor's scale and its triangulation plane, common to all planes, and the remaining
    inclination error at each plane, which is large if the calibration does not cover it.
    """
    p, u, stages = settings.layout, limits.beam, setup.stages()
    noise = p.noise / np.sqrt(p.average)
    readings = bound(stages, setup.normals, u, noise, p.speckle, p.speckle_length)
    t = design.tilts(setup.normals, u)
    variance = [u @ gradient_covariance(stage, noise, p.speckle, p.speckle_length) @ u for stage in stages]
    # Sensitivity of the direction to the conditions of the planes, weighted by the noise only, as in `identify`.
    sensitivity = readings @ across(u).T @ (t / np.array(variance)[:, None]).T
    return readings, slopes_by_source(t, limits, remaining) @ sensitivity.T


def slopes_by_source(t: Array, limits: Limits, remaining: RemainingError | None) -> Array:
    """Return the influence of one standard uncertainty of each source on the slopes at tilts (k, 2): (source, k)."""
    own, common = remaining.at(t) if remaining is not None else np.zeros((2, len(t)))
    return np.concatenate([np.full((1, len(t)), limits.scale_uncertainty), common[None], np.diag(own)])


def expected_with_origin(
    setup: Design, settings: Settings, limits: Limits, remaining: RemainingError | None
) -> Propagated:
    """Return expected direction and zero point; the latter is NaN if nominal origin or pivot is not given."""
    p, u, points = settings.layout, limits.beam, None
    stages, origin = setup.stages(), None
    if p.nominal_origin is not None and p.pivot is not None:
        origin, points = np.array(p.nominal_origin), np.tile(np.array(p.pivot), (len(stages), 1))
        middle = points[0] - origin - sum(p.reading_range) / 2 * u
        stages = [middle + stage for stage in stages]
    return expected_beam(
        stages,
        setup.normals,
        u,
        p.noise / np.sqrt(p.average),
        p.speckle,
        p.speckle_length,
        origin=origin,
        points=points,
        point_uncertainty=p.pivot_uncertainty,
        slope_by_source=slopes_by_source(design.tilts(setup.normals, u), limits, remaining),
    )


@dataclass(frozen=True)
class RemainingError:
    """Remaining inclination error after compensation with a calibration.

    Attributes
    ----------
    calibration : InclinationCalibration
    beam, triangulation_normal : ndarray (3,)
        Nominal unit vectors.
    normal_uncertainty : float
        Standard uncertainty of the triangulation plane's angle about the beam, rad.
    extrapolate : bool
        Whether tilts that the calibration does not cover are allowed.
    """

    calibration: InclinationCalibration
    beam: Array
    triangulation_normal: Array
    normal_uncertainty: float
    extrapolate: bool

    def at(self, t: Array) -> tuple[Array, Array]:
        """Return the effects of calibration and triangulation plane on the slope at tilts (k, 2), (k,) each.

        The latter is common to all planes. At tilts that the calibration does not cover, the remaining error is large.
        """
        q = self._tilt(t)
        c, s = np.cos(self.normal_uncertainty), np.sin(self.normal_uncertainty)
        plus, minus = (self.calibration.slope(q @ np.array([[c, sine], [-sine, c]]))[0] for sine in (s, -s))
        return self.calibration.slope(q)[1], np.asarray(plus - minus) / 2

    def covers(self, t: Array) -> NDArray[np.bool_]:
        """Return whether the calibration can compensate a measurement at tilts (k, 2), (k,)."""
        return np.asarray(self.extrapolate | self.calibration.supported(self._tilt(t)))

    def _tilt(self, t: Array) -> Array:
        normals = t @ across(self.beam) - self.beam
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return tilt(self.beam, self.triangulation_normal, normals)

    def table(self, max_inclination: float) -> Callable[[Array], Array]:
        """Return the uncertainty as a function of tilts (k, 2), interpolated in a table for speed.

        At tilts that the calibration does not cover, the uncertainty is that without compensation.
        """
        steep = np.linspace(0.0, max_inclination, max(2, round(max_inclination / _TABLE_STEP) + 1))
        azimuth = np.linspace(-np.pi, np.pi, round(2 * np.pi / _TABLE_STEP) + 1)
        A, B = np.meshgrid(steep, azimuth, indexing="ij")
        t = np.stack([np.tan(A) * np.cos(B), np.tan(A) * np.sin(B)], axis=-1).reshape(-1, 2)
        values = np.where(self.covers(t), np.hypot(*self.at(t)), _UNCOMPENSATED).reshape(A.shape)
        per_step = np.array([(n - 1) / (x[-1] - x[0]) for x, n in ((steep, steep.size), (azimuth, azimuth.size))])

        def look_up(t: Array) -> Array:
            coordinates = np.stack([np.arctan(np.hypot(t[:, 0], t[:, 1])), np.arctan2(t[:, 1], t[:, 0]) + np.pi])
            return np.asarray(map_coordinates(values, coordinates * per_step[:, None], order=1, mode="nearest"))

        return look_up


def _remaining(settings: Settings) -> RemainingError | None:
    """Return the remaining error with the calibration of the settings; None without calibration."""
    if settings.compensation is None:
        return None
    p = settings.layout
    if p.triangulation_normal is None:
        raise MethodError(f"layout.triangulation_normal: {NORMAL_NEEDED}")
    u, t = np.array(p.nominal_direction, np.float64), with_receiver_right(p.triangulation_normal, settings.receiver)
    calibration = InclinationCalibration.find(settings.compensation)
    return RemainingError(
        calibration,
        u / np.linalg.norm(u),
        t / np.linalg.norm(t),
        settings.triangulation_normal_uncertainty,
        settings.extrapolate,
    )


def _angles(settings: Settings) -> Array:
    return np.array([(face.inclination, face.rotation) for face in settings.planes])


def _larger_u(covariance: Array, limits: Limits) -> float:
    basis = across(limits.beam)
    return design.worst_angle(basis @ covariance @ basis.T)


def _notes(
    setups: tuple[Design, ...], angles: Array, by_noise: Array, limits: Limits, remaining: RemainingError | None
) -> list[str]:
    published, stated, pair, best = (format_quantity(float(angle), "arcsec", 3) for angle in angles)
    total = limits.readings
    tilts = [design.tilts(setup.normals, limits.beam) for setup in setups[:2]]
    refused = [np.flatnonzero(~remaining.covers(t)) + 1 if remaining is not None else np.zeros(0, int) for t in tilts]
    notes = [
        f"With {total} readings in total, the larger standard uncertainty of the beam's two angles is {stated} with "
        f"the planes of the settings, and {published} with the published two planes at 20 deg, turned by 90 deg, and "
        "strokes of the same length" + (", which this calibration does not cover." if refused[0].size else "."),
        f"Best two planes: {pair}, smaller than with the published ones by the factor {angles[0] / angles[2]:.3g}.",
    ]
    if setups[3] is not setups[2]:
        notes.append(f"Best {len(setups[3].planes)} planes: {best}, smaller by the factor {angles[0] / angles[3]:.3g}.")
    if np.max(angles / by_noise) > _NOTED_RATIO:
        notes.append(
            "The contribution of the noise of the readings is "
            + ", ".join(
                f"{format_quantity(float(angle), 'arcsec', 3)} ({name})"
                for name, angle in zip(SETUPS, by_noise, strict=True)
            )
            + "; the rest is the sensor's scale and its remaining inclination error."
        )
    for name, uncovered in zip(("the published set-up", "the set-up of the settings"), refused, strict=True):
        if uncovered.size:
            notes.append(
                f"The calibration does not cover plane {' and '.join(map(str, uncovered))} of {name}: the figures are "
                "extrapolated, with the corresponding uncertainty; identification of a measurement would be refused."
            )
    for i, (face, strokes, counts) in enumerate(
        zip(setups[3].planes, setups[3].strokes, setups[3].readings, strict=True)
    ):
        distribution = ", ".join(
            f"{n} readings over {length * 1e3:.1f} mm of {axis}"
            for axis, length, n in zip("XYZ", strokes, counts, strict=True)
        )
        a, b = np.degrees(face)
        notes.append(f"Best plane {i + 1}: inclination {a:.1f} deg, rotation {b:.1f} deg; {distribution}.")
    return notes
