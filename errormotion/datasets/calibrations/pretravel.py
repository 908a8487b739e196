"""Pre-travel maps of touch probes: displacement of the machine between touching and tripping, by direction.

When the probe trips, the centre of its tip has moved by the pre-travel s(n) towards the surface since the contact;
n is the outward normal of the surface. The map is a sum of real spherical harmonics of n (the axis of the stylus is z):
three lobes around the stylus, as the three contacts of a probe's seat make them, are one term of degree 3.

There are no terms of degree 1: on one ball they cannot be separated from the position of the ball. They displace every
measured centre in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.datasets.calibrations import owner
from errormotion.datasets.checks import dims, magnitude_violations, storable_violations
from errormotion.datasets.schemas import Row
from errormotion.datasets.storage.disk import load as load_dataset
from errormotion.datasets.storage.disk import reading, save
from errormotion.errors import DatasetError

SCHEMA = "errormotion.calibration.pretravel/1"
"""Schema of the map as a dataset."""
HIGHEST = 8
"""Highest degree of a term."""

_MM = (-1e-3, 1e-3)  # m; pre-travels are of the order of 10 um
_FREE = (-math.inf, math.inf)

ROWS = (
    Row("coefficient", ("term",), "m", *_MM, "of each spherical harmonic, whose mean square is 1"),
    Row("coefficient_covariance", ("term", "term_"), "m^2", *_FREE, "of the coefficients, all sources"),
    Row("degree", ("term",), "", 0, HIGHEST, "degree l of each term; 1 is missing"),
    Row("order", ("term",), "", -HIGHEST, HIGHEST, "order m of each term; negative: the sine"),
    Row("normal", ("touch", "direction"), "1", -1.0, 1.0, "outward normals of the calibrating touches"),
    Row("residual", ("touch",), "m", *_MM, "of each touch"),
    Row("left_out", ("touch",), "", 0, 1, "1: the touch contradicts the others and was left out"),
    Row("reach", (), "rad", 0.0, math.pi, "how far from the nearest touch a direction may lie"),
    Row("noise", (), "m", 0.0, 1e-3, "standard deviation of one touch about the map"),
    Row("cross_validated", ("highest",), "m", 0.0, 1e-3, "rms error at touches left out, by the highest degree"),
    Row("highest", ("highest",), "", 0, HIGHEST, "the highest degrees that were tried"),
    Row("ball_radius", (), "m", 1e-4, 1.0, "radius of the calibrated ball"),
    Row("tip_radius", (), "m", 1e-5, 0.1, "radius of the tip"),
)
"""The map, one row a variable."""

ATTRIBUTES = {
    "schema": f"`{SCHEMA}`",
    "provenance": "JSON text: settings with defaults, hash of the touches, software",
}


class PretravelMap:
    """The calibrated pre-travel of one probe.

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
            raise DatasetError(f"The pre-travel map breaks its schema ({SCHEMA}):", found)
        self.dataset = dataset.load()
        self.coefficients = self._values("coefficient")
        self.coefficient_covariance = self._values("coefficient_covariance")
        self.reach = float(dataset["reach"])
        self._degrees = self._values("degree").astype(int)
        self._orders = self._values("order").astype(int)

    def _values(self, name: str) -> Array:
        row = next(row for row in ROWS if row.name == name)
        return np.asarray(self.dataset[name].transpose(*row.dims).values, dtype=float)

    @classmethod
    def load(cls, path: str | Path) -> PretravelMap:
        """Read a map.

        Raises
        ------
        DatasetError
            Nothing there, damaged, or no map of this schema.
        """
        with reading(path), load_dataset(path) as dataset:
            schema = dataset.attrs.get("schema", "none")
            if schema != SCHEMA:
                raise DatasetError(f"{path}: expected a pre-travel map ({SCHEMA}); found schema {schema}")
            try:
                return cls(dataset.load())
            except DatasetError as error:
                raise DatasetError(f"{path}: the map breaks its schema ({SCHEMA}):", error.violations) from error

    @property
    def serial_number(self) -> str:
        """Serial number of the calibrated probe; empty where the file does not state it."""
        return owner.serial_number(self.dataset.attrs, "touch_probe")

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the map to a NetCDF file, whole or not at all."""
        return save(self.dataset, path, overwrite=overwrite)

    def jacobian(self, normals: ArrayLike) -> Array:
        """Return the derivative (n, term) of the pre-travel by the coefficients."""
        return harmonics(normals, self._degrees, self._orders)

    def length(self, normals: ArrayLike) -> tuple[Array, Array]:
        """Return the pre-travel and its standard uncertainty.

        Parameters
        ----------
        normals : (n, 3)
            Outward normals of the surface that is touched, of any length; the probe moves against them.

        Returns
        -------
        value, uncertainty : ndarray, (n,)
            m. They are without meaning where `supported` is false.
        """
        J = self.jacobian(normals)
        variance = np.einsum("ni,ij,nj->n", J, self.coefficient_covariance, J)
        return np.asarray(J @ self.coefficients), np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def supported(self, normals: ArrayLike) -> NDArray[np.bool_]:
        """Return whether calibrating touches lie near enough to each normal (n, 3)."""
        used = self._values("left_out") == 0
        cosine = (unit(normals) @ self._values("normal")[used].T).max(axis=1)
        return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)) <= self.reach)

    def met(self, position: ArrayLike, normals: ArrayLike) -> Array:
        """Return where the tip was when it met the surface, from where it was when the probe tripped (n, 3), m."""
        value, _ = self.length(normals)
        return np.asarray(np.asarray(position, dtype=float) + value[:, None] * unit(normals))


def unit(vectors: ArrayLike) -> Array:
    """Return vectors (n, 3) at length 1."""
    v = np.atleast_2d(np.asarray(vectors, dtype=float))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def terms_up_to(highest: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return degrees and orders (term,) of all terms up to a degree, without degree 1."""
    pairs = [(degree, order) for degree in range(highest + 1) if degree != 1 for order in range(-degree, degree + 1)]
    degrees, orders = np.array(pairs).T
    return degrees, orders


