"""Sessions of every instrument driver behind a wire that disturbs them once: right readings, or one typed error.

A trial compares every number that the driver returns with those of a session without a disturbance, which the
simulators repeat exactly. Afterwards the wire is calm, and the driver must be closed, opened again and read.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import islice
from typing import Any

import numpy as np
import wire_proxy
from wire_proxy import DOWN, HARMLESS, KINDS, UP, Fault

from errormotion import plugins
from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.plugins import InstrumentSubject
from errormotion.plugins.subjects import with_query
from errormotion.testing.run import subjects_of
from errormotion.testing.sessions import numbers

WITHOUT_WIRE = {
    "can_temperature": "a bus of frames with checksums",
    "controller_probe": "moves a controller",
    "dprnt": "prints while a program runs; tests/instruments/test_dprnt.py loses, repeats and exchanges its lines",
    "linuxcnc": "a process of its own, and one on a computer; its lines are those of the virtual controller",
    "profile_files": "files",
    "tracker_table": "files",
}
"""Instruments that are not tried, and why."""
AHEAD = ("capancdt", "confocaldt", "leica_emscon", "optoncdt", "keyence_ljx", "five_sensor_frame")
"""Their devices measure ahead of what is read, so that readings after a stream are of another instant each time: they
are compared within twice the range of the true ones. So are samples, where the stream started at another instant."""
CORRUPT, EXCHANGE = "corrupt", "exchange"
DAMAGE = (CORRUPT, EXCHANGE)
"""Only a checksum finds changed bytes within a number."""
READINGS, BLOCKS = 4, 2
TRUE_READINGS = 12
"""Readings of the session without a disturbance: a driver that repeats a request gets later ones."""
TIMEOUT = 0.8
"""Setting of an instrument that has one, s: less than `wire_proxy.LATE`."""
LONGEST = 20.0
"""Of one call of the driver, s: a total station is given 15 s for a measurement."""
REACHED = 0.7
"""The number of pieces varies where a device sends without requests: a fault is in so much of it."""
REPEATS = 2
UNDISTURBED = 10
"""Repetitions of a session that was not disturbed and missed a time limit."""
PAUSE, ATTEMPTS = 0.2, 3
"""Before a device is opened again, s, and how often this is tried: it may need a moment to see that it was left."""


@dataclass(frozen=True)
class Case:
    """An instrument on a wire.

    Attributes
    ----------
    plugin : str
    wire : str
        "tcp" or "pty".
    settings : tuple of (str, value)
        Beyond those of the kit.
    checked : tuple of str
        Kinds of damage that the protocol's checksum finds: after them no value may be wrong.
    """

    plugin: str
    wire: str = "tcp"
    settings: tuple[tuple[str, Any], ...] = ()
    checked: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name in tables and tests."""
        return ", ".join([self.plugin, self.wire, *(name for name, _ in self.settings)])


@dataclass
class Outcome:
    """What came of a trial.

    Attributes
    ----------
    end : str
        "right", "counted" (samples that are lost are NaN and counted), "unknown" (values of a reading are NaN),
        "refused" (one typed error), or "not reached".
    error : str
        Class of the typed error.
    fault : str
        What is not allowed; empty for nothing.
    undetected : str
        A wrong value of a protocol that has no checksum against this damage; empty for none.
    what : str
        What the wire did.
    """

    end: str = "right"
    error: str = ""
    fault: str = ""
    undetected: str = ""
    what: str = ""


@dataclass
class Truth:
    """A session without a disturbance: readings, samples by their number, and the pieces of each direction."""

    readings: list[tuple[float, ...]] = field(default_factory=list)
    samples: dict[int, tuple[float, ...]] = field(default_factory=dict)
    pieces: dict[str, int] = field(default_factory=dict)
    repeated: bool = False
    tolerance: float = 0.0


def cases() -> list[Case]:
    """Return the built-in instruments that have a wire."""
    ours = [each for each in plugins.available("instruments") if each.distribution.startswith("errormotion ")]
    return [*(Case(each.id) for each in ours if each.id not in WITHOUT_WIRE), *SERIAL]


SERIAL = (
    Case("dcon_temperature", "pty"),
    Case("dcon_temperature", "pty", (("checksum", True),), (CORRUPT,)),
    Case("keyence_lk", "pty"),
    Case("modbus_temperature", "pty", (), (CORRUPT, EXCHANGE)),
    Case("optoncdt", "pty", (("rate", 2500.0),)),
    Case("scpi_temperature", "pty"),
)


