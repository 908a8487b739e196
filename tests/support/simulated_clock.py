"""A clock without real time, for programs of several threads."""

import threading
import time
from collections.abc import Callable

from errormotion.campaign.monitor.clock import Clock

TURN = 30.0
"""Longest real time of one turn of a thread, s."""


class SimulatedClock(Clock):
    """A clock that stands until the main thread sleeps.

    That gives every thread whose waiting has ended its turn, so that a busy computer changes nothing.

    Parameters
    ----------
    start : float
        s.

    Attributes
    ----------
    watch : callable
        Called before each sleep with its length, s.
    """

    def __init__(self, start: float = 0.0) -> None:
        self.time = start
        self.watch: Callable[[float], None] = lambda seconds: None
        self._change = threading.Condition()
        self._due: dict[threading.Thread, float] = {}
        self._at_work: set[threading.Thread] = set()

    def now(self) -> float:
        """Return the time, s."""
        return self.time

    def sleep(self, seconds: float) -> None:
        """Let time pass, and wait for the threads that are due then."""
        self.watch(seconds)
        with self._change:
            self.time += seconds
            self._at_work.update(each for each, due in self._due.items() if due <= self.time)
            self._change.notify_all()
            until = time.monotonic() + TURN
            while any(each.is_alive() for each in self._at_work):
                assert time.monotonic() < until, f"not back after {TURN:g} s: {self._at_work}"
                self._change.wait(0.01)
            self._at_work.clear()

    def wait(self, event: threading.Event, seconds: float) -> None:
        """Wait for an event; another thread than the main one also until a time."""
        thread = threading.current_thread()
        if thread is threading.main_thread():
            assert event.wait(TURN)  # for a first reading: no time passes
            return
        with self._change:
            due = self._due[thread] = self.time + seconds
            self._at_work.discard(thread)
            self._change.notify_all()
            while self.time < due and not event.is_set():
                self._change.wait(0.01)  # the event is not of this condition
            del self._due[thread]