def harmonics(normals: ArrayLike, degrees: NDArray[np.int64], orders: NDArray[np.int64]) -> Array:
    """Return real spherical harmonics (n, term) of directions (n, 3), their mean square over the sphere being 1."""
    from scipy.special import sph_harm_y

    n = unit(normals)
    theta, phi = np.arccos(np.clip(n[:, 2], -1.0, 1.0))[:, None], np.arctan2(n[:, 1], n[:, 0])[:, None]
    complex_ones = sph_harm_y(degrees, np.abs(orders), theta, phi) * math.sqrt(4 * math.pi)
    double = np.where(orders == 0, 1.0, math.sqrt(2.0))
    return np.asarray(np.where(orders < 0, complex_ones.imag, complex_ones.real) * double)


def assemble(variables: Mapping[str, ArrayLike], attrs: Mapping[str, Any]) -> xr.Dataset:
    """Return the dataset of a map from the values of all variables of `ROWS`."""
    data = {}
    for row in ROWS:
        units = {"units": row.unit} if row.unit else {}
        data[row.name] = (row.dims, np.asarray(variables[row.name]), {**units, "long_name": row.meaning})
    return xr.Dataset(data, attrs={**attrs, "schema": SCHEMA})


def violations(ds: xr.Dataset) -> list[str]:
    """Return everything in which a dataset breaks the schema of maps, one sentence each."""
    found = storable_violations(ds)
    if ds.attrs.get("schema") != SCHEMA:
        found.append(f"attribute 'schema': expected '{SCHEMA}'; found {ds.attrs.get('schema')!r}")
    found += [
        f"attribute '{name}': missing; expected {what}" for name, what in ATTRIBUTES.items() if name not in ds.attrs
    ]
    for row in ROWS:
        found += _row_violations(ds, row)
    if not found and ds.sizes["direction"] != 3:
        found.append(f"dimension direction: expected 3; found {ds.sizes['direction']}")
    return found or _value_violations(ds)


def _row_violations(ds: xr.Dataset, row: Row) -> list[str]:
    if row.name not in ds.variables:
        return [f"{row.name}({', '.join(row.dims)}): missing; expected {row.meaning}"]
    variable = ds.variables[row.name]
    if set(variable.dims) != set(row.dims):
        return [f"{row.name}: expected dims ({', '.join(row.dims)}); found {dims(variable)}"]
    if variable.size == 0:
        return [f"{row.name}: expected values; found none (a dimension has length 0)"]
    complaints = magnitude_violations(row.name, variable, row)
    if not complaints and np.isnan(variable.values.astype(float)).any():
        complaints = [f"{row.name}: expected numbers; found NaN"]
    return complaints


def _value_violations(ds: xr.Dataset) -> list[str]:
    degrees, orders = ds["degree"].values, ds["order"].values
    found = []
    if (np.abs(orders) > degrees).any():
        found.append("order: expected -degree to degree; found another one")
    if (degrees == 1).any():
        found.append("degree: expected no term of degree 1 (not separable from the position of the ball); found one")
    C = ds["coefficient_covariance"].transpose("term", "term_").values
    if C.shape[0] != C.shape[1] or not np.allclose(C, C.T, rtol=1e-8, atol=0.0):
        found.append("coefficient_covariance: expected a symmetric matrix; found another")
    elif np.linalg.eigvalsh(C).min() < -1e-9 * max(float(np.abs(C).max()), 1e-30):
        found.append("coefficient_covariance: expected no negative variance; found one")
    return found
