"""Calibrations of the inclination error of a sensor: effect of the tilt of a surface on a reading, with uncertainty.

At a surface with the tilt q = tan(alpha) (cos beta, sin beta) to the beam, the reading is

    r = d + (d - m) k(q),

d the true depth, m the reading at which the inclination error vanishes. k is a sum of products of Legendre polynomials
in the two components of x = tan(alpha / 2) (cos beta, sin beta) / s, where s scales the steepest calibrated setting to
1: the normal of the surface is a rational function of x, so that fewer terms are needed than in q. The coefficients
have a joint normal distribution, whose covariance includes the noise, the scatter from setting to setting, and the
terms beyond the chosen order. All compensated readings share it (`Compensated.jacobian`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import xarray as xr
from numpy.polynomial.legendre import legvander
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.datasets.calibrations import owner
from errormotion.datasets.calibrations.dataset import Calibration, assemble, table_violations
from errormotion.datasets.calibrations.tilt_support import Hole, TiltSupport
from errormotion.datasets.files.folders import folders_beside
from errormotion.datasets.files.reading import visible
from errormotion.datasets.provenance import hash_dataset
from errormotion.datasets.schemas import Row
from errormotion.errors import DatasetError, MethodError
from errormotion.kinematics.beams import inclination_rotation, tilt_vector

SCHEMA = "errormotion.calibration.inclination/1"
"""Schema of the calibration dataset."""
FOLDER = "calibrations"
"""Folder in which a calibration is searched by its name."""
VARIABLE = "ERRORMOTION_CALIBRATIONS"
"""Environment variable with the path of a further such folder."""

ROTATION_ZERO, AWAY = "rotation_zero", "away from the receiver"
"""Attribute of a calibration with the direction in which a surface's normal leans at rotation 0, and its value."""
EXTRAPOLATION = 0.05
"""Largest extrapolation beyond the calibrated range of readings, as a fraction of it."""

_DEPTH = (-0.2, 0.2)  # m; ranges of point sensors, detects mm
_SLOPE = (-0.5, 0.5)  # larger errors are not inclination errors
_FREE = (-float("inf"), float("inf"))

