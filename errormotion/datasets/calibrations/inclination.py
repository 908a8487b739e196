"""Calibrations of the inclination error of a sensor: effect of the tilt of a surface on a reading, with uncertainty.

A sensor whose beam meets the surface at the tilt q = tan(alpha) (cos beta, sin beta) reads

    r = d + (d - m) k(q),

d the true depth, m the reading at which the inclination error vanishes. k is a sum of products of Legendre polynomials
in the two parts of x = tan(alpha / 2) (cos beta, sin beta) / s, where s puts the steepest calibrated setting at 1: the
normal of the surface is a rational function of x, so fewer terms do than in q. The coefficients are one Gaussian: their
covariance carries the noise, the scatter from setting to setting, and what the chosen order may leave out. All readings
that are compensated share it (`Compensated.jacobian`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.polynomial.legendre import legvander
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.datasets.calibrations import owner
from errormotion.datasets.calibrations.tilt_support import Hole, TiltSupport
from errormotion.datasets.checks import dims, magnitude_violations, storable_violations
from errormotion.datasets.files.folders import folders_beside
from errormotion.datasets.provenance import hash_dataset
from errormotion.datasets.schemas import Row
from errormotion.datasets.storage.disk import load as load_dataset
from errormotion.datasets.storage.disk import reading, save
from errormotion.errors import DatasetError, MethodError
from errormotion.kinematics.beams import inclination_rotation, tilt_vector

SCHEMA = "errormotion.calibration.inclination/1"
"""Schema of the calibration dataset."""
FOLDER = "calibrations"
"""Folder in which a calibration is looked for by its name."""
VARIABLE = "ERRORMOTION_CALIBRATIONS"
"""Environment variable that names one more such folder."""

EXTRAPOLATION = 0.05
"""Largest extrapolation beyond the calibrated range of readings, as a share of it."""

_DEPTH = (-0.2, 0.2)  # m; ranges of point sensors, and mm show
_SLOPE = (-0.5, 0.5)  # an error of half the depth is no inclination error
_FREE = (-float("inf"), float("inf"))

ROWS = (
    Row("coefficient", ("term",), "1", *_FREE, "of each product of Legendre polynomials"),
    Row(
        "coefficient_covariance",
        ("term", "term_"),
        "1",
        *_FREE,
        "of the coefficients: noise, scatter of the settings and what the order leaves out",
    ),
    Row("degree", ("term", "axis"), "", 0, 20, "degrees of the two polynomials of each term"),
    Row("tilt_scale", (), "1", 1e-6, 1.0, "s: tan of half the steepest calibrated inclination"),
    Row("mid_range", (), "m", *_DEPTH, "reading at which the error vanishes, as stated"),
    Row("mid_range_found", (), "m", *_FREE, "the same, estimated from the readings; NaN where undetermined"),
    Row("mid_range_uncertainty", (), "m", 0.0, _FREE[1], "standard uncertainty of that; NaN where unknown"),
    Row("reading_low", (), "m", *_DEPTH, "lowest calibrated reading"),
    Row("reading_high", (), "m", *_DEPTH, "highest calibrated reading"),
    Row(
        "support_gap",
        (),
        "1",
        0.0,
        20.0,
        "widest empty circle between calibrated tilts that counts as surrounded",
    ),
    Row("support_margin", (), "1", 0.0, 20.0, "how far from joined calibrated tilts a tilt may lie"),
    Row("inclination", ("setting",), "rad", -1.5, 1.5, "of each setting that was fitted"),
    Row("rotation", ("setting",), "rad", -6.3, 6.3, "of each setting that was fitted"),
    Row("slope", ("setting",), "1", *_SLOPE, "k of each setting from its own readings"),
    Row("slope_uncertainty", ("setting",), "1", 0.0, 1.0, "its standard uncertainty from the noise"),
    Row("offset", ("setting",), "m", -0.1, 0.1, "zero of each setting's interferometer readings against the sensor's"),
    Row("slope_predicted", ("setting",), "1", *_SLOPE, "k at each setting, by a fit to all the others"),
    Row("slope_predicted_uncertainty", ("setting",), "1", 0.0, 1.0, "standard uncertainty of that prediction"),
    Row("setting_left_out", ("setting",), "", 0, 1, "1: the setting contradicts all the others and was left out"),
    Row("noise", (), "m", 0.0, 1e-3, "standard deviation of one reading about the line of its setting"),
    Row("scatter", (), "1", 0.0, 1e3, "how many times as much as their noise the settings scatter about the surface"),
    Row("group_setting", ("group",), "", 0, 1e7, "setting of each group of readings that was fitted"),
    Row("group_depth", ("group",), "m", *_DEPTH, "its reference minus `mid_range`"),
    Row("group_residual", ("group",), "m", -0.1, 0.1, "its reading minus the line of its setting"),
    Row("group_left_out", ("group",), "", 0, 1, "1: the reading does not belong to that line and was left out"),
    Row("remaining_error", (), "1", 0.0, 1.0, "rms of `slope` minus `slope_predicted`: the cross-validated error of k"),
    Row("remaining_error_interval", ("limit",), "1", 0.0, 1.0, "95 % interval of `remaining_error`: low, high"),
)
"""The calibration dataset, one row a variable."""

ATTRIBUTES = {
    "schema": f"`{SCHEMA}`",
    "order": "order of the polynomial that cross-validation chose",
    "mirror": "1: even in q2, the plane of triangulation is a plane of symmetry; 0: not",
    "provenance": "JSON text: settings with defaults, hash of the raw dataset, instruments, software",
}
_ALL_AROUND = 359.0
"""Width of a hole along the rotation from which on it goes all around, deg."""
_SIZES = {"axis": 2, "limit": 2}
_MAY_BE_UNKNOWN = ("mid_range_found", "mid_range_uncertainty")


@dataclass(frozen=True)
class Compensated:
    """Readings with the inclination error taken off, and the raw ones.

    Attributes
    ----------
    raw : ndarray (...)
        As they were read, m.
    value : ndarray (...)
        True depths d = (r + m k) / (1 + k), m.
    uncertainty : ndarray (...)
        Standard uncertainty of `value` that comes from the calibration, m; the noise of the reading is not in it.
    jacobian : ndarray (..., term)
        Derivative of `value` by the coefficients of the calibration, m: all readings share their covariance.
    """

    raw: Array
    value: Array
    uncertainty: Array
    jacobian: Array


class InclinationCalibration:
    """The calibrated inclination error of one sensor.

    Parameters
    ----------
    dataset : Dataset
        Of the schema `SCHEMA`.

    Raises
    ------
    DatasetError
        The dataset breaks its schema.
    """

    def __init__(self, dataset: xr.Dataset) -> None:
        found = violations(dataset)
        if found:
            raise DatasetError(f"The calibration breaks its schema ({SCHEMA}):", found)
        self.dataset = dataset.load()
        self.name = str(dataset.attrs.get("name", "calibration"))
        self.coefficients = self._values("coefficient")
        self.coefficient_covariance = self._values("coefficient_covariance")
        self.mid_range = float(dataset["mid_range"])
        self._degrees = self._values("degree").astype(int)
        self._scale = float(dataset["tilt_scale"])

    def _values(self, name: str) -> Array:
        row = next(row for row in ROWS if row.name == name)
        return np.asarray(self.dataset[name].transpose(*row.dims).values, dtype=float)

    @classmethod
    def load(cls, path: str | Path) -> InclinationCalibration:
        """Read a calibration.

        Raises
        ------
        DatasetError
            Nothing there, damaged, or no calibration of this schema.
        """
        with reading(path), load_dataset(path) as dataset:
            schema = dataset.attrs.get("schema", "none")
            if schema != SCHEMA:
                hint = ""
                if str(schema).startswith("errormotion.raw.inclination/"):
                    hint = (
                        f". These are readings: make a calibration of them with 'errormotion calibrate {path} -o FILE'"
                    )
                raise DatasetError(f"{path}: expected a calibration ({SCHEMA}); found schema {schema}{hint}")
            try:
                return cls(dataset.load().assign_attrs(name=Path(path).stem))
            except DatasetError as error:
                raise DatasetError(
                    f"{path}: the calibration breaks its schema ({SCHEMA}):", error.violations
                ) from error

    @classmethod
    def find(cls, name: str | Path, folder: str | Path | None = None) -> InclinationCalibration:
        """Load a calibration by path, or by name.

        Parameters
        ----------
        name : str or Path
            A path, taken from ``folder`` if it is relative and from the working folder if it is not there; or a bare
            name: ``NAME.nc`` in the folder `calibrations` of ``folder``, in that of the working folder, or in the
            folder that the environment variable ``ERRORMOTION_CALIBRATIONS`` names. While a campaign runs, the folder
            of its file counts as ``folder`` does.
        folder : str or Path, optional
            Folder of the file that names the calibration.

        Raises
        ------
        DatasetError
            Not found (with the paths that were searched and the calibrations found there), or no calibration.
        """
        bases = [Path(folder)] if folder is not None else []
        bases += [base for base in dict.fromkeys((*folders_beside(), Path.cwd())) if base not in bases]
        places = [base / name for base in bases]
        homes: list[Path] = []
        if len(Path(name).parts) == 1:
            homes = [base / FOLDER for base in bases]
            homes += [Path(os.environ[VARIABLE])] if os.environ.get(VARIABLE) else []
            file = str(name) if str(name).endswith(".nc") else f"{name}.nc"
            places = [home / file for home in homes] + [place for place in places if place.suffix]
        for place in places:
            if place.exists():
                return cls.load(place)
        there = sorted({path.stem for home in homes if home.is_dir() for path in home.glob("*.nc")})
        known = f" Calibrations there: {', '.join(there)}." if there else ""
        raise DatasetError(
            f"calibration '{name}': not found. Searched: {', '.join(map(str, places))}.{known} Give a path, or copy "
            f"the file to one of these folders; {VARIABLE} names one more folder"
        )

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the calibration to a NetCDF file, whole or not at all."""
        return save(self.dataset, path, overwrite=overwrite)

    @property
    def serial_number(self) -> str:
        """Serial number of the calibrated sensor; empty where the file does not state it."""
        return owner.serial_number(self.dataset.attrs, "point_lds")

    def require_sensor(self, serial_number: str, mid_range: float, *, allow_other_sensor: bool = False) -> list[str]:
        """Return notes on the use with a sensor; see `owner.compare`.

        Parameters
        ----------
        serial_number : str
            Of the sensor that measures; empty where unknown.
        mid_range : float
            Of its readings, m.
        allow_other_sensor : bool
            Whether another sensor is noted instead of refused.

        Raises
        ------
        DatasetError
            The calibration belongs to a sensor with another serial number or another mid range.
        """
        mid_ranges = self.mid_range, mid_range
        return owner.compare(
            self.name, self.serial_number, serial_number, mid_ranges=mid_ranges, allow_other_sensor=allow_other_sensor
        )

    @property
    def order(self) -> int:
        """Order of the polynomial that cross-validation chose; the terms of higher order are what it may leave out."""
        return int(self.dataset.attrs["order"])

    @property
    def settings(self) -> Array:
        """Tilt vectors (setting, 2) of the calibrated settings; those that were left out are not among them."""
        used = self._values("setting_left_out") == 0
        return np.asarray(tilt_vector(self._values("inclination"), self._values("rotation"))[used])

    def reference(self) -> dict[str, str]:
        """Return name and hash for the provenance of a result; the hash does not depend on the name."""
        attrs = {name: value for name, value in self.dataset.attrs.items() if name != "name"}
        return {"name": self.name, "hash": hash_dataset(self.dataset.drop_attrs(deep=False).assign_attrs(attrs))}

    @cached_property
    def support(self) -> TiltSupport:
        """The region of tilts that the calibrated settings support."""
        return TiltSupport(self.settings, float(self.dataset["support_gap"]), float(self.dataset["support_margin"]))

    def jacobian(self, q: ArrayLike) -> Array:
        """Return the derivative (..., term) of k at tilts (..., 2) by the coefficients."""
        return terms(half_tilt(np.asarray(q, float)) / self._scale, self._degrees)

    def slope(self, q: ArrayLike) -> tuple[Array, Array]:
        """Return k at tilts (..., 2) and its standard uncertainty, wherever they lie; see `supported`."""
        J = self.jacobian(q)
        return J @ self.coefficients, _deviation(J, self.coefficient_covariance)

    def grid(self, count: int = 61) -> xr.Dataset:
        """Return k (`slope`), its standard `uncertainty` and `supported` over a grid of tilts q1, q2, for a map."""
        steepest = 1.05 * float(np.hypot(*self.settings.T).max())
        axis = np.linspace(-steepest, steepest, count)
        q = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
        k, u = self.slope(q)
        dims = ("q1", "q2")
        return xr.Dataset(
            {"slope": (dims, k), "uncertainty": (dims, u), "supported": (dims, self.supported(q))},
            {"q1": axis, "q2": axis},
        )

    def supported(self, q: ArrayLike) -> NDArray[np.bool_]:
        """Return whether calibrated settings surround each tilt (..., 2) closely enough."""
        return self.support.holds(np.asarray(q, float))

    def require(self, q: ArrayLike) -> None:
        """Refuse tilts (..., 2) outside the support of the calibration; NaN is accepted.

        Raises
        ------
        MethodError
            Names the first such tilt, how many there are, and the calibrated settings nearest to it.
        """
        points = np.asarray(q, float).reshape(-1, 2)
        points = points[np.isfinite(points).all(axis=1)]
        wrong = points[~self.supported(points)]
        if not len(wrong):
            return
        first = wrong[np.argmax(np.hypot(*wrong.T))]
        near = "; ".join(tilt_text(setting) for setting in self.support.nearest(first))
        steepest = np.hypot(*self.settings.T).max()
        where = (
            "beyond the steepest calibrated setting"
            if np.hypot(*first) > steepest + self.support.margin
            else "in a hole between the calibrated settings"
        )
        many = f" ({len(wrong)} of {len(points)} such tilts)" if len(points) > 1 else ""
        raise MethodError(
            f"Calibration '{self.name}': {tilt_text(first)} lies {where}{many}; nearest calibrated: {near}. "
            "Calibrate there, measure within the calibrated settings, or allow extrapolation (extrapolate = true in "
            "the test's settings): the uncertainty then grows with the distance."
        )

    def compensate(
        self, reading: ArrayLike, q: ArrayLike, mid_range: float | None = None, extrapolate: bool = False
    ) -> Compensated:
        """Compensate readings for the inclination error.

        Parameters
        ----------
        reading : array_like (...)
            m; NaN stays NaN.
        q : array_like (..., 2)
            Tilt vectors, broadcast against the readings; NaN makes NaN.
        mid_range : float, optional
            Reading at which the error vanishes, m; default: that of the calibration.
        extrapolate : bool
            Compensate also outside the support and the calibrated range.

        Raises
        ------
        MethodError
            A tilt outside the support, or a reading outside the calibrated range.
        """
        r, q = np.asarray(reading, float), np.asarray(q, float)
        m = self.mid_range if mid_range is None else float(mid_range)
        if not extrapolate:
            self.require(q)
            self._require_depth(r - m)
        J = self.jacobian(q)
        k = J @ self.coefficients
        d = (r + m * k) / (1 + k)
        by_k = (m - d) / (1 + k)
        return Compensated(
            np.broadcast_to(r, d.shape).copy(),
            d,
            np.abs(by_k) * _deviation(J, self.coefficient_covariance),
            by_k[..., None] * J,
        )

    def _require_depth(self, depth: Array) -> None:
        low, high = (float(self.dataset[name]) - self.mid_range for name in ("reading_low", "reading_high"))
        spare = EXTRAPOLATION * (high - low)
        wrong = depth[(depth < low - spare) | (depth > high + spare)]
        if wrong.size:
            worst = wrong.flat[np.argmax(np.abs(wrong))]
            raise MethodError(
                f"Calibration '{self.name}': a reading {1e3 * worst:.3f} mm from mid range lies beyond the calibrated "
                f"{1e3 * low:.3f} to {1e3 * high:.3f} mm ({wrong.size} of {depth.size} readings). Is the mid range of "
                "the sensor right? Else measure within that range, or allow extrapolation (extrapolate = true in the "
                "test's settings)."
            )


