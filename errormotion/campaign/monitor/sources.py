"""What a monitor listens to: an instrument with a thread of its own, which nobody else has to wait for."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from errormotion.campaign.bench import Answer
from errormotion.campaign.files import BenchInstrument

FIRST_WAIT, LONGEST_WAIT = 1.0, 30.0
"""Before an instrument that did not come up is tried again, s; doubled each time up to the longest."""

PATIENCE = 3
"""Failed readings in a row before the connection is made anew: a driver may mend it by itself."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Reading:
    """The last thing that a source said.

    Attributes
    ----------
    at : float
        ``time.monotonic()`` when it had come, s.
    values : mapping
        What the driver's ``read`` returned.
    flags : mapping of str to str
        Why a value of a thermometer is unknown; empty for the others.
    """

    at: float
    values: Mapping[str, Any]
    flags: Mapping[str, str] = field(default_factory=dict)


class Source:
    """One instrument, read again and again; one that fails is tried for ever.

    Parameters
    ----------
    instrument : BenchInstrument
        What to open.
    interval : float
        Time from one reading to the next, s.

    Attributes
    ----------
    answer : Answer or None
        What it said when it last came up.
    error : str
        Why there is no reading now; empty while all is well.
    """

    def __init__(self, instrument: BenchInstrument, interval: float) -> None:
        self.instrument = instrument
        self.name = instrument.name
        self.interval = interval
        self.answer: Answer | None = None
        self.error = "has not answered yet"
        self._driver: Any = None
        self._reading: Reading | None = None
        self._stop = threading.Event()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._work, name=f"errormotion-monitor-{self.name}", daemon=True)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the sensors of a thermometer, known before it is opened."""
        return tuple(self._unopened().channels)

    @property
    def places(self) -> dict[str, tuple[float, float, float] | None]:
        """Places of the sensors of a thermometer on the machine, m; None where not known."""
        found = getattr(self._unopened(), "places", {})
        return {name: found.get(name) for name in self.channels}

    def _unopened(self) -> Any:
        return self.instrument.driver(self.instrument.address, self.instrument.settings)

    def start(self) -> None:
        """Begin to listen."""
        self._thread.start()

    def wait(self, timeout: float) -> None:
        """Wait for the first answer, be it a reading or a refusal."""
        self._ready.wait(timeout)

    def stop(self) -> None:
        """Ask the thread to end; `join` waits for it."""
        self._stop.set()

    def join(self) -> None:
        """Wait until the instrument is closed."""
        self._thread.join()

    def fresh(self, oldest: float) -> Reading | None:
        """Return the last reading if it is not older than a time of ``time.monotonic()``."""
        reading = self._reading
        return reading if reading is not None and reading.at >= oldest else None

    def _work(self) -> None:
        wait, failed = FIRST_WAIT, 0
        try:
            while not self._stop.is_set():
                began = time.monotonic()
                try:
                    self._open()
                    values = dict(self._driver.read())
                    self._reading = Reading(time.monotonic(), values, _flags(self._driver, values))
                except Exception as error:  # noqa: BLE001 - told to the person at the machine, and tried again
                    failed += 1
                    self._note(f"{type(error).__name__}: {error}")
                    if self._driver is None or failed >= PATIENCE:
                        self._close()
                        self._ready.set()
                        self._stop.wait(wait)
                        wait = min(2 * wait, LONGEST_WAIT)
                        continue
                else:
                    wait, failed = FIRST_WAIT, 0
                    self._note("")
                self._ready.set()
                self._stop.wait(max(0.0, began + self.interval - time.monotonic()))
        finally:
            self._close()

    def _open(self) -> None:
        if self._driver is not None:
            return
        driver = self._unopened()
        try:
            driver.open()
            identity = driver.identify()
        except BaseException:
            driver.close()
            raise
        self.answer, self._driver = Answer(self.instrument, driver, identity), driver

    def _close(self) -> None:
        driver, self._driver = self._driver, None
        if driver is not None:
            try:
                driver.close()
            except Exception:
                log.exception("instrument %s did not close", self.name)

    def _note(self, error: str) -> None:
        """Keep why there is no reading, and log each change once."""
        if bool(error) != bool(self.error) or self._reading is None:
            if error:
                log.warning("%s is silent: %s", self.name, error)
            else:
                log.info("%s answers", self.name)
        self.error = error


def _flags(driver: Any, values: Mapping[str, Any]) -> dict[str, str]:
    """Return why values are unknown, by name; what the driver does not say is told as 'unknown'."""
    said = getattr(driver, "flags", {})
    return {
        name: said.get(name) or "unknown"
        for name, value in values.items()
        if isinstance(value, float) and math.isnan(value)
    }
