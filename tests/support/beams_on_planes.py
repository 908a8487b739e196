"""Planes as a beam sees them, with the covariance of strokes along X, Y and Z, for tests of `beam_direction`."""

from __future__ import annotations

import numpy as np

from errormotion.arrays import Array
from errormotion.estimation.fit import fit
from errormotion.estimation.sources import Errors, errors_of
from errormotion.methods.beam_direction.identification.direction import Direction, solve
from errormotion.methods.beam_direction.identification.model import Beam
from errormotion.methods.beam_direction.identification.planes import Planes

NOISE = 0.1e-6
STAGE = np.concatenate([np.outer(np.linspace(-5e-3, 5e-3, 12), e) for e in np.eye(3)])
_A = np.column_stack([STAGE, np.ones(len(STAGE))])
COVARIANCE = NOISE**2 * np.linalg.inv(_A.T @ _A)
"""Of gradient and reading at the centre of the strokes."""


def normal(inclination: float, rotation: float) -> Array:
    """Return the normal (3,) of a face of a sine gauge, from angles in degrees."""
    a, b = np.radians([inclination, rotation])
    return np.array([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)])


def gradients_of(normals: Array, u: Array) -> Array:
    """Return the gradients (k, 3) of the readings of a beam along u on planes of these normals."""
    return -normals / (normals @ u)[:, None]


def planes_of(
    gradients: Array, offsets: Array | float = 0.0, covariances: Array = COVARIANCE, centre: Array | None = None
) -> Planes:
    """Return planes of these gradients (k, 3), with readings at their centre, m."""
    k = len(gradients)
    value = np.column_stack([gradients, np.broadcast_to(offsets, k)])
    names = tuple(f"Plane {i + 1}" for i in range(k))
    middle = np.zeros(3) if centre is None else centre
    return Planes(names, np.tile(middle, (k, 1)), value, np.broadcast_to(covariances, (k, 4, 4)).copy())


def beam_on(planes: Planes, **more: object) -> Beam:
    """Return a beam without known points."""
    return Beam(planes, np.array([0.0, 0.0, -1.0]), np.full((len(planes.names), 3), np.nan), **more)


def solved(planes: Planes, nominal: Array, **more: object) -> Direction:
    """Return the direction with exact constants."""
    return solve(beam_on(planes, **more), nominal)


def errors(beam: Beam) -> Errors:
    """Return zero point and direction, with their covariance and sources."""
    return errors_of(fit(beam.problem()), beam.places())
