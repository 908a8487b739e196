"""Sources of the profiles of a simulated line profiler.

A `Feed` yields the profiles of a stream. `FreeRunning` takes them at a constant rate from a `ProfileSource`, which
returns the heights along the line. The feed of a machine's axis is in `gantry_profiles`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.line_profiler.keyence_ljx_wire import ProfileLayout

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Lines:
    """Successive profiles.

    Attributes
    ----------
    encoder : ndarray, int64, (n,)
        Counts, without overflow.
    heights : ndarray, float64, (n, point), or None
        m; NaN: missing. None: all are missing.
    times : ndarray, float64, (n,)
        Times, s.
    """

    encoder: Array
    heights: Array | None
    times: Array


class Feed(Protocol):
    """Source of the profiles of a stream."""

    def count(self) -> int:
        """Return the present count of the encoder."""

    def begin(self) -> None:
        """Start a stream; InstrumentError if it cannot start now."""

    def lines(self, layout: ProfileLayout) -> Iterator[Lines | None]:
        """Yield the profiles of a stream when they are due; None if no profile is due."""

    def trigger(self) -> None:
        """Take one profile now if profiles are triggered by command; called while a stream runs."""

    def report_delivered(self, profiles: int) -> None:
        """Set the number of profiles of the stream that its reader has processed."""

    def end(self) -> None:
        """End the stream. Idempotent."""


class Clock:
    """Simulated time that keeps a pace.

    Parameters
    ----------
    pace : callable
        Returns simulated seconds per second; None: without waiting.
    begin : float
        Simulated time now, s.
    """

    def __init__(self, pace: Callable[[], float | None], begin: float = 0.0) -> None:
        self._pace, self._begin = pace, begin
        self._since = time.monotonic()

    @property
    def now(self) -> float:
        """Simulated time, s; without a pace everything is due."""
        pace = self._pace()
        return np.inf if pace is None else self._begin + pace * (time.monotonic() - self._since)


class ProfileSource(Protocol):
    """A surface that moves below a profiler."""

    def profile(self, encoder_count: int, n_points: int, x: Array) -> Array:
        """Return the profile at an encoder count, including noise.

        Parameters
        ----------
        encoder_count : int
            Counts since the encoder's zero, without overflow.
        n_points : int
        x : ndarray, float64, (n_points,)
            Positions of the points on the line, m.

        Returns
        -------
        heights : ndarray, float64, (n_points,)
            m; NaN: missing.
        """


class FreeRunning:
    """Profiles of a uniformly moving surface at a constant rate.

    Parameters
    ----------
    source : ProfileSource
    start, step : int
        Encoder count of the first profile, and counts between profiles.
    rate : float
        Profiles per simulated second.
    at_once : int
        Profiles in a block.
    pace : callable
        Of the `Clock`.
    """

    def __init__(
        self,
        source: ProfileSource,
        *,
        start: int,
        step: int,
        rate: float,
        at_once: int,
        pace: Callable[[], float | None],
    ) -> None:
        self._source = source
        self._start, self._step = start, step
        self._rate = rate
        self._at_once = at_once
        self._pace = pace
        self._first = 0  # number of the stream's first profile
        self._sent = self._taken = 0

    def count(self) -> int:
        """Return the encoder count of the next profile."""
        return self._start + self._step * (self._first + self._sent)

    def begin(self) -> None:
        """Continue after the last profile that the reader of the previous stream has processed."""
        self._first += self._taken or self._sent
        self._sent = self._taken = 0

    def lines(self, layout: ProfileLayout) -> Iterator[Lines | None]:
        """Yield profiles without end."""
        clock = Clock(self._pace)
        while True:
            numbers = np.arange(self._at_once, dtype=np.int64)
            counts = self.count() + self._step * numbers
            times = (self._sent + numbers + 1) / self._rate
            heights = np.array([self._source.profile(int(count), layout.points, layout.x) for count in counts])
            while clock.now < times[-1]:
                yield None
            self._sent += self._at_once
            yield Lines(counts, heights, times)

    def trigger(self) -> None:
        """Do nothing: profiles are taken without triggers."""

    def report_delivered(self, profiles: int) -> None:
        """Set the number of profiles of the stream that its reader has processed."""
        self._taken = profiles

    def end(self) -> None:
        """Do nothing."""


class SweptSurface:
    """A smooth free-form surface, 1 mm high, that moves below the profiler.

    Heights and noise are reproducible for each encoder count.

    Parameters
    ----------
    seed : int
    noise : float
        Standard deviation of the height of one point, m.
    count : float
        Feed per encoder count, m.
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
        """Return the profile at an encoder count, including noise."""
        noise = np.random.default_rng([self._seed, encoder_count % (1 << 64)]).standard_normal(n_points)
        return self.height(x, encoder_count * self._count) + self._noise * noise


#: Surfaces by their name in an address; each is created from the seed.
SOURCES: dict[str, Callable[[int], ProfileSource]] = {"swept": SweptSurface}


def make_source(name: str, seed: int, sources: Mapping[str, Callable[[int], ProfileSource]] = SOURCES) -> ProfileSource:
    """Return a surface by its name; InstrumentError lists the known names."""
    if name not in sources:
        raise InstrumentError(
            f"'artefact={name}': expected one of {', '.join(sorted({*sources, 'twin'}))}", code="simulator.setting"
        )
    return sources[name](seed)
