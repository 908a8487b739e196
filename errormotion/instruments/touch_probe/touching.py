"""One touch by a controller: search fast, back off, touch slowly, again; and everything that can be wrong with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from errormotion.errors import InstrumentError
from errormotion.plugins import Contact, Touch

Array = NDArray[np.float64]

NO_TRIP, TRIPPED, DIFFERS, NOT_MADE = "no trip", "tripped at the start", "repeat differs", "not made"
_TRIPPED_BEFORE = "tripped before it moves"  # what controllers state
NOWHERE = (float("nan"),) * 3


class Prober(Protocol):
    """What of a controller a touch needs."""

    def state(self) -> dict[str, Any]:
        """Return what the control shows."""

    def move_to(self, position: Sequence[float], feed: float | None = None) -> Any:
        """Move in a straight line, m and m/s."""

    def probe(self, target: Sequence[float], feed: float) -> dict[str, Any]:
        """Move in a straight line until the probe trips."""

    def elapse(self, seconds: float) -> None:
        """Let time pass."""

    def stop(self) -> None:
        """Abort all motion."""


class StuckError(InstrumentError):
    """The probe is tripped although it touches nothing."""


@dataclass(frozen=True)
class Strategy:
    """How a touch is made; lengths in m, feeds in m/s, times in s.

    Attributes
    ----------
    approach_feed, search_feed, touch_feed : float
        Between touches, of the first contact, of those that count.
    back_off : float
        Between contacts.
    free : float
        First part of the way in which a trip is a false one.
    margin : float
        How much later or earlier than the fast contact a slow one may be, and how far off the way both.
    repeats : int
        Slow contacts; their mean counts.
    agreement : float
        By how much they may differ.
    attempts : int
        False trips and stuck probes that are tried again.
    settling : float
        Waiting time for a probe that is stuck.
    """

    approach_feed: float
    search_feed: float
    touch_feed: float
    back_off: float
    free: float
    margin: float
    repeats: int
    agreement: float
    attempts: int
    settling: float


class Toucher:
    """Makes touches one by one.

    Parameters
    ----------
    control : Prober
        The controller, opened.
    strategy : Strategy
    """

    def __init__(self, control: Prober, strategy: Strategy) -> None:
        self._control = control
        self._how = strategy

    def travel(self, place: Array) -> None:
        """Go somewhere with the probe on guard.

        Raises
        ------
        StuckError
            The probe is tripped before it moves.
        InstrumentError
            It touched something on the way: the machine is at rest there.
        """
        found = self._probe(place, self._how.approach_feed)
        if found is not None:
            x, y, z = 1e3 * np.asarray(found["position"], dtype=float)
            raise InstrumentError(
                f"the probe touched something at X {x:.3f} Y {y:.3f} Z {z:.3f} mm, where its way should have been "
                "free; the machine is at rest there. See what is in the way, or raise the clearance"
            )

    def touch(self, touch: Touch) -> Contact:
        """Make one touch from its start, where the tip stands, and return there.

        Raises
        ------
        StuckError
            The probe is tripped at the start, and stays so.
        InstrumentError
            The controller refuses, or states that it tripped off the way.
        """
        start, target = np.array(touch.start, dtype=float), np.array(touch.target, dtype=float)
        way = target - start
        length = float(np.linalg.norm(way))
        if not length > 0:
            raise InstrumentError("expected a touch whose target is not its start")
        direction = way / length
        begin = start
        for _ in range(1 + self._how.attempts):
            fast = self._search(begin, target, start, direction, length)
            if fast is None:
                break
            slow = self._slow(fast, start, direction, length)
            if slow:
                return self._judged(fast, slow, start, direction)
            begin = start  # nothing was there: it was a false trip
            self._control.move_to(begin.tolist(), self._how.approach_feed)
        self._control.move_to(start.tolist(), self._how.approach_feed)
        return Contact(NOWHERE, float(self._control.state()["time"]), NO_TRIP)

    def _search(self, begin: Array, target: Array, start: Array, direction: Array, length: float) -> float | None:
        """Return how far from the start the probe trips at the fast feed, m; None where it does not."""
        for _ in range(1 + self._how.attempts):
            found = self._probe(target, self._how.search_feed)
            if found is None:
                return None
            along = self._along(found, start, direction, length)
            if along >= self._how.free:
                return along
            self._control.move_to(begin.tolist(), self._how.approach_feed)  # a jolt at the start, and no contact
        raise StuckError(f"the probe trips within {1e3 * self._how.free:g} mm of the start, where nothing is")

    def _slow(self, fast: float, start: Array, direction: Array, length: float) -> list[tuple[float, float]]:
        """Return how far from the start the probe trips at the slow feed, m, and when; empty where it does not."""
        limit = start + min(fast + self._how.margin, length) * direction
        found: list[tuple[float, float]] = []
        place = fast
        for _ in range(self._how.repeats):
            back = start + max(0.0, place - self._how.back_off) * direction
            self._control.move_to(back.tolist(), self._how.approach_feed)
            tripped = self._probe(limit, self._how.touch_feed)
            if tripped is None:
                return []
            place = self._along(tripped, start, direction, length)
            found.append((place, float(tripped["time"])))
        return found

    def _judged(self, fast: float, slow: Sequence[tuple[float, float]], start: Array, direction: Array) -> Contact:
        """Return the contact of slow touches, with the tip back at the start."""
        places, times = np.array(slow).T
        self._control.move_to(start.tolist(), self._how.approach_feed)
        time = float(times.mean())
        if np.ptp(places) > self._how.agreement or np.abs(places - fast).max() > self._how.margin:
            return Contact(NOWHERE, time, DIFFERS)
        x, y, z = (float(value) for value in start + places.mean() * direction)
        return Contact((x, y, z), time)

    def _along(self, found: dict[str, Any], start: Array, direction: Array, length: float) -> float:
        """Return how far along the way the probe tripped, m; refuse a position that is not on the way."""
        offset = np.asarray(found["position"], dtype=float) - start
        along = float(offset @ direction)
        aside = float(np.linalg.norm(offset - along * direction))
        if not (aside <= self._how.margin and -self._how.margin <= along <= length + self._how.margin):
            raise InstrumentError(
                f"expected the probe to trip on its way of {1e3 * length:.3f} mm; the controller states "
                f"{1e3 * along:.3f} mm along it and {1e3 * aside:.3f} mm aside. Does it use machine coordinates?"
            )
        return along

    def _probe(self, target: Array, feed: float) -> dict[str, Any] | None:
        """Move until the probe trips; wait for a stuck one; None where it does not trip."""
        for attempt in range(1 + self._how.attempts):
            try:
                found = self._control.probe(target.tolist(), feed)
            except InstrumentError as error:
                if _TRIPPED_BEFORE not in str(error):
                    raise
                if attempt == self._how.attempts:
                    raise StuckError(f"the probe is tripped before it moves, and stays so: {error}") from error
                self._control.elapse(self._how.settling)
                continue
            return found if found["tripped"] else None
        return None
