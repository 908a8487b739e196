"""One short session: open, identify, read, stream for some seconds, close; live, or repeated from its recording."""

from __future__ import annotations

import hashlib
import inspect
import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ReplayError
from errormotion.instruments.transports.recording import EndOfRecordingError

FIRST_READINGS = 3
MAX_READINGS = 1000
INTERVAL = 0.2
"""Interval between two readings of an instrument without a stream, s."""
SHOWN = 8
"""Number of values at the start of a reading that are stored."""


@dataclass(frozen=True)
class Summary:
    """Summary of what was read; ``sha256`` is the hash of all values as float64.

    Attributes
    ----------
    count : int
        Number of readings, or of blocks of a stream.
    values : int
        Number of all values.
    unknown : int
        Number of NaN among them.
    dropped : int
        Lost samples of a stream.
    first, last : tuple of float or None
        Start of the first and of the last reading or block; None for NaN and infinite values.
    sha256 : str
    """

    count: int = 0
    values: int = 0
    unknown: int = 0
    dropped: int = 0
    first: tuple[float | None, ...] = ()
    last: tuple[float | None, ...] = ()
    sha256: str = ""


@dataclass
class Session:
    """Result of a session.

    Attributes
    ----------
    identity : dict
        Identity of the instrument; empty before the instrument has reported it.
    readings, stream : Summary
    step : str
        Step in which an error ended the session: open, identify, readings, stream or close; empty without an error.
    error : str
        Class of the error.
    message : str
        Message of the error.
    ended : bool
        Whether the error is the end of a recording.
    """

    identity: dict[str, Any] = field(default_factory=dict)
    readings: Summary = field(default_factory=Summary)
    stream: Summary = field(default_factory=Summary)
    step: str = ""
    error: str = ""
    message: str = ""
    ended: bool = False

    def record(self) -> dict[str, Any]:
        """Return the session as an object for JSON."""
        found = asdict(self)
        del found["ended"]
        return found


class _Counter:
    """Accumulates the summary of readings or blocks."""

    def __init__(self) -> None:
        self._hash, self._count, self._values, self._unknown, self._dropped = hashlib.sha256(), 0, 0, 0, 0
        self._first: tuple[float | None, ...] = ()
        self._last: tuple[float | None, ...] = ()

    def add(self, reading: Any) -> None:
        values = np.array(list(_numbers(reading)), dtype=np.float64)
        self._hash.update(np.where(np.isnan(values), np.nan, values).astype("<f8").tobytes())
        self._last = tuple(float(x) if math.isfinite(x) else None for x in values[:SHOWN])
        self._first = self._first if self._count else self._last
        self._count, self._values = self._count + 1, self._values + values.size
        self._unknown += int(np.isnan(values).sum())
        self._dropped += int(getattr(reading, "dropped", 0))

    @property
    def summary(self) -> Summary:
        sha256 = self._hash.hexdigest()
        return Summary(self._count, self._values, self._unknown, self._dropped, self._first, self._last, sha256)


def run_live(driver: Any, seconds: float, full: Callable[[], bool], identified: Callable[[], None]) -> Session:
    """Run a session of about ``seconds`` s; it ends earlier when ``full()`` is true.

    ``identified()`` is called when the instrument has reported its identity.

    An instrument without a stream is read repeatedly, at most `MAX_READINGS` times.
    """
    streams, start = _streams(driver), math.nan

    def more() -> bool:
        return time.monotonic() < start + seconds and not full()

    def readings(count: int) -> bool:
        nonlocal start
        if not count:
            start = time.monotonic()  # now the device is open, which may take minutes
        if count < FIRST_READINGS:
            return True
        if streams or count >= MAX_READINGS or not more():
            return False
        time.sleep(INTERVAL)
        return True

    def blocks(count: int) -> bool:
        return streams and (count < 1 or more())

    return _run(driver, readings, blocks, identified)


