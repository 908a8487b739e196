"""Expected uncertainty of a measurement, for the set-up of the settings, the published one, and the best one.

A plan is the identification of the readings that the set-up is expected to give, so that it has the same sources as a
measurement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from scipy.ndimage import map_coordinates

from errormotion.arrays import Array
from errormotion.datasets import provenance
from errormotion.datasets.units import format_quantity
from errormotion.errors import MethodError
from errormotion.kinematics.beams import across, tilt
from errormotion.measurement.identification import Solved, dataset, solve
from errormotion.measurement.observed import as_expected
from errormotion.methods.beam_direction.identification.beam import observe
from errormotion.methods.beam_direction.identification.reading import NORMAL_NEEDED
from errormotion.methods.beam_direction.identification.sensor import Sensor
from errormotion.methods.beam_direction.planning import design
from errormotion.methods.beam_direction.schema import SCHEMA

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from errormotion.measurement.method import ModelMethod
    from errormotion.methods.beam_direction.planning.design import Design, Limits
    from errormotion.methods.beam_direction.settings import BeamDirectionSettings


PUBLISHED = ((np.radians(20.0), 0.0), (np.radians(20.0), np.radians(90.0)))
"""Two faces turned by 90 deg, the largest angle in table 1 of Lu et al., which does not state the inclination."""
_TABLE_STEP = np.radians(1.0)
_UNCOMPENSATED = 0.03
"""Slope of an inclination error that is not compensated."""
_NOTED_RATIO = 1.05
"""Ratio of the uncertainty to that by noise alone, from which on the latter is stated in a note."""
SETUPS = ("two planes, equal strokes", "as set", "two planes, best", "best")
_M, _1 = {"units": "m"}, {"units": "1"}


def plan(method: ModelMethod, settings: BeamDirectionSettings) -> xr.Dataset:
    """Return an error dataset of zeros with the expected covariance of the set-up in the settings.

    Additional variables over ``setup``: the larger expected uncertainty of the two angles of the beam,
    ``angle_uncertainty`` (rad), and its contribution from the noise of the readings, ``readings_uncertainty``, for the
    published set-up (two faces turned by 90 deg with strokes of the same length), that of the settings, and the best
    ones with two planes and with the number of planes in the settings, all with the same total number of readings. The
    last one is ``best_inclination``, ``best_rotation`` (rad), ``best_stroke`` (m) and ``best_readings``; ``gain`` is
    the ratio of the published uncertainty to its. ``notes`` state the same as text.

    Parameters
    ----------
    method : ModelMethod
    settings : BeamDirectionSettings

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
    results = [solved_setup(setup, settings) for setup in setups]
    angles = np.array([_larger_u(planned_result.relative.errors.covariance[0], limits) for planned_result in results])
    by_noise = np.array([_larger_u(planned_result.relative.errors.own[0], limits) for planned_result in results])
    plane = ("best_plane",)
    extras = {
        "angle_uncertainty": xr.DataArray(angles, dims="setup", attrs={"units": "rad"}),
        "readings_uncertainty": xr.DataArray(by_noise, dims="setup", attrs={"units": "rad"}),
        "gain": xr.DataArray(float(angles[0] / angles[3]), attrs=_1),
        "best_inclination": xr.DataArray(best.planes[:, 0], dims=plane, attrs={"units": "rad"}),
        "best_rotation": xr.DataArray(best.planes[:, 1], dims=plane, attrs={"units": "rad"}),
        "best_stroke": xr.DataArray(best.strokes, dims=(*plane, "direction"), attrs=_M),
        "best_readings": xr.DataArray(best.readings, dims=(*plane, "direction")),
    }
    own = results[1]
    coords = {"beam": [settings.beam], "setup": list(SETUPS), "direction": list("xyz")}
    notes = _notes(setups, angles, by_noise, limits, remaining)
    observed = replace(own.observed, extras=extras, coords=coords, notes=notes, doubts=())
    origin = provenance.make(settings, None, None, steps=["plan"])
    if remaining is not None:
        origin |= {"calibration": remaining.sensor.calibration.reference()}
    return dataset(method, replace(own, observed=observed), expected(settings), method.info, origin, planned=True)


def solved_setup(setup: Design, settings: BeamDirectionSettings) -> Solved:
    """Return the solution of the readings that a set-up is expected to give.

    Tilts that the calibration does not cover have its uncertainty there, which is large.
    """
    raw, anywhere = expected(settings, setup), settings.model_copy(update={"extrapolate": True})
    observed = observe(raw, anywhere, Sensor.of(raw, anywhere))
    return solve(as_expected(observed))


