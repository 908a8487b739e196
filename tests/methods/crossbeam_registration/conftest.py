"""Artefacts to scan, and scans of them with known motion and noise."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import pytest

from errormotion.kinematics import poses

PITCH_X, PITCH_Y = 12.5e-6, 70e-6


def freeform(X, Y):
    """Waves and a bump of 1 mm with slopes up to 0.3, and its derivatives."""
    z, zx, zy = np.zeros_like(X), np.zeros_like(X), np.zeros_like(X)
    for a, lx, ly, phase in [(0.5e-3, 17e-3, 40e-3, 0.3), (0.45e-3, -35e-3, 15e-3, 1.1), (0.12e-3, 9e-3, 11e-3, 2.0)]:
        kx, ky = 2 * np.pi / lx, 2 * np.pi / ly
        angle = kx * X + ky * Y + phase
        z += a * np.sin(angle)
        slope = a * np.cos(angle)
        zx += kx * slope
        zy += ky * slope
    bump = 0.8e-3 * np.exp(-((X - 3e-3) ** 2 + (Y - 4e-3) ** 2) / (2 * 5e-3**2))
    return z + bump, zx - bump * (X - 3e-3) / 5e-3**2, zy - bump * (Y - 4e-3) / 5e-3**2


@dataclass
class Scanner:
    """A profiler of 1600 points over a feed of 400 profiles; the artefact stays, the profiler moves."""

    surface: Callable = freeform
    rows: int = 400
    columns: int = 1600
    noise: float = 0.5e-6
    x: np.ndarray = field(init=False)
    y: np.ndarray = field(init=False)

    def __post_init__(self):
        self.x = (np.arange(self.columns) - self.columns / 2) * PITCH_X
        self.y = (np.arange(self.rows) - self.rows / 2) * PITCH_Y

    def true_heights(self, pose=None, dy=0.0):
        """Heights in the frame at ``pose``, not to be changed; profiles are off by ``dy`` (row, 1)."""
        M = np.eye(4) if pose is None else pose.as_matrix()
        if np.any(dy):
            return intersections(self.surface, self.x, self.y[:, None] + dy, M)
        return known_intersections(self.surface, self.x.tobytes(), self.y.tobytes(), M.tobytes())

    def scan(self, rng, pose=None, *, jitter_z=0.0, jitter_y=0.0):
        """Return heights, x, y as a sensor gives them."""
        dy = rng.normal(0, jitter_y, (self.rows, 1)) if jitter_y else 0.0
        z = self.true_heights(pose, dy)
        return self.noisy(rng, z, jitter_z), self.x, self.y

    def noisy(self, rng, z, jitter_z=0.0):
        """Return heights with noise from point to point and from line to line."""
        z = z + self.noise * rng.standard_normal(z.shape, dtype=np.float32)
        if jitter_z:
            z = z + rng.normal(0, jitter_z, (self.rows, 1))
        return z.astype(np.float32)

    def bound(self):
        """Return the Cramer-Rao bound (6, 6) of the twist at the origin of both noisy scans."""
        return 2 * self.noise**2 * inverse_information(self.surface, self.x.tobytes(), self.y.tobytes())


def intersections(surface, x, y, M):
    """Heights z (row, column) so that M (x, y, z) is on the surface, for y (row, 1), by Newton's method."""
    x, z, tilt = x[None, :], np.zeros((y.size, x.size)), np.hypot(M[0, 2], M[1, 2])
    for _ in range(30):
        X, Y, Z = (M[i, 0] * x + M[i, 1] * y + M[i, 2] * z + M[i, 3] for i in range(3))
        S, Sx, Sy = surface(X, Y)
        step = (Z - S) / (M[2, 2] - Sx * M[0, 2] - Sy * M[1, 2])
        z -= step
        # X and Y change by the tilt times the step: with curvatures up to 200 / m, the next step is less than 4 pm.
        if tilt * np.max(np.abs(step)) < 2e-7:
            break
    return z


@lru_cache(maxsize=12)
def known_intersections(surface, x, y, M):
    """The same for the bytes of x, y (row,) and M, computed once."""
    x, y, M = (np.frombuffer(each) for each in (x, y, M))
    z = intersections(surface, x, y[:, None], M.reshape(4, 4))
    z.flags.writeable = False
    return z


@lru_cache(maxsize=4)
def inverse_information(surface, x, y):
    """The inverse information (6, 6) of a scan about the twist, in units of the variance of its points."""
    X, Y = np.meshgrid(np.frombuffer(x), np.frombuffer(y))
    Z, Sx, Sy = surface(X, Y)
    J = np.stack([-Sx, -Sy, np.ones_like(X), Y + Sy * Z, -X - Sx * Z, Sx * Y - Sy * X]).reshape(6, -1)
    return np.linalg.inv(J @ J.T)


@pytest.fixture
def scanner():
    """Return the scanner of the free-form artefact."""
    return Scanner()


@pytest.fixture(scope="session")
def make_scanner():
    """Return what makes a scanner of any surface."""
    return Scanner


@pytest.fixture
def motion():
    """Return a thermal motion: tens of micrometres and microradians."""
    return poses.displaced([23e-6, -41e-6, 17e-6, 30e-6, -55e-6, 80e-6])
