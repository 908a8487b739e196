"""The crossbeam of the gantry during the warm-up, and scans of artefacts by the line profiler in its spindle.

The carriage O20 moves along the crossbeam, Y. The tool frame O30 is offset from it by the ``lever`` (x_y, 0, z_y), the
profiler frame O40 has the ``pose`` H in O30. With the carriage at y and its error E (a displacement of its origin
and a rotation), a point (x, 0, z) of a profile has the machine coordinates

    (0, y, 0) + E (lever + H (x, 0, z)).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import ArrayLike

from errormotion.arrays import Array
from errormotion.kinematics.poses import displaced

#: Time constants of screw, beam and columns, s.
LAGS = (900.0, 2700.0, 7200.0)
#: Steady errors: for each lag a polynomial in u = y / half of the travel, lowest power first; um and urad.
_STEADY = {
    "EX": ((0.0,), (0.5, 3.0, -4.0, 1.0), (1.5, 0.5)),
    "EY": ((16.0, 18.0, 1.0), (6.0, 8.0, 0.0, 1.5), (2.0, 1.0)),
    "EZ": ((0.0,), (7.0, 3.0, -12.0, 0.8), (-9.0, 1.0)),
    "EB": ((1.0,), (5.0, 4.0, 1.5), (4.0, 1.0)),
}
#: From the carriage to the tool frame, m (Zhao et al., section 4.3).
LEVER = (-0.9, 0.0, -2.051)
#: Nominal height of the profiler in the tool frame, m.
LIFT = -0.174
#: Deviation of an artefact from its nominal position, m, and orientation, rad (one sigma).
ARTEFACT_SHIFT, ARTEFACT_ROTATION = 0.2e-3, 3e-3

_ARTEFACT = 3


@dataclass(frozen=True)
class Crossbeam:
    """One crossbeam with a profiler in its spindle.

    The carriage follows its guide: it rotates with the slope of the guide, so EA = dEZ/dy and EC = -dEX/dy. ``own``
    adds a motion of the carriage relative to its guide.

    Attributes
    ----------
    travel : (float, float)
        Lowest and highest position, m.
    steady : ndarray, (lag, 4, power)
        Steady EX, EY, EZ (m) and EB (rad) as polynomials in the position over half of the travel.
    pose : ndarray, (4, 4)
        True pose of the profiler in the tool frame, m.
    lever : ndarray, (3,)
        From the carriage to the tool frame, m.
    own : ndarray, (6,)
        Steady error of the carriage in addition to that of the guide, m and rad, with the time constant of the screw.
    """

    travel: tuple[float, float]
    steady: Array
    pose: Array
    lever: Array = field(default_factory=lambda: np.array(LEVER))
    own: Array = field(default_factory=lambda: np.zeros(6))

    def twist(self, t: ArrayLike, y: ArrayLike) -> Array:
        """Return the thermal error of the carriage at its origin, (..., 6), m and rad, at times t (s) and y (m).

        Times and positions broadcast. Before time 0 the machine is cold.
        """
        t, y = np.broadcast_arrays(np.asarray(t, dtype=float), np.asarray(y, dtype=float))
        half = (self.travel[1] - self.travel[0]) / 2
        u = (y - sum(self.travel) / 2) / half
        grown = -np.expm1(-np.maximum(t, 0.0)[..., None] / np.array(LAGS))  # of each lag
        powers = u[..., None] ** np.arange(self.steady.shape[2])
        slopes = polynomial.polyder(np.eye(self.steady.shape[2])).T / half  # of each power: coefficients of d/dy
        EX, EY, EZ, EB = np.moveaxis(np.einsum("...l,ldk,...k->...d", grown, self.steady, powers), -1, 0)
        steep = np.einsum("...l,ldk,kj,...j->...d", grown, self.steady, slopes, powers[..., :-1])
        twist = np.stack([EX, EY, EZ, steep[..., 2], EB, -steep[..., 0]], axis=-1)
        return np.asarray(twist + grown[..., :1] * self.own)

    def carriage(self, t: float, y: Array, middle: float, motion: str) -> Array:
        """Return the poses (n, 4, 4) of the carriage in the machine at commanded positions y (n,), m."""
        nominal = np.tile(np.eye(4), (y.size, 1, 1))
        nominal[:, 1, 3] = y
        if motion == "axis":
            return nominal @ displaced(self.twist(t, y)).as_matrix()
        nominal[:, 1, 3] -= middle
        at_middle = np.eye(4)
        at_middle[1, 3] = middle
        return at_middle @ displaced(self.twist(t, middle)).as_matrix() @ nominal

    def carriage_at(self, t: Array, positions: Array) -> Array:
        """Return the poses of the carriage at times t (n,) since the start of the warm-up, s, and positions (n, 3), m.

        Returns
        -------
        ndarray, (n, 4, 4)
            In the machine, m. Z moves the spindle in the carriage, not the carriage.
        """
        nominal = np.tile(np.eye(4), (len(positions), 1, 1))
        nominal[:, :2, 3] = positions[:, :2]
        return np.asarray(nominal @ displaced(self.twist(t, positions[:, 1])).as_matrix())

    def artefact_pose(self, seed: int, position: float) -> Array:
        """Return the pose of the artefact at a position, (4, 4) in the machine, m: below the profiler, misaligned."""
        bits = int(np.float64(position).view(np.int64))
        rng = np.random.default_rng([abs(seed), int(seed < 0), _ARTEFACT, bits & 0x7FFFFFFFFFFFFFFF, int(bits < 0)])
        off = rng.normal(0, [ARTEFACT_SHIFT] * 3 + [ARTEFACT_ROTATION] * 3)
        off[:3] += [0.0, position, 0.0] + self.lever + self.pose[:3, 3]
        return np.asarray(displaced(off).as_matrix())

    def pocket_pose(self, position: float) -> Array:
        """Return the pose of a pocket that the cold machine has cut at a position of the axis, (4, 4), m.

        Its middle is the origin of the tool frame during the cut.
        """
        pose = np.eye(4)
        pose[:3, 3] = self.lever + np.array([0.0, position, 0.0])
        return pose

    def pocket_lines(self, along: ArrayLike, lift: float) -> Array:
        """Return the poses (n, 4, 4) of the profiler relative to a pocket that the cold machine has cut itself.

        Parameters
        ----------
        along : (n,)
            Y of the tool frame relative to the cut, m.
        lift : float
            Z of the tool frame relative to the cut, m.
        """
        poses = np.tile(self.pose, (np.size(along), 1, 1))
        poses[:, 1, 3] += np.asarray(along, dtype=float)
        poses[:, 2, 3] += lift
        return poses

    def lines(self, carriage: Array, artefact: Array, *, lift: ArrayLike = 0.0) -> Array:
        """Return the poses (n, 4, 4) of the profiler relative to an artefact, from those of the carriage.

        ``lift`` is the position of the spindle along Z, m, one for all lines or one for each.
        """
        to_profiler = np.tile(self.pose, (len(carriage), 1, 1))
        to_profiler[:, :3, 3] += self.lever
        to_profiler[:, 2, 3] += np.asarray(lift, dtype=float)
        return np.asarray(np.linalg.inv(artefact) @ carriage @ to_profiler)


def seeded_crossbeam(rng: np.random.Generator, travel: tuple[float, float]) -> Crossbeam:
    """Return the crossbeam of one machine: the tables varied by up to 15 percent, and a misaligned profiler."""
    steady = np.zeros((len(LAGS), len(_STEADY), 4))
    for k, terms in enumerate(_STEADY.values()):
        for lag, coefficients in enumerate(terms):
            steady[lag, k, : len(coefficients)] = np.array(coefficients) * 1e-6
    steady *= rng.uniform(0.85, 1.15, (len(LAGS), len(_STEADY), 1))
    set_up = rng.normal(0, [2e-3, 2e-3, 2e-3, 3e-3, 3e-3, 6e-3])
    set_up[2] += LIFT
    return Crossbeam(travel, steady, np.asarray(displaced(set_up).as_matrix()))
