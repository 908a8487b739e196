"""Instruments of a monitor; a separate thread for each, so that no instrument delays another."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from errormotion.campaign.bench import Answer, connect
from errormotion.campaign.files import BenchInstrument
from errormotion.campaign.monitor.clock import Clock
from errormotion.campaign.storage.journal import cause_of

FIRST_RETRY_INTERVAL, MAX_RETRY_INTERVAL = 1.0, 30.0
"""Time until an instrument is opened again after a failure, s; doubled after each failure up to the longest."""

FAILURES_BEFORE_RECONNECT = 3
"""Consecutive failed readings after which the instrument is closed and opened again."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Reading:
    """The last reading of a source.

    Attributes
    ----------
    at : float
        Time of the monitor's clock when it was received, s.
    values : mapping
        Result of the driver's ``read``.
    flags : mapping of str to str
        Reasons of unknown temperatures; empty for other instruments.
    """

    at: float
    values: Mapping[str, Any]
    flags: Mapping[str, str] = field(default_factory=dict)


class Source:
    """One instrument that is read periodically; after a failure, reading is retried without limit.

    Parameters
    ----------
    instrument : BenchInstrument
        The instrument.
    interval : float
        Time from one reading to the next, s.
    clock : Clock
        Clock of the monitor.

    Attributes
    ----------
    answer : Answer or None
        Identity when the instrument was last opened.
    error : str
        Cause of a missing reading; empty while readings arrive.
    readings : int
        Number of readings so far.
    """

    def __init__(self, instrument: BenchInstrument, interval: float, clock: Clock) -> None:
        self.instrument = instrument
        self._clock = clock
        self.name = instrument.name
        self.interval = interval
        self.answer: Answer | None = None
        self.error = "has not answered yet"
        self.readings = 0
        self._driver: Any = None
        self._reading: Reading | None = None
        self._stop = threading.Event()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._work, name=f"errormotion-monitor-{self.name}", daemon=True)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the sensors of a thermometer; available before it is opened."""
        return tuple(self._unopened().channels)

    @property
    def places(self) -> dict[str, tuple[float, float, float] | None]:
        """Positions of the sensors of a thermometer on the machine, m; None if unknown."""
        found = getattr(self._unopened(), "places", {})
        return {name: found.get(name) for name in self.channels}

    def _unopened(self) -> Any:
        return self.instrument.driver(self.instrument.address, self.instrument.settings)

    def start(self) -> None:
        """Start reading."""
        self._thread.start()

    def wait(self, timeout: float) -> None:
        """Wait for the first reading or failure."""
        self._clock.wait(self._ready, timeout)

    def stop(self) -> None:
        """Request the thread to end; `join` waits for it."""
        self._stop.set()

    def join(self) -> None:
        """Wait until the instrument is closed."""
        self._thread.join()

    def fresh(self, oldest: float) -> Reading | None:
        """Return the last reading if it is not older than a time of the clock."""
        reading = self._reading
        return reading if reading is not None and reading.at >= oldest else None

    def _work(self) -> None:
        wait, failed = FIRST_RETRY_INTERVAL, 0
        try:
            while not self._stop.is_set():
                start = self._clock.now()
                try:
                    self._open()
                    values = dict(self._driver.read())
                    self._reading = Reading(self._clock.now(), values, _flags(self._driver, values))
                    self.readings += 1
                except Exception as error:  # noqa: BLE001 - reported to the operator, and retried
                    failed += 1
                    self._note(cause_of(error))
                    if self._driver is None or failed >= FAILURES_BEFORE_RECONNECT:
                        self._close()
                        self._ready.set()
                        self._clock.wait(self._stop, wait)
                        wait = min(2 * wait, MAX_RETRY_INTERVAL)
                        continue
                else:
                    wait, failed = FIRST_RETRY_INTERVAL, 0
                    self._note("")
                self._ready.set()
                self._clock.wait(self._stop, max(0.0, start + self.interval - self._clock.now()))
        finally:
            self._close()

    def _open(self) -> None:
        if self._driver is not None:
            return
        driver = self._unopened()
        self.answer, self._driver = Answer(self.instrument, driver, connect(driver)), driver

    def _close(self) -> None:
        driver, self._driver = self._driver, None
        if driver is not None:
            try:
                driver.close()
            except Exception:
                log.exception("instrument %s could not be closed", self.name)

    def _note(self, error: str) -> None:
        """Store the cause of a missing reading, and log each change once."""
        if bool(error) != bool(self.error) or self._reading is None:
            if error:
                log.warning("%s does not answer: %s", self.name, error)
            else:
                log.info("%s answers", self.name)
        self.error = error


def _flags(driver: Any, values: Mapping[str, Any]) -> dict[str, str]:
    """Return the reasons of unknown values by name; 'unknown' where the driver states none."""
    flags = getattr(driver, "flags", {})
    return {
        name: flags.get(name) or "unknown"
        for name, value in values.items()
        if isinstance(value, float) and math.isnan(value)
    }