def half_tilt(q: Array) -> Array:
    """Return tan(alpha / 2) (cos beta, sin beta) of tilt vectors (..., 2)."""
    return np.asarray(q / (1.0 + np.sqrt(1.0 + (q**2).sum(axis=-1, keepdims=True))))


def terms(x: Array, degrees: NDArray[np.int64]) -> Array:
    """Return the products (..., term) of Legendre polynomials of degrees (term, 2) at points (..., 2)."""
    highest = int(degrees.max(initial=0))
    first, second = legvander(x[..., 0], highest), legvander(x[..., 1], highest)
    return np.asarray(first[..., degrees[:, 0]] * second[..., degrees[:, 1]])


def tilt_text(q: Array) -> str:
    """Return a tilt vector (2,) as text: inclination and rotation."""
    alpha, beta = inclination_rotation(q)
    return f"inclination {np.degrees(alpha):.1f} deg at rotation {np.degrees(beta):.1f} deg"


def hole_texts(holes: Sequence[Hole]) -> list[str]:
    """Return holes as texts; holes between the same inclinations, as symmetry makes them, in one text."""
    texts: dict[str, list[str]] = {}
    for hole in holes:
        low, high = np.degrees(hole.inclination)
        start, end = np.degrees(hole.rotation)
        where = "" if end - start > _ALL_AROUND else f"{start:.0f} to {end % 360:.0f}"
        texts.setdefault(f"inclination {low:.0f} to {high:.0f} deg", []).append(where)
    holes_found = []
    for inclination, found in texts.items():
        *first, last = found
        rotations = f"{', '.join(first)} and {last}" if first else last
        holes_found.append(f"{inclination} at " + (f"rotation {rotations} deg" if last else "every rotation"))
    return holes_found