def repeat(driver: Any, session: Mapping[str, Any]) -> Session:
    """Repeat the session that a note describes.

    Raises
    ------
    ReplayError
        The note does not describe a session.
    """
    try:
        readings, blocks = int(session["readings"]["count"]), int(session["stream"]["count"])
        step = str(session["step"])
    except (KeyError, TypeError, ValueError, OverflowError):
        raise ReplayError(
            "The note of the recording describes no session; record it again", code="recording.note.form"
        ) from None
    readings += step == "readings"
    blocks += step == "stream"
    return _run(driver, lambda count: count < readings, lambda count: count < blocks, lambda: None)


def differences(recorded: Mapping[str, Any], again: Session) -> list[str]:
    """Return the differences between a repeated session and the recorded one, one sentence for each; empty: none."""
    texts: list[str] = []
    if again.step != recorded.get("step") or not _same_error(recorded, again):
        before = f"{recorded.get('error')} in the step '{recorded.get('step')}'" if recorded.get("step") else "no error"
        now = f"{again.error} in the step '{again.step}': {again.message}" if again.step else "no error"
        texts.append(f"expected {before}; found {now}")
    identity, identity_again = (_core(each) for each in (recorded.get("identity"), again.identity))
    if identity != identity_again:
        texts.append(f"expected the identity {identity}; found {identity_again}")
    for name, summary in (("readings", again.readings), ("stream", again.stream)):
        before_, now_ = recorded.get(name), _as_json(summary)
        if before_ != now_:
            texts.append(f"the {name} differ: expected {before_}; found {now_}")
    return texts


def _core(identity: Any) -> dict[str, Any]:
    """Return an identity without details, such as its address."""
    return {k: v for k, v in identity.items() if k != "details"} if isinstance(identity, Mapping) else {}


def _as_json(summary: Summary) -> dict[str, Any]:
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(summary).items()}


def _same_error(recorded: Mapping[str, Any], again: Session) -> bool:
    """Whether both ended alike; after a timeout, a replay ends in the same step, but later frames arrive at once."""
    timed_out = recorded.get("error") == InstrumentTimeoutError.__name__
    return recorded.get("error") == again.error or (timed_out and (again.ended or again.error != ReplayError.__name__))


def _run(
    driver: Any, readings: Callable[[int], bool], blocks: Callable[[int], bool], identified: Callable[[], None]
) -> Session:
    session, read, streamed = Session(), _Counter(), _Counter()
    step, count = "open", 0
    try:
        driver.open()
        step = "identify"
        session.identity = _plain(asdict(driver.identify()))
        identified()
        step = "readings"
        while readings(count):
            read.add(driver.read())
            count += 1
        step, count = "stream", 0
        if blocks(count):
            stream = driver.stream()
            try:
                while blocks(count):
                    streamed.add(next(stream))
                    count += 1
            finally:
                if hasattr(stream, "close"):
                    stream.close()
        step = "close"
        driver.close()
    except InstrumentError as error:
        session.step, session.error, session.message = step, type(error).__name__, str(error)
        session.ended = isinstance(error, EndOfRecordingError)
        with suppress(InstrumentError):
            driver.close()
    except BaseException:
        with suppress(InstrumentError):
            driver.close()
        raise
    session.readings, session.stream = read.summary, streamed.summary
    return session


def _streams(driver: Any) -> bool:
    """Whether the driver has a stream that needs no arguments."""
    if not hasattr(driver, "stream"):
        return False
    parameters = inspect.signature(driver.stream).parameters.values()
    free = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return all(each.default is not inspect.Parameter.empty or each.kind in free for each in parameters)


def _numbers(reading: Any) -> Iterator[float]:
    """Yield all numbers of a reading, in order; None counts as NaN, text is omitted."""
    if isinstance(reading, Mapping):
        for value in reading.values():
            yield from _numbers(value)
    elif isinstance(reading, np.ndarray):
        yield from np.asarray(reading, dtype=np.float64).ravel().tolist()
    elif isinstance(reading, list | tuple):
        for value in reading:
            yield from _numbers(value)
    elif hasattr(reading, "values") and isinstance(reading.values, np.ndarray):
        yield from _numbers(reading.values)
    elif reading is None:
        yield math.nan
    elif isinstance(reading, int | float | np.number):
        yield float(reading)


def _plain(value: Any) -> Any:
    """Return a value of an identity as an object for JSON."""
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | bool | None) else str(value)
