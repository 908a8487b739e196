"""What lies before a simulated line profiler: anything that tells the heights along its line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from errormotion.errors import InstrumentError

Array = np.ndarray[Any, Any]


class ProfileSource(Protocol):
    """A surface that is moved below a profiler."""

    def profile(self, encoder_count: int, n_points: int, x: Array) -> Array:
        """Return what the profiler sees at an encoder count, its noise included.

        Parameters
        ----------
        encoder_count : int
            Pulses since the encoder's zero, without overflow.
        n_points : int
        x : ndarray, float64, (n_points,)
            Where on the line the points are, m.

        Returns
        -------
        heights : ndarray, float64, (n_points,)
            m; NaN where the profiler has none.
        """


class SweptSurface:
    """A smooth free-form surface, 1 mm high, that the feed moves through the line.

    The same heights, noise included, whenever it is asked for the same encoder count.

    Parameters
    ----------
    seed : int
    noise : float
        Standard deviation of the height of one point, m.
    count : float
        Feed for one encoder pulse, m.
    """

    WAVES = 6
    HEIGHT = 1e-3

    def __init__(self, seed: int = 0, *, noise: float = 0.5e-6, count: float = 1e-6) -> None:
        rng = np.random.default_rng([abs(seed), 1])
        self._seed = abs(seed)
        self._noise = noise
        self._count = count
        self._amplitude = rng.uniform(0.1, 0.3, self.WAVES) * self.HEIGHT
        self._frequency = 2 * np.pi / rng.uniform(8e-3, 30e-3, (2, self.WAVES))  # rad/m along x and along the feed
        self._phase = rng.uniform(0, 2 * np.pi, self.WAVES)

    def height(self, x: Array, y: float) -> Array:
        """Return the true heights on the line at a feed of y, m."""
        (along, across), phase = self._frequency, self._phase
        return np.asarray(np.sin(np.multiply.outer(x, along) + across * y + phase) @ self._amplitude)

    def profile(self, encoder_count: int, n_points: int, x: Array) -> Array:
        """Return what the profiler sees at an encoder count, its noise included."""
        noise = np.random.default_rng([self._seed, encoder_count % (1 << 64)]).standard_normal(n_points)
        return self.height(x, encoder_count * self._count) + self._noise * noise


#: Surfaces by the name that an address gives; each is made from the seed.
SOURCES: dict[str, Callable[[int], ProfileSource]] = {"swept": SweptSurface}


def make_source(name: str, seed: int, sources: Mapping[str, Callable[[int], ProfileSource]] = SOURCES) -> ProfileSource:
    """Return a surface by its name; InstrumentError names those there are."""
    if name not in sources:
        raise InstrumentError(f"'artefact={name}': expected one of {', '.join(sorted(sources))}")
    return sources[name](seed)
