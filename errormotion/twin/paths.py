"""Positions of the axes over time: straight pieces, each at a constant feed, without acceleration."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array

#: Lowest feed, m/s, and shortest distance, m, of a move along Y that warms up the crossbeam.
WARM_UP_FEED, WARM_UP_DISTANCE = 2.0 / 60, 0.2
_ROUNDING = 1e-6  # counts


@dataclass(frozen=True)
class Path:
    """The path of the axes X, Y, Z.

    Attributes
    ----------
    times : ndarray, (n,)
        Increasing, s. Before the first and after the last time, the machine does not move.
    places : ndarray, (n, 3)
        Commanded, m. Two equal positions in succession are a dwell.
    rapid : ndarray of bool, (n - 1,)
        Which of the pieces are rapid moves.
    """

    times: Array
    places: Array
    rapid: NDArray[np.bool_]

    @classmethod
    def resting(cls, place: ArrayLike, since: float = 0.0) -> Path:
        """Return the path of a machine that does not move, from a time on, s."""
        return cls(np.full(1, float(since)), np.array(place, dtype=float).reshape(1, 3), np.zeros(0, dtype=bool))

    @property
    def begin(self) -> float:
        """Start of the first piece, s."""
        return float(self.times[0])

    @property
    def end(self) -> float:
        """End of the last piece, s."""
        return float(self.times[-1])

    @property
    def duration(self) -> float:
        """Time from ``begin`` to ``end``, s."""
        return self.end - self.begin

    def beginning(self, time: float) -> Path:
        """Return the same path with another start time, s."""
        return replace(self, times=self.times - self.begin + time)

    def place(self, t: ArrayLike) -> Array:
        """Return the positions at times t (...), s; m, shape (..., 3)."""
        t = np.asarray(t, dtype=float)
        places = np.empty((*t.shape, 3))
        for axis in range(3):
            places[..., axis] = np.interp(t, self.times, self.places[:, axis])
        return places

    def cut(self, time: float) -> Path:
        """Return the same path up to a time, s, at which the machine stops."""
        if time <= self.begin:
            return Path(np.array([time]), self.places[:1], self.rapid[:0])
        before = self.times < time
        last = int(np.sum(before))
        times, places = np.append(self.times[before], time), np.vstack([self.places[before], self.place(time)])
        return Path(times, places, self.rapid[:last])

    def feed(self, time: float) -> float:
        """Return the feed at a time, m/s."""
        piece = int(np.searchsorted(self.times, time, side="right")) - 1
        if not 0 <= piece < len(self.times) - 1:
            return 0.0
        distance = np.linalg.norm(self.places[piece + 1] - self.places[piece])
        return float(distance / (self.times[piece + 1] - self.times[piece]))

    def warm_up(self) -> float | None:
        """Return the start of the first move that warms up the crossbeam, s; None without one.

        It is a move along Y at `WARM_UP_FEED` or faster over more than `WARM_UP_DISTANCE` that is not rapid: a
        measuring pass with a rapid return is not a warm-up.
        """
        distance, seconds = np.abs(np.diff(self.places[:, 1])), np.diff(self.times)
        warming = (distance > WARM_UP_DISTANCE) & (distance >= WARM_UP_FEED * seconds * (1 - 1e-9)) & ~self.rapid
        return float(self.times[np.argmax(warming)]) if warming.any() else None

    def pieces_forwards(self, after: float) -> list[int]:
        """Return the numbers of the pieces in +Y that end after a time, in order."""
        forwards = (np.diff(self.places[:, 1]) > 0) & (self.times[1:] > after)
        return [int(piece) for piece in np.flatnonzero(forwards)]

    def crossings(self, piece: int, count: float, start: int, step: int) -> tuple[NDArray[np.int64], Array]:
        """Return the counts and times at which an encoder on Y triggers during a piece in +Y.

        It triggers where its count is a multiple of ``step``, at the end of the piece but not at its start, so that
        successive pieces trigger once at their common position.

        Parameters
        ----------
        piece : int
            Number of the piece.
        count : float
            Distance per count, m.
        start : int
            Count at Y = 0.
        step : int
            Counts between triggers.

        Returns
        -------
        counts : ndarray, int64, (n,)
        times : ndarray, (n,)
            s.
        """
        low, high = self.places[piece : piece + 2, 1] / count + start
        first, last = (int(np.floor((end + _ROUNDING) / step)) for end in (low, high))
        counts = step * np.arange(first + 1, last + 1, dtype=np.int64)
        t0, t1 = self.times[piece : piece + 2]
        return counts, np.asarray(t0 + np.clip((counts - low) / (high - low), 0.0, 1.0) * (t1 - t0))
