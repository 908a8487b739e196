"""A turning spindle with known error motions, and displacement sensors that look at an artefact in it.

The error motion consists of harmonics of the rotation (synchronous), of vibrations at other frequencies, such as those
of its bearings, and of a broadband motion. The artefact is eccentric and has a form. Readings follow from the exact
geometry of a circle that a sensor looks at along a line.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.signal import lfilter

from errormotion.arrays import Array

TAU = 2 * np.pi
TYPICAL = {
    "EX": {2: (60e-9, 0.3), 3: (25e-9, 1.1), 7: (8e-9, 2.0)},
    "EY": {2: (45e-9, 1.7), 3: (30e-9, 0.2), 5: (10e-9, 0.8)},
    "EZ": {1: (40e-9, 0.5), 2: (20e-9, 1.9), 4: (10e-9, 0.1)},
    "EA": {2: (0.4e-6, 0.9), 3: (0.15e-6, 2.2)},
    "EB": {2: (0.3e-6, 2.4), 4: (0.1e-6, 0.6)},
}
"""Amplitude (m, rad) and phase by the number of periods in one turn, of a good spindle with rolling bearings."""
BEARING = ((0.4137, 0.5), (3.5921, 0.4), (6.4079, 0.3))
"""Periods in one turn of the cage and of passing balls, and their amplitudes relative to the asynchronous motion."""


@dataclass(frozen=True)
class Spindle:
    """A spindle and the artefact in it, with coordinates of a spindle along Z: X, Y across it.

    Attributes
    ----------
    harmonics : mapping of str to mapping of int to (float, float)
        Amplitude and phase of ``cos(k q + phase)`` of each freedom.
    asynchronous : float
        Standard deviation of the motion that is not synchronous, of EX, EY and EZ, m.
    bearing : sequence of (float, float)
        Vibrations; the rest is broadband.
    lever : float
        Rotations have the same motion over this length, m.
    correlation : float
        Of the broadband motion between samples.
    speed : float
        1/min; negative in the negative sense.
    ripple : (float, float)
        Relative change of the speed, and its period, turns.
    eccentricity : complex
        Of the artefact at angle 0, m; the same for its tilt, rad.
    """

    harmonics: Mapping[str, Mapping[int, tuple[float, float]]] = field(default_factory=lambda: TYPICAL)
    asynchronous: float = 30e-9
    bearing: tuple[tuple[float, float], ...] = BEARING
    lever: float = 0.2
    correlation: float = 0.5
    speed: float = 3000.0
    ripple: tuple[float, float] = (0.0, 13.0)
    eccentricity: complex = 5e-6
    tilt: complex = 20e-6

    def angle(self, time: Array) -> Array:
        """Return the angle of the spindle, (n,), rad."""
        mean = TAU * self.speed / 60 * time
        size, period = self.ripple
        return np.asarray(mean + size * period * np.sin(mean / period))

    def pulses(self, end: float) -> Array:
        """Return the times of whole turns up to an instant, s, by Newton's method."""
        size, period = self.ripple
        rate = TAU * self.speed / 60
        whole = TAU * np.sign(self.speed) * np.arange(int(abs(self.angle(np.array([end]))[0]) / TAU + 1e-9) + 1)
        time = whole / rate
        for _ in range(20):
            time = time - (self.angle(time) - whole) / (rate * (1 + size * np.cos(rate * time / period)))
        return np.asarray(time)

    def synchronous(self, angle: Array) -> Array:
        """Return the error motion that repeats in every turn, without eccentricity, (n, 6)."""
        motion = np.zeros((angle.size, 6))
        for name, harmonics in self.harmonics.items():
            at = ("EX", "EY", "EZ", "EA", "EB", "EC").index(name)
            for k, (amplitude, phase) in harmonics.items():
                motion[:, at] += amplitude * np.cos(k * angle + phase)
        return motion

    def other(self, angle: Array, generator: np.random.Generator) -> Array:
        """Return the error motion that does not repeat, (n, 6)."""
        n, motion = angle.size, np.zeros((angle.size, 6))
        share = sum(a**2 for _, a in self.bearing)
        for k in range(5):
            for order, amplitude in self.bearing:
                motion[:, k] += np.sqrt(2) * amplitude * np.cos(order * angle + generator.uniform(0, TAU))
            w = generator.standard_normal(n) * np.sqrt(max(1 - share, 0.0))
            w[1:] *= np.sqrt(1 - self.correlation**2)
            motion[:, k] += lfilter([1.0], [1.0, -self.correlation], w)
        return np.asarray(motion * self.asynchronous * np.array([1, 1, 1, 1 / self.lever, 1 / self.lever, 0]))

    def set_up(self, angle: Array) -> Array:
        """Return the motion of the artefact by its eccentricity and tilt, (n, 6)."""
        motion, turn = np.zeros((angle.size, 6)), np.exp(1j * angle)
        for at, size in ((0, self.eccentricity), (3, self.tilt)):
            motion[:, at], motion[:, at + 1] = (size * turn).real, (size * turn).imag
        return motion


def displacements(
    motion: Array,
    angle: Array,
    direction: Array,
    position: Array,
    radius: float,
    form: tuple[Array, Array, Array] | None = None,
) -> Array:
    """Return the readings of sensors of the surface of an artefact, (sensor, n), m.

    Parameters
    ----------
    motion : ndarray, (n, 6)
        Of the artefact at the origin.
    angle : ndarray, (n,)
        Of the spindle about Z, rad.
    direction, position : ndarray, (sensor, 3)
        Across or along Z; the points of the surface, from the origin.
    radius : float
        m.
    form : tuple of ndarray, (h,), (sensor, h), (sensor, h)
        Undulations, and their cosines and sines of the form at each sensor, outward, m.
    """
    result = np.empty((len(direction), angle.size))
    for k, (n, p) in enumerate(zip(direction, position, strict=True)):
        d = motion[:, :3] + np.cross(motion[:, 3:], p)
        if abs(n[2]) > 0.5:
            result[k] = d @ n
            continue
        o = np.array([p[0], p[1], 0.0]) / np.hypot(p[0], p[1])
        b = d @ np.array([-o[1], o[0], 0.0])
        surface = d @ o + np.sqrt(radius**2 - b**2) - radius
        if form is not None:
            undulations, cosine, sine = form
            phase = np.multiply.outer(np.arctan2(o[1], o[0]) - angle, undulations)
            surface = surface + np.cos(phase) @ cosine[k] + np.sin(phase) @ sine[k]
        result[k] = (n @ o) * surface + (d @ (n - (n @ o) * o))
    return result
