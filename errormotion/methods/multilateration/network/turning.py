"""The datum: the whole, moved as one so that its targets lie on the nominal ones as well as can be."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.methods.multilateration.network.kernels.compiling import compiled
from errormotion.methods.multilateration.network.model import Stations


@dataclass(frozen=True)
class Motion:
    """A point goes to R (point - a) + b: means (3,) of targets and nominal ones, and the rotation R (3, 3)."""

    a: Array
    b: Array
    R: Array

    @classmethod
    def of(cls, moments: Array, centre: Array) -> Motion:
        """Return the motion that fits targets to nominal ones best, from their moments (16,) (see `moments`).

        The rotation is that of Kabsch: from the singular vectors of the targets' cross products.
        """
        return cls(*_fitted(moments, centre))

    def stations(self, stations: Stations) -> Stations:
        """Return the stations moved."""
        return replace(stations, place=(stations.place - self.a) @ self.R.T + self.b)


def fitted(stations: Stations, target: Array, nominal: Array, used: NDArray[np.bool_]) -> tuple[Stations, Array, Array]:
    """Return stations and targets (m, 3) moved onto the nominal targets, and the rotation (3, 3).

    ``used`` (m,) are the targets that count.
    """
    place, centre = np.ascontiguousarray(target.T), nominal.mean(axis=0)
    motion = Motion.of(moments(place, nominal, used, centre), centre)
    everywhere = np.zeros(len(target))
    return motion.stations(stations), moved(place, motion.a, motion.b, motion.R, everywhere), motion.R


@compiled()
def _fitted(moments: Array, centre: Array) -> tuple[Array, Array, Array]:  # pragma: no cover - compiled
    n, a, b = moments[0], moments[1:4] / moments[0], moments[4:7] / moments[0]
    U, _, Vt = np.linalg.svd(moments[7:].copy().reshape(3, 3) - n * np.outer(b, a))
    if np.linalg.det(U @ Vt) < 0.0:
        U[:, 2] *= -1.0
    return centre + a, centre + b, U @ Vt


@compiled()
def moments(
    place: Array, nominal: Array, used: NDArray[np.bool_], centre: Array
) -> Array:  # pragma: no cover - compiled
    """Return number, sums and products (16,) of targets (3, m) and nominal ones (m, 3) that count, about ``centre``."""
    sums, u, v = np.zeros(16), np.empty(3), np.empty(3)
    for i in range(len(nominal)):
        if used[i]:
            sums[0] += 1.0
            for k in range(3):
                u[k], v[k] = place[k, i] - centre[k], nominal[i, k] - centre[k]
                sums[1 + k] += u[k]
                sums[4 + k] += v[k]
            for k in range(3):
                for h in range(3):
                    sums[7 + 3 * k + h] += v[k] * u[h]
    return sums


@compiled()
def moved(place: Array, a: Array, b: Array, R: Array, openness: Array) -> Array:  # pragma: no cover - compiled
    """Return R (u - a) + b (m, 3) of targets u (3, m); NaN where the openness (m,) is infinite."""
    target = np.empty((place.shape[1], 3))
    for i in range(len(target)):
        x, y, z = place[0, i] - a[0], place[1, i] - a[1], place[2, i] - a[2]
        for k in range(3):
            found = R[k, 0] * x + R[k, 1] * y + R[k, 2] * z + b[k]
            target[i, k] = found if openness[i] < np.inf else np.nan
    return target
