"""Surface points from the readings of a calibrated beam, with independent covariance and common influences.

The point of a reading d at the position s of the stage is p = p0 + s + d u, with the zero point p0 and the unit vector
u of the beam; readings increase with the distance from the sensor. The noise is independent for each point. Errors of
the beam and of the calibration of its inclination error are common to the whole scan: they are stored as influences,
not as scatter.

The inclination error depends on the surface's normal and the normal on the points. If the normals are not given, both
are determined by iteration until the points no longer change.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.datasets.calibrations.inclination import InclinationCalibration
from errormotion.errors import MethodError
from errormotion.kinematics.beams import tilt
from errormotion.methods.beam_direction.identification.check_bar.surfaces import (
    Surface,
    along_curve,
    over_surface,
    round_bar,
)

__all__ = ["Points", "Surface", "along_curve", "over_surface", "points", "round_bar"]


CONVERGENCE_LIMIT = 1e-10
"""Change of a point, m, below which the iteration ends."""
MAX_ITERATIONS = 50
"""Largest number of iterations of normals and points."""
_ROUNDING = 1e-9
_UNIT_NORM = 1e-6


@dataclass(frozen=True, eq=False)
class Points:
    """Points of a surface.

    Attributes
    ----------
    points : ndarray (n, 3)
        m; NaN for missing readings.
    covariance : ndarray (n, 3, 3)
        Independent part of each point: noise of reading and stage, m^2.
    influence : ndarray (source, n, 3)
        Signed effect, m, of one standard uncertainty of each source that all points share.
    sources : tuple of str
        Names of these sources, common to all scans with the same beam and calibration.
    reading : ndarray (n,)
        Uncorrected readings, m.
    distance : ndarray (n,)
        With the inclination error corrected, m; the same as `reading` without calibration.
    direction : ndarray (3,)
        Direction of the beam.
    normals : ndarray (n, 3) or None
        Unit normals towards the sensor, if they are known.
    tilt : ndarray (n, 2) or None
        Tilt vectors of the surface to the beam, if a calibration was used.
    iterations : int
        Number of iterations of the normals.
    notes : tuple of str
        Warnings and remarks.
    """

    points: Array
    covariance: Array
    influence: Array
    sources: tuple[str, ...]
    reading: Array
    distance: Array
    direction: Array
    normals: Array | None = None
    tilt: Array | None = None
    iterations: int = 0
    notes: tuple[str, ...] = ()


def points(
    reading: ArrayLike,
    stage: ArrayLike,
    origin: ArrayLike,
    direction: ArrayLike,
    *,
    covariance: ArrayLike | None = None,
    noise: float = 0.0,
    stage_noise: float = 0.0,
    calibration: InclinationCalibration | None = None,
    triangulation_normal: ArrayLike | None = None,
    mid_range: float | None = None,
    normals: ArrayLike | Surface | None = None,
    moves: Literal["sensor", "target"] = "sensor",
    extrapolate: bool = False,
) -> Points:
    """Return the points that a beam measured.

    Parameters
    ----------
    reading : array_like (n,)
        m, increasing with the distance; NaN where missing.
    stage : array_like (n, 3)
        Position of the stage at each reading, m.
    origin, direction : array_like (3,)
        Zero point of the beam while the stage is at 0, m, and the unit vector along which readings increase.
    covariance : array_like (6, 6), optional
        Of (origin, direction), common to all points.
    noise, stage_noise : float
        Standard deviation of one reading, and of each coordinate of the stage, m.
    calibration : InclinationCalibration, optional
        Of the sensor; without it the readings are not corrected.
    triangulation_normal : array_like (3,), optional
        Normal of the plane of emitted and received beam; needed with a calibration.
    mid_range : float, optional
        Reading at which the inclination error vanishes, m; default: that of the calibration.
    normals : array_like (n, 3) or Surface, optional
        Unit normals, or a function that returns them from the points: `along_curve`, `over_surface`, `round_bar` or
        another. By default, `along_curve` in its plane for a scan along one line, `over_surface` for any other.
    moves : {"sensor", "target"}
        What the stage carries; if it is the target, the points are in the target's own frame.
    extrapolate : bool
        Compensate also where the calibration does not cover the tilt or the depth.

    Raises
    ------
    MethodError
        Input of the wrong shape, a beam without origin, a calibration without triangulation normal, normals that are
        perpendicular to the beam or do not converge, tilts and readings outside the calibration.
    """
    r, s = np.asarray(reading, float), np.asarray(stage, float)
    if r.ndim != 1 or s.shape != (len(r), 3):
        raise MethodError(
            f"Expected readings (n,) and stage positions (n, 3); found {r.shape} and {s.shape}.", code="beam.scan.shape"
        )
    beam = _beam(origin, direction, covariance)
    measured = np.isfinite(r) & np.isfinite(s).all(axis=1)
    if not measured.any():
        raise MethodError("Expected readings; found only NaN.", code="beam.scan.no_readings")
    if moves not in ("sensor", "target"):
        raise MethodError(f"moves: expected 'sensor' or 'target'; found '{moves}'.", code="raw.moves.form")
    positions = s[measured] if moves == "sensor" else -s[measured]
    scan = _Scan(r[measured], positions, beam, calibration, triangulation_normal, mid_range, extrapolate)
    surface, notes = _surface(normals, measured, scan)
    distance, N, iterations = _converged(scan, surface)
    notes += _extrapolated(scan, N)

    influence, sources = _influences(scan, N, distance)
    # The compensation scales the noise of the reading.
    stretch = 1.0 if N is None or calibration is None else 1 / (1 + calibration.slope(scan.tilt(N))[0])
    u = scan.direction
    along = (noise * np.broadcast_to(stretch, distance.shape)) ** 2
    own = along[:, None, None] * np.outer(u, u) + stage_noise**2 * np.eye(3)

    def spread(values: Array | None, axis: int = 0) -> Array | None:
        if values is None:
            return None
        full = np.full((*values.shape[:axis], len(r), *values.shape[axis + 1 :]), np.nan)
        full[(slice(None),) * axis + (measured,)] = values
        return full

    filled = [spread(values) for values in (scan.position(distance), own, distance)]
    p, C, d = (np.asarray(values) for values in filled)
    return Points(
        points=p,
        covariance=C,
        influence=np.asarray(spread(influence, 1)),
        sources=sources,
        reading=r,
        distance=d,
        direction=u,
        normals=spread(N),
        tilt=spread(scan.tilt(N)) if N is not None and calibration is not None else None,
        iterations=iterations,
        notes=notes,
    )


@dataclass(frozen=True)
class _Scan:
    """Valid readings and the data for their conversion to points."""

    reading: Array
    stage: Array
    beam: tuple[Array, Array, Array | None]
    calibration: InclinationCalibration | None
    triangulation_normal: ArrayLike | None
    mid_range: float | None
    extrapolate: bool

    @property
    def direction(self) -> Array:
        return self.beam[1]

    def position(self, distance: Array, origin: Array | None = None, direction: Array | None = None) -> Array:
        """Return the points (n, 3) at these distances, of this beam or of another one."""
        p0, u, _ = self.beam
        p0, u = p0 if origin is None else origin, u if direction is None else direction
        return np.asarray(self.stage + p0 + distance[:, None] * u)

    def tilt(self, normals: Array, direction: Array | None = None) -> Array:
        """Return the tilt vectors (n, 2) of a surface with these normals."""
        if self.triangulation_normal is None:
            raise MethodError(
                "Expected triangulation_normal with a calibration: the normal of the plane of the emitted and the "
                "received beam, which states the rotation of the sensor about its beam.",
                code="beam.scan.triangulation_normal",
            )
        return np.asarray(tilt(self.beam[1] if direction is None else direction, self.triangulation_normal, normals))

    def facing(self, normals: Array) -> Array:
        """Return normals (n, 3) turned towards the sensor."""
        cosine = -(normals @ self.direction)
        if not (np.abs(cosine) > _ROUNDING).all():
            raise MethodError(
                "The beam is parallel to the surface at some points, where no reading is possible. Check the normals.",
                code="beam.scan.parallel",
            )
        return np.asarray(normals * np.sign(cosine)[:, None])


def _beam(origin: ArrayLike, direction: ArrayLike, covariance: ArrayLike | None) -> tuple[Array, Array, Array | None]:
    p0, u = np.asarray(origin, float), np.asarray(direction, float)
    if p0.shape != (3,) or not np.isfinite(p0).all():
        raise MethodError(
            f"Expected the beam's origin, three lengths; found {p0.tolist()}. State 0 0 0 for form and size only.",
            code="beam.scan.origin",
        )
    if u.shape != (3,) or not abs(np.linalg.norm(u) - 1) <= _UNIT_NORM:
        raise MethodError(
            f"Expected the beam's direction, a unit vector of three numbers; found {u.tolist()}.",
            code="beam.scan.direction",
        )
    if covariance is None:
        return p0, u, None
    C = np.asarray(covariance, float)
    if C.shape != (6, 6) or not np.isfinite(C).all():
        raise MethodError(
            f"Expected the covariance of (origin, direction), 6 x 6 numbers; found {C.shape}.",
            code="beam.scan.covariance",
        )
    return p0, u, C


def _surface(
    normals: ArrayLike | Surface | None, measured: NDArray[np.bool_], scan: _Scan
) -> tuple[Array | Surface | None, tuple[str, ...]]:
    """Return the normals or a function for them, and notes."""
    if callable(normals):
        return normals, ()
    if normals is not None:
        N = np.asarray(normals, float)
        if N.shape != (len(measured), 3) or not (np.abs(np.linalg.norm(N[measured], axis=1) - 1) <= _UNIT_NORM).all():
            raise MethodError(
                f"Expected unit normals ({len(measured)}, 3), one for each reading; found {N.shape}.",
                code="beam.scan.normals",
            )
        return scan.facing(N[measured]), ()
    if scan.calibration is None:
        return None, ()
    centred = scan.stage - scan.stage.mean(axis=0)
    _, spread, directions = np.linalg.svd(centred, full_matrices=False)
    if len(spread) > 1 and spread[1] > 1e-3 * spread[0]:
        return over_surface(), ()
    axis = np.cross(directions[0], scan.direction)
    if np.linalg.norm(axis) < 1e-3:
        raise MethodError(
            "The stage moved only along the beam: the tilt cannot be determined from such a scan. State the normals.",
            code="beam.scan.along_beam",
        )
    note = (
        "The scan is along one line, which determines only the tilt in the plane of the scan; the tilt across it "
        "is assumed to be 0. If the surface is inclined across the scan, state its normals or the "
        "surface, such as round_bar(axis)."
    )
    return along_curve(axis / np.linalg.norm(axis)), (note,)


def _converged(scan: _Scan, surface: Array | Surface | None) -> tuple[Array, Array | None, int]:
    """Return distances (n,), normals (n, 3) and the number of iterations."""
    if surface is None:
        return scan.reading, None, 0
    if not callable(surface):
        return _compensated(scan, surface), surface, 0
    distance = scan.reading
    for iteration in range(1, MAX_ITERATIONS + 1):
        N = scan.facing(surface(scan.position(distance)))
        before, distance = distance, _compensated(scan, N)
        if np.abs(distance - before).max() < CONVERGENCE_LIMIT:
            return distance, N, iteration
    change = np.abs(distance - before).max()
    raise MethodError(
        f"Normals and points do not converge: after {MAX_ITERATIONS} iterations the points still change by "
        f"{1e6 * change:.3g} um. The distance of the neighbours is too small for the noise: use more neighbours, or "
        "state the surface, such as round_bar(axis).",
        code="beam.scan.not_converged",
    )


def _compensated(scan: _Scan, normals: Array) -> Array:
    if scan.calibration is None:
        return scan.reading
    q = scan.tilt(normals)
    return np.asarray(scan.calibration.compensate(scan.reading, q, scan.mid_range, scan.extrapolate).value)


def _extrapolated(scan: _Scan, normals: Array | None) -> tuple[str, ...]:
    """Return a note with the number of points at tilts outside the calibration; ``normals`` (n, 3)."""
    if scan.calibration is None or normals is None:
        return ()
    beyond = int((~scan.calibration.supported(scan.tilt(normals))).sum())
    if not beyond:
        return ()
    return (
        f"{beyond} of {len(normals)} points are at tilts that the calibration '{scan.calibration.name}' does not "
        "cover: their correction is extrapolated.",
    )


def _influences(scan: _Scan, normals: Array | None, distance: Array) -> tuple[Array, tuple[str, ...]]:
    """Return the effect (source, n, 3) of one standard uncertainty of each common source."""
    effects: list[Array] = []
    sources: list[str] = []
    p0, u, C = scan.beam
    calibration = scan.calibration

    def moved(step: Array) -> Array:
        direction = u + step[3:]
        d = distance
        if calibration is not None and normals is not None:
            q = scan.tilt(normals, direction)
            d = calibration.compensate(scan.reading, q, scan.mid_range, extrapolate=True).value
        return scan.position(d, p0 + step[:3], direction)

    for k, step in enumerate(factors(C) if C is not None else ()):
        effects.append((moved(step) - moved(-step)) / 2)
        sources.append(f"beam {k + 1}")
    if calibration is not None and normals is not None:
        q = scan.tilt(normals)
        J = calibration.compensate(scan.reading, q, scan.mid_range, extrapolate=True).jacobian
        for k, step in enumerate(factors(calibration.coefficient_covariance)):
            effects.append((J @ step)[:, None] * u)
            sources.append(f"inclination calibration {k + 1}")
    return np.array(effects).reshape(-1, len(distance), 3), tuple(sources)


def factors(covariance: Array) -> Array:
    """Return a square root (k, p) of a covariance (p, p): independent steps of one standard uncertainty each."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(covariance / scale[:, None] / scale)
    if values[0] < -1e-8 * max(values[-1], 1.0):
        raise MethodError(
            "Expected a covariance; found a matrix with a negative eigenvalue.", code="beam.scan.covariance"
        )
    kept = values > 1e-12 * max(values[-1], 0.0)
    return np.asarray((vectors[:, kept] * np.sqrt(values[kept])).T * scale)