def violations(ds: xr.Dataset) -> list[str]:
    """Return everything in which a calibration dataset breaks its schema, one sentence each."""
    found = storable_violations(ds)
    if ds.attrs.get("schema") != SCHEMA:
        found.append(f"attribute 'schema': expected '{SCHEMA}'; found {ds.attrs.get('schema')!r}")
    found += [
        f"attribute '{name}': missing; expected {what}" for name, what in ATTRIBUTES.items() if name not in ds.attrs
    ]
    found += [
        f"dimension {dim}: expected {size}; found {ds.sizes[dim]}"
        for dim, size in _SIZES.items()
        if ds.sizes.get(dim, size) != size
    ]
    for row in ROWS:
        found += _row_violations(ds, row)
    if not found:
        found += _covariance_violations(ds["coefficient_covariance"].transpose("term", "term_").values)
    return found


def _row_violations(ds: xr.Dataset, row: Row) -> list[str]:
    if row.name not in ds.variables:
        return [f"{row.name}({', '.join(row.dims)}): missing; expected {row.meaning}"]
    variable = ds.variables[row.name]
    if set(variable.dims) != set(row.dims):
        return [f"{row.name}: expected dims ({', '.join(row.dims)}); found {dims(variable)}"]
    if variable.size == 0:
        return [f"{row.name}: expected values; found none (a dimension has length 0)"]
    complaints = magnitude_violations(row.name, variable, row)
    if not complaints and row.name not in _MAY_BE_UNKNOWN and np.isnan(variable.values.astype(float)).any():
        complaints = [f"{row.name}: expected numbers; found NaN"]
    return complaints


