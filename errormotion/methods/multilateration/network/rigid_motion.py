"""Datum: the rigid motion of the network that is the best fit of its targets to the nominal ones."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.methods.multilateration.network import target_sums
from errormotion.methods.multilateration.network.model import Stations


@dataclass(frozen=True)
class Motion:
    """Rigid motion R (point - a) + b, with the means (3,) of targets and nominal ones and the rotation R (3, 3)."""

    a: Array
    b: Array
    R: Array

    @classmethod
    def of(cls, moments: Array, centre: Array) -> Motion:
        """Return the best fit of targets to nominal ones, from their moments (16,) (see `target_sums.moments`).

        The rotation is that of Kabsch, from the singular vectors of the cross products.
        """
        n, a, b = moments[0], moments[1:4] / moments[0], moments[4:7] / moments[0]
        U, _, Vt = np.linalg.svd(moments[7:].reshape(3, 3) - n * np.outer(b, a))
        if np.linalg.det(U @ Vt) < 0.0:
            U[:, 2] *= -1.0
        return cls(centre + a, centre + b, U @ Vt)

    def stations(self, stations: Stations) -> Stations:
        """Return the stations moved."""
        return replace(stations, position=(stations.position - self.a) @ self.R.T + self.b)


def fitted(stations: Stations, target: Array, nominal: Array, used: NDArray[np.bool_]) -> tuple[Stations, Array, Array]:
    """Return stations and targets (m, 3) fitted to the nominal targets, and the rotation (3, 3).

    Only the targets ``used`` (m,) determine the fit.
    """
    position, centre = np.ascontiguousarray(target.T), nominal.mean(axis=0)
    motion = Motion.of(target_sums.moments(position, nominal, used, centre), centre)
    everywhere = np.zeros(len(target))
    return motion.stations(stations), target_sums.moved(position, motion.a, motion.b, motion.R, everywhere), motion.R
