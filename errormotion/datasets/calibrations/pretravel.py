"""Pre-travel maps of touch probes: displacement of the machine between contact and trip, by direction.

When the probe trips, the centre of its tip has moved by the pre-travel s(n) towards the surface since the contact;
n is the outward normal of the surface. The map is a sum of real spherical harmonics of n (the axis of the stylus is z):
three lobes around the stylus, due to the three contacts of the seat of a probe, are one term of degree 3.

There are no terms of degree 1: on one ball they cannot be separated from the position of the ball. They displace every
measured centre in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.datasets.calibrations.dataset import Calibration, table_violations
from errormotion.datasets.calibrations.dataset import assemble as assemble_dataset
from errormotion.datasets.schemas import Row

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
    Row("reach", (), "rad", 0.0, math.pi, "largest angle of a direction to the nearest touch"),
    Row("noise", (), "m", 0.0, 1e-3, "standard deviation of one touch about the map"),
    Row("cross_validated", ("highest",), "m", 0.0, 1e-3, "rms error at touches left out, by the highest degree"),
    Row("highest", ("highest",), "", 0, HIGHEST, "the highest degrees that were tested"),
    Row("ball_radius", (), "m", 1e-4, 1.0, "radius of the calibrated ball"),
    Row("tip_radius", (), "m", 1e-5, 0.1, "radius of the tip"),
)
"""The map, one row for each variable."""

ATTRIBUTES = {
    "schema": f"`{SCHEMA}`",
    "provenance": "JSON text: settings with defaults, hash of the touches, software",
}


class PretravelMap(Calibration):
    """The calibrated pre-travel of one probe."""

    schema, rows, what, kind = SCHEMA, ROWS, "pre-travel map", "touch_probe"

    def __init__(self, dataset: xr.Dataset) -> None:
        super().__init__(dataset)
        self.reach = float(dataset["reach"])
        self._orders = self._values("order").astype(int)

    @staticmethod
    def violations(ds: xr.Dataset) -> list[str]:
        """Return every violation of the schema, one sentence each."""
        return violations(ds)

    def jacobian(self, normals: ArrayLike) -> Array:
        """Return the derivative (n, term) of the pre-travel with respect to the coefficients."""
        return harmonics(normals, self._degrees, self._orders)

    def length(self, normals: ArrayLike) -> tuple[Array, Array]:
        """Return the pre-travel and its standard uncertainty.

        Parameters
        ----------
        normals : (n, 3)
            Outward normals of the touched surface, of any length; the probe moves in the opposite direction.

        Returns
        -------
        value, uncertainty : ndarray, (n,)
            m; not valid where `supported` is false.
        """
        J = self.jacobian(normals)
        variance = np.einsum("ni,ij,nj->n", J, self.coefficient_covariance, J)
        return np.asarray(J @ self.coefficients), np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    def supported(self, normals: ArrayLike) -> NDArray[np.bool_]:
        """Return whether there is a calibrating touch close to each normal (n, 3)."""
        used = self._values("left_out") == 0
        cosine = (unit(normals) @ self._values("normal")[used].T).max(axis=1)
        return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)) <= self.reach)

    def met(self, position: ArrayLike, normals: ArrayLike) -> Array:
        """Return positions (n, 3) of the tip at the contact, from its positions at the trip, m."""
        value, _ = self.length(normals)
        return np.asarray(np.asarray(position, dtype=float) + value[:, None] * unit(normals))


def unit(vectors: ArrayLike) -> Array:
    """Return vectors (n, 3), normalised to length 1."""
    v = np.atleast_2d(np.asarray(vectors, dtype=float))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def terms_up_to(highest: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return degrees and orders (term,) of all terms up to a degree, without degree 1."""
    pairs = [(degree, order) for degree in range(highest + 1) if degree != 1 for order in range(-degree, degree + 1)]
    degrees, orders = np.array(pairs).T
    return degrees, orders


def harmonics(normals: ArrayLike, degrees: NDArray[np.int64], orders: NDArray[np.int64]) -> Array:
    """Return real spherical harmonics (n, term) of directions (n, 3), whose mean square over the sphere is 1."""
    from scipy.special import sph_harm_y

    n = unit(normals)
    theta, phi = np.arccos(np.clip(n[:, 2], -1.0, 1.0))[:, None], np.arctan2(n[:, 1], n[:, 0])[:, None]
    complex_ones = sph_harm_y(degrees, np.abs(orders), theta, phi) * math.sqrt(4 * math.pi)
    double = np.where(orders == 0, 1.0, math.sqrt(2.0))
    return np.asarray(np.where(orders < 0, complex_ones.imag, complex_ones.real) * double)


def assemble(variables: Mapping[str, ArrayLike], attrs: Mapping[str, Any]) -> xr.Dataset:
    """Return the dataset of a map from the values of all variables of `ROWS`."""
    return assemble_dataset(SCHEMA, ROWS, variables, attrs)


def violations(ds: xr.Dataset) -> list[str]:
    """Return every violation of the schema of a map, one sentence each."""
    messages = table_violations(ds, SCHEMA, ROWS, ATTRIBUTES)
    if not messages and ds.sizes["direction"] != 3:
        messages.append(f"dimension direction: expected 3; found {ds.sizes['direction']}")
    return messages or _value_violations(ds)


def _value_violations(ds: xr.Dataset) -> list[str]:
    degrees, orders = ds["degree"].values, ds["order"].values
    messages = []
    if (np.abs(orders) > degrees).any():
        messages.append("order: expected -degree to degree; found another one")
    if (degrees == 1).any():
        messages.append("degree: expected no term of degree 1 (not separable from the position of the ball); found one")
    C = ds["coefficient_covariance"].transpose("term", "term_").values
    if C.shape[0] != C.shape[1] or not np.allclose(C, C.T, rtol=1e-8, atol=0.0):
        messages.append("coefficient_covariance: expected a symmetric matrix; found another")
    elif np.linalg.eigvalsh(C).min() < -1e-9 * max(float(np.abs(C).max()), 1e-30):
        messages.append("coefficient_covariance: expected no negative variance; found one")
    return messages
