"""The bar in the spindle: position of its axis, runout, and texture of its surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from errormotion.arrays import Array
from errormotion.twin import intersections

RADIUS = 5e-3
#: Number of angles in the table of the pattern that repeats in every turn, and its highest harmonic.
ANGLES = 1024
HARMONICS = 36


@dataclass(frozen=True)
class Bar:
    """A check bar in a spindle that rotates about its own axis.

    Attributes
    ----------
    radius : float
        True radius, m.
    point, axis : ndarray, (3,)
        Cold axis of rotation: its intersection with the end of the bar, m, and its unit direction.
    eccentricity : float
        Distance of the bar's axis from the axis of rotation at the end of the bar, m: its runout is twice that.
    eccentricity_angle : float
        rad, at turn 0.
    wobble : ndarray, (2,)
        Inclination of the bar's axis to the axis of rotation about x and y at turn 0, rad.
    face_tilt : ndarray, (2,)
        Inclination of the end face to the plane perpendicular to the axis of rotation, at turn 0, rad.
    axial_runout : float
        Amplitude of the axial motion once per turn, m.
    texture : ndarray, (channel, ANGLES)
        Roughness and speckle along the track of each beam, m, with mean 0.
    """

    radius: float
    point: Array
    axis: Array
    eccentricity: float
    eccentricity_angle: float
    wobble: Array
    face_tilt: Array
    axial_runout: float
    texture: Array

    def still_readings(self, origin: Array, direction: Array, point: Array, axis: Array) -> Array:
        """Return the distances to a perfect bar that rotates without runout, m, shape (channel, n).

        Parameters
        ----------
        origin : (channel, n, 3)
            m.
        direction : (channel, 3)
            Unit directions; the last channel measures the end face.
        point, axis : (n, 3)
            Axis of rotation, m, unit.
        """
        beams = direction[:, None, :]
        side = intersections.to_cylinder(origin[:-1], beams[:-1], point, axis, self.radius)
        end = intersections.to_plane(origin[-1:], beams[-1:], point, axis)
        return np.concatenate([side, end])

    def pattern(self, origin: Array, direction: Array, point: Array, axis: Array) -> Array:
        """Return the effect of runout and texture on the readings over one turn, m, shape (channel, ANGLES + 1).

        Parameters
        ----------
        origin, direction : (channel, 3)
            m, unit.
        point, axis : (3,)
            Axis of rotation, m, unit.
        """
        angle = 2 * np.pi * np.arange(ANGLES) / ANGLES
        x = np.stack([np.cos(angle), np.sin(angle), np.zeros(ANGLES)], axis=-1)  # axes that rotate with the spindle
        y = np.stack([-np.sin(angle), np.cos(angle), np.zeros(ANGLES)], axis=-1)

        def tilted(tilt: Array) -> Array:  # the axis of rotation tilted by two angles that rotate with the spindle
            vector = axis + tilt[1] * x - tilt[0] * y
            return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))

        start = np.cos(self.eccentricity_angle) * x + np.sin(self.eccentricity_angle) * y
        centre = point + self.eccentricity * start
        face = point + self.axial_runout * np.cos(angle)[:, None] * axis
        o, u = origin[:, None, :], direction[:, None, :]
        side = intersections.to_cylinder(o[:-1], u[:-1], centre, tilted(self.wobble), self.radius)
        end = intersections.to_plane(o[-1:], u[-1:], face, tilted(self.face_tilt))
        readings = np.concatenate([side, end])
        pattern = readings - self.still_readings(o, direction, point[None], axis[None]) + self.texture
        return np.concatenate([pattern, pattern[:, :1]], axis=1)


def seeded_texture(rng: np.random.Generator, channels: int, sigma: float) -> Array:
    """Return a band-limited pattern around the bar with this standard deviation and mean 0, (channels, ANGLES)."""
    harmonic = np.zeros((channels, ANGLES // 2 + 1), dtype=complex)
    harmonic[:, 1 : HARMONICS + 1] = rng.normal(size=(channels, HARMONICS)) + 1j * rng.normal(
        size=(channels, HARMONICS)
    )
    pattern = np.fft.irfft(harmonic, ANGLES, axis=1)
    return np.asarray(pattern * (sigma / pattern.std(axis=1, keepdims=True)))


def seeded_bar(rng: np.random.Generator, channels: int) -> Bar:
    """Return a bar of 5 mm radius with the deviations of a good one."""
    tilt = rng.normal(0, 50e-6, 2).clip(-120e-6, 120e-6)
    axis = np.array([tilt[1], -tilt[0], 1.0])
    return Bar(
        radius=RADIUS + rng.uniform(-0.8e-6, 0.8e-6),
        point=np.array([*rng.normal(0, 20e-6, 2).clip(-40e-6, 40e-6), 0.0]),
        axis=axis / np.linalg.norm(axis),
        eccentricity=rng.uniform(1e-6, 2.5e-6),
        eccentricity_angle=rng.uniform(0, 2 * np.pi),
        wobble=rng.normal(0, 15e-6, 2),
        face_tilt=rng.normal(0, 50e-6, 2),
        axial_runout=rng.uniform(0.2e-6, 0.6e-6),
        texture=seeded_texture(rng, channels, 0.3e-6),
    )