def _covariance_violations(C: Array) -> list[str]:
    if C.shape[0] != C.shape[1]:
        return [f"coefficient_covariance: expected a square matrix; found {C.shape[0]} x {C.shape[1]}"]
    scale = np.sqrt(np.abs(np.diag(C)))
    scale[scale == 0] = 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        correlation = C / scale[:, None] / scale
        symmetric = np.abs(correlation - correlation.T).max() <= 1e-8  # not so where numbers are beyond all bounds
    if not symmetric or np.linalg.eigvalsh(correlation).min() < -1e-8:
        return ["coefficient_covariance: expected a symmetric matrix without negative variances; found another"]
    return []


def _deviation(J: Array, C: Array) -> Array:
    """Return the standard deviation (...) of linear combinations (..., term) of the coefficients."""
    return np.asarray(np.sqrt(np.maximum(((J @ C) * J).sum(axis=-1), 0.0)))


def build(variables: Mapping[str, Any], attrs: Mapping[str, Any]) -> xr.Dataset:
    """Return a calibration dataset from values by name: dims and units come from the schema."""
    data = {}
    for row in ROWS:
        units = {"units": row.unit} if row.unit else {}
        data[row.name] = (row.dims, np.asarray(variables[row.name]), {**units, "long_name": row.meaning})
    return xr.Dataset(data, attrs={**attrs, "schema": SCHEMA})
