"""Balls on the table of the virtual machine, and the touch probe that measures them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.errors import BenchError

#: Nominal radius of a ball, largest deviation of the true one, and roundness from peak to valley, m.
RADIUS, RADIUS_ERROR, FORM = 12.5e-3, 3e-6, 0.5e-6
#: Deviation of a ball's position from its nominal one, m (one sigma, each coordinate; at most three sigma).
POSITION_DEVIATION = 0.1e-3
#: Positions of the balls as a share of the travel: X and Y from the middle, Z from the lowest position.
POSITIONS = (
    *((-0.8, -0.8, 0.12), (0.8, -0.75, 0.50), (0.75, 0.8, 0.20), (-0.8, 0.75, 0.62)),
    *((0.0, 0.0, 0.35), (0.1, -0.8, 0.15), (-0.1, 0.8, 0.45), (0.4, 0.1, 0.55)),
)

#: Nominal radius of the probe's tip, largest deviation of the true one, and scatter of a trigger, m.
TIP_RADIUS, TIP_ERROR, NOISE = 3e-3, 1e-6, 0.25e-6
#: Mean of the pre-travel, and amplitude of its three lobes, m.
PRETRAVEL, LOBING = 8e-6, 1.5e-6


@dataclass(frozen=True, eq=False)
class Balls:
    """Balls on posts.

    Attributes
    ----------
    nominal : ndarray, (ball, 3)
        Nominal centres, m, in commanded positions of the tip.
    centre : ndarray, (ball, 3)
        True centres, m.
    nominal_radius : float
        m.
    radius : ndarray, (ball,)
        Mean radius of each ball, m.
    form : ndarray, (ball, 3, 3)
        The surface is ``n @ form @ n`` above the mean radius in the direction n, m.
    """

    nominal: Array
    centre: Array
    nominal_radius: float
    radius: Array
    form: Array

    def __len__(self) -> int:
        return len(self.centre)

    @property
    def names(self) -> list[str]:
        """B1, B2 ..."""
        return [f"B{i + 1}" for i in range(len(self))]

    def first(self, count: int) -> Balls:
        """Return the first ``count`` balls."""
        if not 1 <= count <= len(self):
            raise BenchError(f"expected 1 to {len(self)} balls; found {count}", code="virtual.balls.count")
        part = slice(count)
        return replace(
            self, nominal=self.nominal[part], centre=self.centre[part], radius=self.radius[part], form=self.form[part]
        )

    def moved(self, ball: int, shift: ArrayLike) -> Balls:
        """Return the balls with one of them (counted from 0) displaced by ``shift`` (3,), m."""
        if not 0 <= ball < len(self):
            raise BenchError(
                f"expected the number of a ball, 0 to {len(self) - 1}; found {ball}", code="virtual.ball.number"
            )
        centre = self.centre.copy()
        centre[ball] += np.asarray(shift, dtype=float)
        return replace(self, centre=centre)

    def height(self, ball: NDArray[np.intp], direction: Array) -> Array:
        """Return the distance of the surfaces of balls (n,) from their centres in unit directions (n, 3), m."""
        form = np.einsum("ni,nij,nj->n", direction, self.form[ball], direction)
        return np.asarray(self.radius[ball] + form)


@dataclass(frozen=True)
class Probe:
    """A touch-trigger probe.

    After the contact the machine moves by the pre-travel before the probe trips. The pre-travel is larger in the
    directions of the three contacts of the probe's seat. It is positive: measured spheres appear smaller by its mean.

    Attributes
    ----------
    nominal_tip_radius, tip_radius : float
        Nominal and true, m.
    noise : float
        Scatter of one trigger along the normal (one sigma), m.
    mean, lobing : float
        Of the pre-travel, m.
    phase : float
        Azimuth of a lobe, rad.
    """

    nominal_tip_radius: float
    tip_radius: float
    noise: float
    mean: float
    lobing: float
    phase: float

    def pretravel(self, normal: ArrayLike) -> Array:
        """Return the pre-travel for outward unit normals (n, 3) of the touched surface, m, shape (n,).

        ``mean + lobing sin(theta)^3 cos(3 (azimuth - phase))``, with theta from the axis of the spindle: no lobes along
        the stylus.
        """
        n = np.atleast_2d(np.asarray(normal, dtype=float))
        lobes = ((n[:, 0] + 1j * n[:, 1]) * np.exp(-1j * self.phase)) ** 3
        return np.asarray(self.mean + self.lobing * lobes.real)


def seeded_balls(rng: np.random.Generator, travel: Mapping[str, tuple[float, float]]) -> Balls:
    """Return all balls, distributed over the travel at different heights."""
    low, high = np.array([travel.get(axis, (0.0, 0.0)) for axis in "XYZ"]).T
    share = np.array(POSITIONS)
    share[:, :2] = (1 + share[:, :2]) / 2
    nominal = low + share * (high - low)
    count = len(nominal)
    off = np.clip(rng.normal(0, POSITION_DEVIATION, (count, 3)), -3 * POSITION_DEVIATION, 3 * POSITION_DEVIATION)
    radius = RADIUS + rng.uniform(-RADIUS_ERROR, RADIUS_ERROR, count)
    form = rng.normal(size=(count, 3, 3))
    form += form.transpose(0, 2, 1)
    form -= np.trace(form, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    form *= FORM / np.ptp(np.linalg.eigvalsh(form), axis=1)[:, None, None]
    return Balls(nominal, nominal + off, RADIUS, radius, form)


def seeded_probe(rng: np.random.Generator) -> Probe:
    """Return a probe with the deviations of a good one."""
    mean, lobing = PRETRAVEL * rng.uniform(0.9, 1.1), LOBING * rng.uniform(0.9, 1.1)
    tip = TIP_RADIUS + rng.uniform(-TIP_ERROR, TIP_ERROR)
    return Probe(TIP_RADIUS, tip, NOISE, mean, lobing, rng.uniform(0, 2 * np.pi / 3))