def subject_of(case: Case) -> InstrumentSubject:
    """Return what the kit examines, with a short time limit."""
    subject = subjects_of("instruments", case.plugin)[0]
    assert isinstance(subject, InstrumentSubject)
    if subject.make is None:
        short = {"timeout": TIMEOUT} if "timeout" in subject.plugin.Settings.model_fields else {}
        subject = replace(subject, settings={**subject.settings, **short, **dict(case.settings)})
    query = (["wire=pty"] if case.wire == "pty" else []) + (["checksum=1"] if "checksum" in dict(case.settings) else [])
    return replace(subject, address=with_query(subject.address, "&".join(query))) if query else subject


@cache
def truth(case: Case) -> Truth:
    """Return the session without a disturbance; on a busy computer it may miss a time limit, and is repeated."""
    for _ in range(UNDISTURBED):
        with suppress(InstrumentTimeoutError):
            return _undisturbed(case)
        time.sleep(PAUSE)
    return _undisturbed(case)


def _undisturbed(case: Case) -> Truth:
    found, subject = Truth(), subject_of(case)
    with wire_proxy.behind(Fault()) as line, subject.build() as instrument:
        session(instrument, subject, found)
        found.pieces = dict(line.pieces)
        while len(found.readings) < TRUE_READINGS:
            found.readings.append(tuple(numbers(instrument.read())))
    if case.plugin in AHEAD:
        values = [value for row in (*found.readings, *found.samples.values()) for value in row]
        found.tolerance = 2.0 * float(np.nanmax(values) - np.nanmin(values))
    found.repeated = found.tolerance > 0 or len(set(map(repr, found.readings))) == 1
    return found


def session(instrument: Any, subject: InstrumentSubject, found: Truth) -> list[float]:
    """Go through a session; return the duration of each call, s."""
    took: list[float] = []
    start = time.monotonic()

    def mark() -> None:
        nonlocal start
        took.append(time.monotonic() - start)
        start = time.monotonic()

    instrument.identify()
    mark()
    if subject.streams:
        stream = iter(instrument.stream())
        try:
            for block in islice(stream, BLOCKS):
                for number, column in enumerate(block.values.T, block.first):
                    found.samples[number] = tuple(column)
                mark()
        finally:
            with suppress(AttributeError):
                stream.close()
    for _ in range(READINGS):
        found.readings.append(tuple(numbers(instrument.read())))
        mark()
    return took


def trial(case: Case, fault: Fault) -> Outcome:
    """Disturb one session, and open the instrument again.

    Where all bytes came in time and the session failed nevertheless, as on a computer that is busy, it is repeated.
    """
    for _ in range(REPEATS if fault.kind in HARMLESS else 0):
        if not (found := _trial(case, fault)).fault:
            return found
    return _trial(case, fault)


def _trial(case: Case, fault: Fault) -> Outcome:
    right, subject, outcome = truth(case), subject_of(case), Outcome()
    with wire_proxy.behind(fault) as line:
        instrument, found, start = subject.build(), Truth(), time.monotonic()
        try:
            instrument.open()
            opened = time.monotonic() - start
            longest = max([opened, *session(instrument, subject, found)])
            if longest > LONGEST:
                outcome.fault = f"a call took {longest:.1f} s"
        except InstrumentError as error:
            outcome.end, outcome.error = "refused", type(error).__name__
            if time.monotonic() - start > LONGEST:
                outcome.fault = f"{outcome.error} after {time.monotonic() - start:.1f} s"
        except Exception as error:  # noqa: BLE001 - the finding
            outcome.fault = f"{type(error).__name__}: {str(error)[:200]}"
        outcome.what = line.what
        reached = line.done
        line.calm()
        wrong = _wrong(found, right, repeats=subject.repeats or right.repeated)
        if fault.kind in DAMAGE and fault.kind not in case.checked:
            outcome.undetected = wrong
        else:
            outcome.fault = outcome.fault or wrong
        _count(found, right, outcome)
        if not reached:
            outcome.end = "not reached"
        elif fault.kind in HARMLESS and outcome.end != "right":
            outcome.fault = outcome.fault or f"{outcome.end} {outcome.error}, where all bytes came in time"
        outcome.fault = outcome.fault or _again(instrument, right)
        with suppress(InstrumentError):
            instrument.close()
    return outcome


