"""One touch by a controller: fast search, retraction, slow contacts, and the detection of faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from errormotion.errors import InstrumentError
from errormotion.plugins import Contact, Touch
from errormotion.plugins.virtual import wait

Array = NDArray[np.float64]

NO_TRIP, TRIPPED, DIFFERS, NOT_MADE = "no trip", "tripped at the start", "repeat differs", "not made"
_TRIPPED_BEFORE = "tripped before it moves"  # part of the messages of controllers
NOWHERE = (float("nan"),) * 3


class Prober(Protocol):
    """Members of a controller that a touch needs."""

    def state(self) -> dict[str, Any]:
        """Return the state of the control."""

    def move_to(self, position: Sequence[float], feed: float | None = None) -> Any:
        """Move in a straight line, m and m/s."""

    def probe(self, target: Sequence[float], feed: float) -> dict[str, Any]:
        """Move in a straight line until the probe trips."""

    def stop(self) -> None:
        """Abort all motion."""


class StuckError(InstrumentError):
    """The probe is tripped without a contact."""

    code = "probe.tripped.before"


@dataclass(frozen=True)
class Strategy:
    """Parameters of a touch; lengths in m, feeds in m/s, times in s.

    Attributes
    ----------
    approach_feed, search_feed, touch_feed : float
        Feed between touches, of the first contact, of the slow contacts.
    back_off : float
        Distance of the retraction between contacts.
    free : float
        First part of the path, in which a trip counts as false.
    margin : float
        Largest distance between fast and slow contact, and of both from the path.
    repeats : int
        Number of slow contacts; their mean is the result.
    agreement : float
        Largest difference of slow contacts.
    attempts : int
        Retries after false trips and stuck probes.
    settling : float
        Waiting time for a stuck probe.
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

    def travel(self, position: Array) -> None:
        """Move to a position by a probing move.

        Raises
        ------
        StuckError
            The probe is tripped before it moves.
        InstrumentError
            The probe tripped on the path; the machine has stopped there.
        """
        found = self._probe(position, self._how.approach_feed)
        if found is not None:
            x, y, z = 1e3 * np.asarray(found["position"], dtype=float)
            raise InstrumentError(
                f"the probe tripped at X {x:.3f} Y {y:.3f} Z {z:.3f} mm, where its path should be free; the machine "
                "has stopped there. Remove the obstacle, or increase the clearance",
                code="probe.path.not_free",
            )

    def touch(self, touch: Touch) -> Contact:
        """Make one touch from its start, the present position of the tip, and return there.

        Raises
        ------
        StuckError
            The probe is tripped at the start, and remains so.
        InstrumentError
            The controller refuses, or reports a trip off the path.
        """
        start, target = np.array(touch.start, dtype=float), np.array(touch.target, dtype=float)
        path = target - start
        length = float(np.linalg.norm(path))
        if not length > 0:
            raise InstrumentError("expected a touch whose target differs from its start", code="touch.target.same")
        direction = path / length
        origin = start
        for _ in range(1 + self._how.attempts):
            fast = self._search(origin, target, start, direction, length)
            if fast is None:
                break
            slow = self._slow(fast, start, direction, length)
            if slow:
                return self._evaluate(fast, slow, start, direction)
            origin = start  # no slow contact: a false trip
            self._control.move_to(origin.tolist(), self._how.approach_feed)
        self._control.move_to(start.tolist(), self._how.approach_feed)
        return Contact(NOWHERE, float(self._control.state()["time"]), NO_TRIP)

    def _search(self, origin: Array, target: Array, start: Array, direction: Array, length: float) -> float | None:
        """Return the distance from the start at which the probe trips at the fast feed, m; None without a trip."""
        for _ in range(1 + self._how.attempts):
            found = self._probe(target, self._how.search_feed)
            if found is None:
                return None
            along = self._along(found, start, direction, length)
            if along >= self._how.free:
                return along
            self._control.move_to(origin.tolist(), self._how.approach_feed)  # a false trip at the start
        raise StuckError(f"the probe trips within {1e3 * self._how.free:g} mm of the start, where its path is free")

    def _slow(self, fast: float, start: Array, direction: Array, length: float) -> list[tuple[float, float]]:
        """Return distance from the start (m) and time (s) of each slow trip; empty without a trip."""
        limit = start + min(fast + self._how.margin, length) * direction
        contacts: list[tuple[float, float]] = []

        distance = fast
        for _ in range(self._how.repeats):
            back = start + max(0.0, distance - self._how.back_off) * direction
            self._control.move_to(back.tolist(), self._how.approach_feed)
            tripped = self._probe(limit, self._how.touch_feed)
            if tripped is None:
                return []
            distance = self._along(tripped, start, direction, length)
            contacts.append((distance, float(tripped["time"])))
        return contacts

    def _evaluate(self, fast: float, slow: Sequence[tuple[float, float]], start: Array, direction: Array) -> Contact:
        """Return the contact of slow touches, with the tip back at the start."""
        distances, times = np.array(slow).T
        self._control.move_to(start.tolist(), self._how.approach_feed)
        time = float(times.mean())
        if np.ptp(distances) > self._how.agreement or np.abs(distances - fast).max() > self._how.margin:
            return Contact(NOWHERE, time, DIFFERS)
        x, y, z = (float(value) for value in start + distances.mean() * direction)
        return Contact((x, y, z), time)

    def _along(self, found: dict[str, Any], start: Array, direction: Array, length: float) -> float:
        """Return the distance of a trip along the path, m; refuse a position off the path."""
        offset = np.asarray(found["position"], dtype=float) - start
        along = float(offset @ direction)
        aside = float(np.linalg.norm(offset - along * direction))
        if not (aside <= self._how.margin and -self._how.margin <= along <= length + self._how.margin):
            raise InstrumentError(
                f"expected the probe to trip on its path of {1e3 * length:.3f} mm; the controller reports "
                f"{1e3 * along:.3f} mm along it and {1e3 * aside:.3f} mm aside. Does it use machine coordinates?",
                code="touch.path.other",
            )
        return along

    def _probe(self, target: Array, feed: float) -> dict[str, Any] | None:
        """Move until the probe trips; wait for a stuck one; None if it does not trip."""
        for attempt in range(1 + self._how.attempts):
            try:
                found = self._control.probe(target.tolist(), feed)
            except InstrumentError as error:
                if _TRIPPED_BEFORE not in str(error):
                    raise
                if attempt == self._how.attempts:
                    raise StuckError(f"the probe is tripped before it moves, and remains so: {error}") from error
                wait(self._control, self._how.settling)
                continue
            return found if found["tripped"] else None
        return None
