"""Effects of laser triangulation on a reading: tilt and speckle of the surface.

The receiving lens has an aperture. A tilted surface scatters light into it unevenly, so that the centre of gravity of
the light in the aperture shifts, and with it the apparent angle of the received beam. Out of focus this shifts the
image, in proportion to the depth from mid-range.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.twin import kernels

#: Rings of points in the aperture: radius as a share of that of the aperture, number of points, weight of each.
_RINGS = ((0.0, 1, 1.0), (0.55, 6, 1.2), (0.9, 12, 1.0))
#: Smallest cosine between surface normal and received beam with light at the receiver.
_MIN_COSINE = 0.02
#: Number of waves of a speckle field.
_WAVES = 256


@dataclass(frozen=True)
class Optics:
    """The receiving side of a sensor, and the scattering of the surface.

    Attributes
    ----------
    triangulation_angle : float
        Between emitted and received beam, rad. The receiver is in the direction -e1 from the emitted beam (see
        `errormotion.kinematics.beams`): a surface at a rotation of 180 deg is inclined towards it.
    aperture : float
        Half angle of the receiving lens seen from the spot, rad.
    roughness : float
        Slope of the facets of the surface, root mean square, 1.
    glossy : float
        Share of the light that these facets reflect; the rest is scattered evenly (Lambert).
    defocus : float
        Relative error of the reading per radian of shift of the light's centre in the aperture, 1.
    scale : float
        Relative error of the reading on a surface perpendicular to the beam, 1.
    steepest : float
        Largest inclination with light at the receiver, rad.
    """

    triangulation_angle: float = np.radians(28.0)
    aperture: float = np.radians(9.0)
    roughness: float = 0.55
    glossy: float = 0.35
    defocus: float = 0.36
    scale: float = 0.0
    steepest: float = np.radians(75.0)

    def slope(self, q: ArrayLike) -> Array:
        """Return the error of the reading per depth from mid-range, 1.

        Parameters
        ----------
        q : (..., 2)
            Tilt vector, see `errormotion.kinematics.beams.tilt`.

        Returns
        -------
        ndarray, (...)
            NaN without light at the receiver.
        """
        tilts = np.asarray(q, dtype=float)
        steep = np.hypot(tilts[..., 0], tilts[..., 1])
        with np.errstate(invalid="ignore"):
            seen = (steep <= np.tan(self.steepest)) & (self._receiver_cosine(tilts, steep) > _MIN_COSINE)
        shift = self._light_centre(np.where(seen[..., None], tilts, 0.0)) - self._light_centre(np.zeros(2))
        return np.where(seen, self.scale + self.defocus * shift, np.nan)

    def _receiver_cosine(self, q: Array, steep: Array) -> Array:
        sine, cosine = np.sin(self.triangulation_angle), np.cos(self.triangulation_angle)
        return np.asarray((cosine - sine * q[..., 0]) / np.hypot(1.0, steep))

    def _light_centre(self, q: Array) -> Array:
        """Return the position of the light's centre in the aperture, towards the emitted beam, rad.

        Vectors have the components in the triangulation plane, perpendicular to it, and towards the sensor.
        """
        sine, cosine = np.sin(self.triangulation_angle), np.cos(self.triangulation_angle)
        along, across, weight = _aperture(self.aperture)
        received = np.array([-sine, 0.0, cosine]) + along[:, None] * np.array([cosine, 0.0, sine])
        received = _unit(received + across[:, None] * np.array([0.0, 1.0, 0.0]))
        halfway = _unit(received + np.array([0.0, 0.0, 1.0]))
        normal = _unit(np.concatenate([q, np.ones((*q.shape[:-1], 1))], axis=-1))
        square = (normal @ halfway.T) ** 2  # of the cosine between the normal and that of a facet which reflects
        facets = np.exp(-(1 / square - 1) / self.roughness**2) / square**2
        light = weight * ((1 - self.glossy) * np.maximum(normal @ received.T, 0.0) + self.glossy * facets)
        return np.asarray((light @ along) / light.sum(axis=-1))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


@lru_cache(maxsize=32)
def _aperture(half_angle: float) -> tuple[Array, Array, Array]:
    """Return points in the aperture, in and perpendicular to the triangulation plane, rad, and their weights, (n,)."""
    radius = np.concatenate([np.full(n, share) for share, n, _ in _RINGS]) * half_angle
    angle = np.concatenate([2 * np.pi * np.arange(n) / n for _, n, _ in _RINGS])
    weight = np.concatenate([np.full(n, each) for _, n, each in _RINGS])
    return radius * np.cos(angle), radius * np.sin(angle), weight


def speckle(key: int, positions: Array, length: float) -> Array:
    """Return a random field of variance 1 with the correlation exp(-distance / length).

    The field is a sum of plane waves. For an isotropic field with exponential correlation, the wave vectors have a
    Cauchy distribution of width 1 / length: that of a normal vector divided by the absolute value of a normal number.

    Parameters
    ----------
    key : int
        Key of the field.
    positions : ndarray, (n, 3)
        m. The value at a position does not depend on the other positions.
    length : float
        m.

    Returns
    -------
    ndarray, (n,)
    """
    waves, phases = _waves(key)
    return np.asarray(np.sqrt(2 / _WAVES) * np.cos(positions @ (waves / length) + phases).sum(axis=1))


@lru_cache(maxsize=64)
def _waves(key: int) -> tuple[Array, Array]:
    rng = np.random.default_rng([key])
    waves = rng.normal(size=(3, _WAVES)) / np.abs(rng.normal(size=_WAVES))
    return waves, rng.uniform(0, 2 * np.pi, _WAVES)


def key_of(*labels: int) -> int:
    """Return the key of a speckle field from integer labels."""
    return int(kernels.stream_key(*labels))