def _again(instrument: Any, right: Truth) -> str:
    """Close, open and read; return what is wrong."""
    for attempt in range(ATTEMPTS):
        try:
            with suppress(InstrumentError):
                instrument.close()
            time.sleep(PAUSE)
            instrument.open()
            instrument.identify()
            reading = tuple(numbers(instrument.read()))
            instrument.close()
            break
        except InstrumentError as error:
            if attempt == ATTEMPTS - 1:
                return f"opened again: {type(error).__name__}: {str(error)[:200]}"
        except Exception as error:  # noqa: BLE001 - the finding
            return f"opened again: {type(error).__name__}: {str(error)[:200]}"
    return _wrong(Truth([reading]), right, repeats=True)


def _wrong(found: Truth, right: Truth, *, repeats: bool) -> str:
    """Return which value is neither right nor unknown; also a reading that is older than the one before it."""
    last = -1
    for reading in found.readings:
        places = [k for k, true in enumerate(right.readings) if _same(reading, true, right.tolerance)]
        if not places and any(_same(reading, true, right.tolerance) for true in right.samples.values()):
            continue  # of a stream that was requested reading by reading
        if not places:
            nearest = min(right.readings, key=lambda true: sum(a != b for a, b in zip(reading, true, strict=False)))
            pairs = [(a, b) for a, b in zip(reading, nearest, strict=False) if not _equal(a, b)]
            return f"wrong: {len(pairs)} of {len(reading)} values, such as {pairs[0] if pairs else len(nearest)}"
        later = [k for k in places if k > last]
        if not later and not repeats:
            return f"wrong: reading {places[-1]} again, after reading {last}"
        last = later[0] if later else last
    return _wrong_samples(found.samples, right)


def _wrong_samples(found: dict[int, tuple[float, ...]], right: Truth) -> str:
    """Return which sample is wrong, where the stream may have started at a later one."""
    if not found:
        return ""
    true = np.array([right.samples[number] for number in sorted(right.samples)])
    values = np.array([found[number] for number in sorted(found)])
    known = np.flatnonzero(~np.isnan(values).any(axis=1))
    if not known.size:
        return ""
    for start in np.flatnonzero((true == values[known[0]]).all(axis=1)) - known[0]:
        if start >= 0:
            part = values[: len(true) - start]
            same = (part == true[start : start + len(part)]) | np.isnan(part)
            if same.all():
                return ""
    low, high = np.nanmin(true, axis=0) - right.tolerance, np.nanmax(true, axis=0) + right.tolerance
    if right.tolerance and ((values >= low) & (values <= high) | np.isnan(values)).all():
        return ""
    n = min(len(values), len(true))
    differ = np.argwhere(~((values[:n] == true[:n]) | np.isnan(values[:n])))
    if not len(differ):
        return "wrong: samples of no place"
    row, column = differ[0]
    return f"wrong: {len(differ)} samples, such as number {row}: {values[row, column]} for {true[row, column]}"


def _same(reading: Sequence[float], true: Sequence[float], tolerance: float = 0.0) -> bool:
    return len(reading) == len(true) and all(_equal(a, b, tolerance) for a, b in zip(reading, true, strict=True))


def _equal(value: float, true: float, tolerance: float = 0.0) -> bool:
    return bool(np.isnan(value)) or abs(value - true) <= tolerance


def _count(found: Truth, right: Truth, outcome: Outcome) -> None:
    def unknown(rows: Any) -> int:
        return sum(int(np.isnan(row).sum()) for row in rows)

    if outcome.end != "right":
        return
    if unknown(found.samples.values()) > unknown([right.samples[k] for k in found.samples if k in right.samples]):
        outcome.end = "counted"
    elif unknown(found.readings) > unknown(right.readings[: len(found.readings)]):
        outcome.end = "unknown"


def faults(case: Case, kind: str, number: int, seed: int) -> list[Fault]:
    """Return faults of a kind, spread over the pieces of a session in both directions."""
    pieces, found = truth(case).pieces, []
    for k in range(number):
        rng = np.random.default_rng([seed, k, *case.name.encode(), *kind.encode()])
        way = (DOWN, UP)[int(rng.random() < 0.3)] if pieces[UP] else DOWN
        found.append(
            Fault(kind, way, int(rng.integers(max(1, int(REACHED * pieces[way])))), int(rng.integers(1 << 31)))
        )
    return found


__all__ = ["KINDS", "Case", "Outcome", "cases", "faults", "trial", "truth"]
