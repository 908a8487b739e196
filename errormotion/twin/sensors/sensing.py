"""Readings of the five sensors on the bar and on the sphere, sample by sample."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.twin import kernels
from errormotion.twin.artefacts.bar import Bar
from errormotion.twin.schedule import StepProgram
from errormotion.twin.sensors.frame import FrameGeometry
from errormotion.twin.thermal.state import ThermalState

Channels = NDArray[np.int64]

#: Interval of the slow motion, s, and number of intervals in a chunk.
GRID = 0.5
CHUNK = 64
#: Repeatability of a position of the machine, m (one sigma, each axis).
REPEATABILITY = 0.3e-6
#: Effect of the speckle on a reading on the sphere at rest, m (one sigma).
SPECKLE = 0.5e-6

_BAR_NOISE, _SPHERE_NOISE, _STEPS = 1, 2, 3


@dataclass(frozen=True)
class _Piece:
    """The slow motion over an interval in which it is nearly linear, as the input of the kernel."""

    times: Array
    slow: Array
    revolutions: Array
    pattern: Array


@dataclass(frozen=True)
class Sensing:
    """Five sensors on one machine under one schedule.

    Attributes
    ----------
    seed : int
        Seed of the noise.
    frame, bar, sphere_radius, state
        The sensors, their targets, and the motion.
    sensors_on_for : float
        Time since the sensors were switched on, at time 0, s.
    """

    seed: int
    frame: FrameGeometry
    bar: Bar
    sphere_radius: float
    state: ThermalState
    sensors_on_for: float
    _chunks: dict[int, tuple[_Piece, ...]] = field(default_factory=dict, init=False, repr=False, compare=False)

    def axis(self, t: Array) -> tuple[Array, Array]:
        """Return the point of the axis of rotation at the end of the bar, m, and its direction, each (n, 3)."""
        twist = self.state.twist(t)
        axis = self.bar.axis + np.cross(twist[:, 3:], self.bar.axis)
        return self.bar.point + twist[:, :3], axis / np.linalg.norm(axis, axis=1, keepdims=True)

    def still(self, t: Array, *, expansion: bool = True, warm_up: bool = True) -> Array:
        """Return the readings without noise, runout and texture, m, shape (channel, n)."""
        origin = self.frame.origins(self.state.warming("frame", t) if expansion else np.zeros(t.size))
        readings = self.bar.still_readings(origin, self.frame.true_direction, *self.axis(t))
        return readings + self.frame.warm_up_offset(t + self.sensors_on_for) if warm_up else readings

    def read_bar(self, out: Array, first: int, rate: float, chosen: Channels) -> None:
        """Fill ``out`` (chosen, n) with the samples first .. first + n - 1 on the rotating bar."""
        keys = np.array([kernels.stream_key(self.seed, _BAR_NOISE, channel) for channel in chosen])
        span = GRID * CHUNK
        for chunk in range(int(first / rate / span), int((first + out.shape[1]) / rate / span) + 1):
            for piece in self._pieces(chunk):
                kernels.rotating_bar(
                    out,
                    first,
                    rate,
                    piece.times,
                    piece.slow[chosen],
                    piece.revolutions,
                    piece.pattern[chosen],
                    self.frame.noise[chosen],
                    keys,
                    self.frame.range,
                )

    def _pieces(self, chunk: int) -> tuple[_Piece, ...]:
        """Return the slow motion in one chunk of time, divided where its slope changes; independent of the request."""
        pieces = self._chunks.get(chunk)
        if pieces is None:
            grid = (chunk * CHUNK + np.arange(CHUNK + 1)) * GRID
            cuts = self.state.schedule.cuts
            cuts = np.concatenate([grid[:1], cuts[(cuts > grid[0]) & (cuts < grid[-1])], grid[-1:]])
            pieces = tuple(self._piece(np.union1d(grid[(grid > a) & (grid < b)], [a, b])) for a, b in pairwise(cuts))
            if len(self._chunks) >= 64:
                self._chunks.clear()
            self._chunks[chunk] = pieces
        return pieces

    def _piece(self, times: Array) -> _Piece:
        middle = np.array([(times[0] + times[-1]) / 2])
        point, axis = self.axis(middle)
        origin = self.frame.origins(self.state.warming("frame", middle))[:, 0]
        pattern = self.bar.pattern(origin, self.frame.true_direction, point[0], axis[0])
        return _Piece(times, self.still(times), self.state.schedule.turning(times), pattern)

    def read_sphere(self, out: Array, first: int, rate: float, chosen: Channels, motion: StepProgram) -> None:
        """Fill ``out`` (chosen, n) with the samples first .. first + n - 1 on the stepped sphere."""
        begins, ends = motion.arrivals, motion.departures
        at = np.maximum(begins, motion.begin)
        places = motion.places + self.state.twist(at)[:, :3] + REPEATABILITY * self._draws(motion, (0, 1, 2)).T
        offset = SPECKLE * self._draws(motion, 3 + chosen) + self.frame.warm_up_offset(at + self.sensors_on_for)[chosen]
        origin = self.frame.origins(self.state.warming("frame", at[:1]))[:, 0]
        keys = np.array([kernels.stream_key(self.seed, _SPHERE_NOISE, channel) for channel in chosen])
        kernels.stepped_sphere(
            out,
            first,
            rate,
            begins,
            ends,
            places,
            self.sphere_radius,
            origin[chosen],
            self.frame.true_direction[chosen],
            offset,
            self.frame.noise[chosen],
            keys,
            self.frame.range,
        )

    def _draws(self, motion: StepProgram, streams: Channels | tuple[int, ...]) -> Array:
        """Return standard normal numbers (stream, position) that depend on the program and the machine."""
        bits = np.array([motion.begin, *motion.places[1], *motion.places[-2]]).view(np.int64)
        labels = (self.seed, _STEPS, *(int(b) for b in bits))
        return np.array([kernels.normals(kernels.stream_key(*labels, s), 0, len(motion.places)) for s in streams])