def expected(settings: BeamDirectionSettings, setup: Design | None = None) -> xr.Dataset:
    """Return the readings, without noise, of a nominal beam on the planes of a set-up; by default of the settings.

    With a compensation they have the inclination error of its calibration.
    """
    p, limits = settings.layout, design.limits_of(settings)
    setup = stated_setup(settings, limits) if setup is None else setup
    u, normals, middle = limits.beam, setup.normals, sum(p.reading_range) / 2
    paths = setup.stages()
    n = max(len(path) for path in paths)
    path = np.stack([np.pad(each, ((0, n - len(each)), (0, 0)), constant_values=np.nan) for each in paths])
    gradient = -normals / (normals @ u)[:, None]
    distance = middle + np.einsum("kni,ki->kn", path, gradient)
    variables = {
        "nominal_direction": ("direction", u, _1),
        "distance_noise": ((), p.noise / np.sqrt(p.average), _M),
        "speckle": ((), p.speckle, _M),
        "speckle_length": ((), p.speckle_length, _M),
    }
    if p.nominal_origin is not None:
        variables["nominal_origin"] = ("direction", np.array(p.nominal_origin), _M)
    if p.pivot is not None and p.nominal_origin is not None:
        path = path + np.array(p.pivot) - np.array(p.nominal_origin) - middle * u
        variables["plane_point"] = (("plane", "direction"), np.tile(p.pivot, (len(normals), 1)), _M)
        variables["plane_point_uncertainty"] = ((), p.pivot_uncertainty, _M)
    if p.triangulation_normal is not None:
        normal = np.array(p.triangulation_normal)
        variables["triangulation_normal"] = ("direction", normal / np.linalg.norm(normal), _1)
    variables["distance"] = (("plane", "reading"), distance, _M)
    variables["stage"] = (("plane", "reading", "direction"), path if settings.moves == "sensor" else -path, _M)
    raw = xr.Dataset(variables, {"direction": list("xyz")}, {"schema": SCHEMA, "machine": "expected"})
    sensor = Sensor.of(raw, settings)
    if sensor is None:
        return raw.assign(mid_range=((), middle, _M))
    slope = sensor.calibration.slope(tilt(u, sensor.triangulation_normal, normals))[0]
    m = sensor.mid_range
    return raw.assign(distance=(("plane", "reading"), m + (distance - m) * (1 + slope)[:, None], _M))


def stated_setup(settings: BeamDirectionSettings, limits: Limits) -> Design:
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


@dataclass(frozen=True)
class RemainingError:
    """Remaining inclination error after compensation with a calibration, for the search of the best planes.

    Attributes
    ----------
    sensor : Sensor
    beam : ndarray (3,)
        Nominal unit vector.
    extrapolate : bool
        Whether tilts that the calibration does not cover are allowed.
    """

    sensor: Sensor
    beam: Array
    extrapolate: bool

    def at(self, t: Array) -> Array:
        """Return the standard uncertainty (k,) of the slope at tilts (k, 2), with that of the triangulation plane."""
        q, calibration, angle = self._tilt(t), self.sensor.calibration, self.sensor.normal_uncertainty
        c, s = np.cos(angle), np.sin(angle)
        plus, minus = (calibration.slope(q @ np.array([[c, sine], [-sine, c]]))[0] for sine in (s, -s))
        return np.hypot(calibration.slope(q)[1], (plus - minus) / 2)

    def covers(self, t: Array) -> NDArray[np.bool_]:
        """Return whether the calibration can compensate a measurement at tilts (k, 2), (k,)."""
        return np.asarray(self.extrapolate | self.sensor.calibration.supported(self._tilt(t)))

    def _tilt(self, t: Array) -> Array:
        normals = t @ across(self.beam) - self.beam
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return tilt(self.beam, self.sensor.triangulation_normal, normals)

    def table(self, max_inclination: float) -> Callable[[Array], Array]:
        """Return the uncertainty as a function of tilts (k, 2), interpolated in a table for speed.

        At tilts that the calibration does not cover, the uncertainty is that without compensation.
        """
        steep = np.linspace(0.0, max_inclination, max(2, round(max_inclination / _TABLE_STEP) + 1))
        azimuth = np.linspace(-np.pi, np.pi, round(2 * np.pi / _TABLE_STEP) + 1)
        A, B = np.meshgrid(steep, azimuth, indexing="ij")
        t = np.stack([np.tan(A) * np.cos(B), np.tan(A) * np.sin(B)], axis=-1).reshape(-1, 2)
        values = np.where(self.covers(t), self.at(t), _UNCOMPENSATED).reshape(A.shape)
        per_step = np.array([(n - 1) / (x[-1] - x[0]) for x, n in ((steep, steep.size), (azimuth, azimuth.size))])

        def look_up(t: Array) -> Array:
            coordinates = np.stack([np.arctan(np.hypot(t[:, 0], t[:, 1])), np.arctan2(t[:, 1], t[:, 0]) + np.pi])
            return np.asarray(map_coordinates(values, coordinates * per_step[:, None], order=1, mode="nearest"))

        return look_up


def _remaining(settings: BeamDirectionSettings) -> RemainingError | None:
    """Return the remaining error with the calibration of the settings; None without calibration."""
    if settings.compensation is not None and settings.layout.triangulation_normal is None:
        raise MethodError(f"layout.triangulation_normal: {NORMAL_NEEDED}", code="beam.triangulation_normal.missing")
    raw = expected(settings)
    sensor = Sensor.of(raw, settings)
    return RemainingError(sensor, raw["nominal_direction"].values, settings.extrapolate) if sensor else None


def _angles(settings: BeamDirectionSettings) -> Array:
    return np.array([(face.inclination, face.rotation) for face in settings.planes])


def _larger_u(covariance: Array, limits: Limits) -> float:
    """Return the larger uncertainty of the beam's two angles, rad, from the covariance (6, 6) of its errors.

    A rotation about the beam itself is unknown, and none of the two.
    """
    basis = across(limits.beam)
    return design.worst_angle(basis @ np.nan_to_num(covariance[3:, 3:]) @ basis.T)


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