ROWS = (
    Row("coefficient", ("term",), "1", *_FREE, "of each product of Legendre polynomials"),
    Row(
        "coefficient_covariance",
        ("term", "term_"),
        "1",
        *_FREE,
        "of the coefficients: noise, scatter of the settings and terms beyond the order",
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
    Row("support_margin", (), "1", 0.0, 20.0, "largest distance of a tilt from joined calibrated tilts"),
    Row("inclination", ("setting",), "rad", -1.5, 1.5, "of each setting that was fitted"),
    Row("rotation", ("setting",), "rad", -6.3, 6.3, "of each setting that was fitted"),
    Row("slope", ("setting",), "1", *_SLOPE, "k of each setting from its own readings"),
    Row("slope_uncertainty", ("setting",), "1", 0.0, 1.0, "its standard uncertainty from the noise"),
    Row("offset", ("setting",), "m", -0.1, 0.1, "zero of each setting's interferometer readings against the sensor's"),
    Row("slope_predicted", ("setting",), "1", *_SLOPE, "k at each setting, by a fit to all the others"),
    Row("slope_predicted_uncertainty", ("setting",), "1", 0.0, 1.0, "standard uncertainty of that prediction"),
    Row("setting_left_out", ("setting",), "", 0, 1, "1: the setting contradicts all the others and was left out"),
    Row("noise", (), "m", 0.0, 1e-3, "standard deviation of one reading about the line of its setting"),
    Row("scatter", (), "1", 0.0, 1e3, "ratio of the scatter of the settings about the surface to their noise"),
    Row("group_setting", ("group",), "", 0, 1e7, "setting of each group of readings that was fitted"),
    Row("group_depth", ("group",), "m", *_DEPTH, "its reference minus `mid_range`"),
    Row("group_residual", ("group",), "m", -0.1, 0.1, "its reading minus the line of its setting"),
    Row("group_left_out", ("group",), "", 0, 1, "1: the reading does not belong to that line and was left out"),
    Row("remaining_error", (), "1", 0.0, 1.0, "rms of `slope` minus `slope_predicted`: the cross-validated error of k"),
    Row("remaining_error_interval", ("limit",), "1", 0.0, 1.0, "95 % interval of `remaining_error`: low, high"),
)
"""The calibration dataset, one row for each variable."""

ATTRIBUTES = {
    "schema": f"`{SCHEMA}`",
    "order": "order of the polynomial that cross-validation chose",
    "mirror": "1: even in q2, the plane of triangulation is a plane of symmetry; 0: not",
    ROTATION_ZERO: f"`{AWAY}`: the direction in which the normal of a surface leans at rotation 0. A file without it, "
    "of an earlier version, is made anew: `errormotion calibrate`, with `receiver_rotation`",
    "provenance": "JSON text: settings with defaults, hash of the raw dataset, instruments, software",
}
_ALL_AROUND = 359.0
"""Width of a hole along the rotation above which it extends over all rotations, deg."""
_SIZES = {"axis": 2, "limit": 2}
_MAY_BE_UNKNOWN = ("mid_range_found", "mid_range_uncertainty")


@dataclass(frozen=True)
class Compensated:
    """Readings that are compensated for the inclination error, and the raw ones.

    Attributes
    ----------
    raw : ndarray (...)
        Uncompensated readings, m.
    value : ndarray (...)
        True depths d = (r + m k) / (1 + k), m.
    uncertainty : ndarray (...)
        Standard uncertainty of `value` due to the calibration, without the noise of the reading, m.
    jacobian : ndarray (..., term)
        Derivative of `value` with respect to the coefficients, whose covariance all readings share, m.
    """

    raw: Array
    value: Array
    uncertainty: Array
    jacobian: Array


class InclinationCalibration(Calibration):
    """The calibrated inclination error of one sensor."""

    schema, rows, what, kind, named = SCHEMA, ROWS, "calibration", "point_lds", True
    hints: ClassVar[Mapping[str, str]] = {
        "errormotion.raw.inclination/": ". These are readings: make a calibration of them with 'errormotion calibrate "
        "{} -o FILE'"
    }

    def __init__(self, dataset: xr.Dataset) -> None:
        super().__init__(dataset)
        self.name = str(dataset.attrs.get("name", "calibration"))
        self.mid_range = float(dataset["mid_range"])
        self._scale = float(dataset["tilt_scale"])

    @staticmethod
    def violations(ds: xr.Dataset) -> list[str]:
        """Return every violation of the schema, one sentence each."""
        return violations(ds)

    @classmethod
    def find(cls, name: str | Path, folder: str | Path | None = None) -> InclinationCalibration:
        """Load a calibration by path, or by name.

        Parameters
        ----------
        name : str or Path
            A path, relative to ``folder`` or else to the working folder; or a name: ``NAME.nc`` in the folder
            `calibrations` of ``folder``, in that of the working folder, or in the folder that the environment
            variable ``ERRORMOTION_CALIBRATIONS`` names. While a campaign runs, the folder of its file is searched as
            well.
        folder : str or Path, optional
            Folder of the file that names the calibration.

        Raises
        ------
        DatasetError
            Not found (the message lists the searched paths and the calibrations in them), or not a calibration.
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
        there = sorted({path.stem for home in homes if home.is_dir() for path in visible(home, "*.nc")})
        known = f" Calibrations there: {', '.join(there)}." if there else ""
        raise DatasetError(
            f"calibration '{name}': not found. Searched: {', '.join(map(str, places))}.{known} Give a path, or copy "
            f"the file to one of these folders; {VARIABLE} names one more folder",
            code="calibration.not_found",
        )

    def require_sensor(self, serial_number: str, mid_range: float, *, allow_other_sensor: bool = False) -> list[str]:
        """Return notes on the use with a sensor, as `owner.compare`.

        Parameters
        ----------
        serial_number : str
            Of the sensor that measures; empty if unknown.
        mid_range : float
            Of its readings, m.
        allow_other_sensor : bool
            State another sensor in a note instead of refusing it.

        Raises
        ------
        DatasetError
            The calibration belongs to a sensor with another serial number or another mid-range.
        """
        mid_ranges = self.mid_range, mid_range
        return owner.compare(
            self.name, self.serial_number, serial_number, mid_ranges=mid_ranges, allow_other_sensor=allow_other_sensor
        )

    @property
    def order(self) -> int:
        """Order of the polynomial that cross-validation chose; terms of higher order represent its uncertainty."""
        return int(self.dataset.attrs["order"])

    @property
    def settings(self) -> Array:
        """Tilt vectors (setting, 2) of the calibrated settings, without those that were left out."""
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
        """Return the derivative (..., term) of k at tilts (..., 2) with respect to the coefficients."""
        return terms(half_tilt(np.asarray(q, float)) / self._scale, self._degrees)

    def slope(self, q: ArrayLike) -> tuple[Array, Array]:
        """Return k at any tilts (..., 2) and its standard uncertainty; see `supported`."""
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
            The message states the steepest such tilt, their number, and the nearest calibrated settings.
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
            f"Calibration '{self.name}': {tilt_text(first)} is {where}{many}; nearest calibrated: {near}. "
            "Calibrate there, measure within the calibrated settings, or allow extrapolation (extrapolate = true in "
            "the test's settings): the uncertainty then increases with the distance.",
            code="calibration.inclination.outside",
        )

    def compensate(
        self, reading: ArrayLike, q: ArrayLike, mid_range: float | None = None, extrapolate: bool = False
    ) -> Compensated:
        """Compensate readings for the inclination error.

        Parameters
        ----------
        reading : array_like (...)
            m; NaN results in NaN.
        q : array_like (..., 2)
            Tilt vectors, broadcast against the readings; NaN results in NaN.
        mid_range : float, optional
            Reading at which the error vanishes, m; default: that of the calibration.
        extrapolate : bool
            Also compensate outside the support and the calibrated range.

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
                f"Calibration '{self.name}': a reading {1e3 * worst:.3f} mm from mid-range is beyond the calibrated "
                f"{1e3 * low:.3f} to {1e3 * high:.3f} mm ({wrong.size} of {depth.size} readings). Check the mid-range "
                "of the sensor, measure within the calibrated range, or allow extrapolation (extrapolate = true in the "
                "test's settings).",
                code="calibration.reading.outside",
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
    """Return holes as texts; holes between the same inclinations, due to symmetry, are in one text."""
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
    """Return every violation of the schema of a calibration, one sentence each."""
    messages = table_violations(ds, SCHEMA, ROWS, ATTRIBUTES, _SIZES, _MAY_BE_UNKNOWN)
    if not messages and ds.attrs[ROTATION_ZERO] != AWAY:
        messages = [f"attribute '{ROTATION_ZERO}': expected '{AWAY}'; found {ds.attrs[ROTATION_ZERO]!r}"]
    return messages or _covariance_violations(ds["coefficient_covariance"].transpose("term", "term_").values)


def _covariance_violations(C: Array) -> list[str]:
    if C.shape[0] != C.shape[1]:
        return [f"coefficient_covariance: expected a square matrix; found {C.shape[0]} x {C.shape[1]}"]
    scale = np.sqrt(np.abs(np.diag(C)))
    scale[scale == 0] = 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        correlation = C / scale[:, None] / scale
        symmetric = np.abs(correlation - correlation.T).max() <= 1e-8  # False after an overflow
    if not symmetric or np.linalg.eigvalsh(correlation).min() < -1e-8:
        return ["coefficient_covariance: expected a symmetric matrix without negative variances; found another"]
    return []


def _deviation(J: Array, C: Array) -> Array:
    """Return the standard deviation (...) of linear combinations (..., term) of the coefficients."""
    return np.asarray(np.sqrt(np.maximum(((J @ C) * J).sum(axis=-1), 0.0)))


def build(variables: Mapping[str, Any], attrs: Mapping[str, Any]) -> xr.Dataset:
    """Return a calibration dataset from the values of all variables of `ROWS`."""
    return assemble(SCHEMA, ROWS, variables, attrs)
