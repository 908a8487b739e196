"""Checks of the communication of a driver: late answers, the time limit, the baud rate."""
# ruff: noqa: D401 - the docstring of a check is its requirement

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments.simulators.device import DEFAULT_MACHINE
from errormotion.instruments.simulators.virtual_world.world import let_time_pass
from errormotion.instruments.transports import parse_address
from errormotion.instruments.transports.loopback.serving import PtyServer, Server, make_server
from errormotion.plugins import InstrumentSubject
from errormotion.testing.kit import require
from errormotion.testing.sessions import numbers

LATE = "late"
LATE_ANSWERS: tuple[int, ...] = (12, 20, 30, 45, 70, 110)
"""Candidates for the number of the late answer; the first one after opening is used."""
READINGS = 24
READINGS_AFTER_ERROR = 4
MAX_FAILURES = 12
PAUSE = 0.1
"""After a failed reading, s."""
TIME_BETWEEN_READINGS = 120.0
"""Simulated time, s."""
QUICK, SLOW = 0.2, 1.3
"""Tried time limits, s; the default of a transport is between them."""
SPEEDS = (19200, 57600, 115200, 230400, 2000000)
TCP_FORMS = ("tcp://{}", "modbus+tcp://{}?unit=1", "http://{}/")
SERIAL_FORMS = ("serial://{}", "modbus+rtu://{}?unit=1")


def no_late_answers(subject: InstrumentSubject) -> str:
    """Return why the check of late answers does not apply; empty if it applies."""
    return "" if LATE in subject.menu else f"the simulator has no fault '{LATE}'"


def no_time_limit(subject: InstrumentSubject) -> str:
    """Return why the check of the time limit does not apply; empty if it applies."""
    return _no_setting(subject, "timeout")


def no_baudrate(subject: InstrumentSubject) -> str:
    """Return why the check of the baud rate does not apply; empty if it applies."""
    return _no_setting(subject, "baudrate")


def _no_setting(subject: InstrumentSubject, name: str) -> str:
    if name not in subject.plugin.Settings.model_fields:
        return f"the settings have no '{name}'"
    if subject.make is not None or not subject.simulated:
        return "it needs a single simulated device"
    return ""


def late_answers(subject: InstrumentSubject) -> str:
    """After a late answer, the next reading is correct or a typed error, and is not the late answer."""
    if not _no_setting(subject, "timeout"):
        subject = _with_settings(subject, timeout=1.5 * QUICK)
        limit = 1.5 * QUICK
    else:
        limit = 1.0
    sound = _readings(subject, "")
    seen, candidates = [], LATE_ANSWERS
    for when, how in ((f"&late_by={1.5 * limit:g}", "half a time limit late"), ("", "late until the next answer")):
        late, candidates = _late_readings(subject, when, candidates)
        seen.append(_require_in_step(sound, late, how, repeats=subject.repeats))
    return "; ".join(seen)


Reading = tuple[float, ...] | Exception


def _late_readings(
    subject: InstrumentSubject, when: str, candidates: tuple[int, ...]
) -> tuple[list[Reading], tuple[int, ...]]:
    """Return readings with a late answer after the instrument was opened, and the candidates from this answer on."""
    found: list[Reading] = []
    for k, number in enumerate(candidates):
        found = _readings(subject, f"{LATE}&fault_at={number}{when}")
        if not isinstance(found[0], Exception):
            return found, candidates[k:]
    return found, candidates[-1:]


def _readings(subject: InstrumentSubject, fault: str) -> list[Reading]:
    """Return readings or their errors: some without an error, or some correct ones after the first error."""
    found: list[Reading] = []
    instrument = subject.build(fault=fault)
    try:
        instrument.open()
        right, failures = 0, 0
        while failures <= MAX_FAILURES and right < (READINGS_AFTER_ERROR if failures else READINGS):
            _vary(subject, len(found))
            try:
                found.append(tuple(numbers(instrument.read())))
                right += 1
            except Exception as error:  # noqa: BLE001 - judged below
                found.append(error)
                right, failures = 0, failures + 1
                time.sleep(PAUSE)  # some drivers wait before they reconnect
    except Exception as error:  # noqa: BLE001 - the answer was late while it was opened
        found.append(error)
    finally:
        with suppress(InstrumentError):
            instrument.close()
    return found


def _vary(subject: InstrumentSubject, number: int) -> None:
    """Change the next reading, so that a confusion of answers can be detected."""
    if subject.vary is not None:
        subject.vary(number)
    elif subject.simulated:
        address = parse_address(subject.address)
        machine, seed = address.host or DEFAULT_MACHINE, int(address.number("seed", 0))
        let_time_pass(machine, seed, TIME_BETWEEN_READINGS, warm=bool(address.number("warm", 1)))


def _require_in_step(sound: list[Reading], late: list[Reading], how: str, *, repeats: bool) -> str:
    errors = [reading for reading in late if isinstance(reading, Exception)]
    for error in errors:
        require(isinstance(error, InstrumentError), f"{how}: expected an InstrumentError, found {error!r}")
    if not errors:
        return f"{how}: no error"
    first = late.index(errors[0])
    after = [reading for reading in late[first:] if not isinstance(reading, Exception)]
    seen = f"{how}: {type(errors[0]).__name__}, then {len(after)}"
    if repeats:
        return f"{seen} readings; the device repeats lost readings, so that their order is unknown"
    if first >= len(sound) or sum(_same(sound[first], reading) for reading in sound) != 1:
        return f"{seen} equal readings, so that their order is unknown: state 'vary' in the subject"
    require(
        not any(_same(reading, sound[first]) for reading in after),
        f"{how}: a late answer was used for the next request; send requests within 'with self.exchange() as line:'",
    )
    return f"{seen} correct readings"


def _same(reading: Reading, other: Reading) -> bool:
    if isinstance(reading, Exception) or isinstance(other, Exception):
        return False
    return len(reading) == len(other) and bool(np.array_equal(np.array(reading), np.array(other), equal_nan=True))


def time_limit(subject: InstrumentSubject) -> str:
    """Without an answer, an error is raised after the ``timeout`` of the settings, neither earlier nor much later."""
    for wire, forms in (("tcp", TCP_FORMS), ("pty", SERIAL_FORMS)):
        for form in forms:
            if _seconds_to_timeout(subject, wire, form, QUICK) is None:
                continue
            slow = _seconds_to_timeout(subject, wire, form, SLOW)
            require(
                slow is None or slow >= 0.95 * SLOW,
                f"timeout = {SLOW} s: error after {slow or 0:.2f} s; pass the setting to the transport",
            )
            most = 1.0 + 5 * QUICK
            quick = min(_seconds_to_timeout(subject, wire, form, QUICK) or 0.0 for _ in range(2))
            require(quick <= most, f"timeout = {QUICK} s: error after {quick:.2f} s, expected at most {most:g} s")
            return f"{form.partition(':')[0]}: {quick:.2f} s for {QUICK} s, {slow or 0:.2f} s for {SLOW} s"
    return "it opens without an answer of the device"


def _seconds_to_timeout(subject: InstrumentSubject, wire: str, form: str, limit: float) -> float | None:
    """Return the time until the error if the device does not answer, s; None for other errors."""
    with _silent(wire) as server:
        subject = _with_settings(subject, timeout=limit)
        instrument = subject.build(address=form.format(_place(server)))
        start = time.monotonic()
        try:
            instrument.open()
        except InstrumentTimeoutError:
            return time.monotonic() - start
        except InstrumentError:
            return None
        finally:
            with suppress(InstrumentError):
                instrument.close()
    return None


def baudrate(subject: InstrumentSubject) -> str:
    """The serial line has the ``baudrate`` of the settings."""
    default = subject.plugin.Settings.model_fields["baudrate"].default
    limit = {} if _no_setting(subject, "timeout") else {"timeout": QUICK}
    for form in SERIAL_FORMS:
        for speed in SPEEDS:
            if speed == default:
                continue
            with _silent("pty") as server:
                try:
                    instrument = _with_settings(subject, baudrate=speed, **limit).build(
                        address=form.format(_place(server))
                    )
                except ValueError:  # the instrument does not support this rate
                    continue
                with suppress(InstrumentError):
                    instrument.open()
                with suppress(InstrumentError):
                    instrument.close()
                found = server.baudrate if isinstance(server, PtyServer) else 0
            if found:
                require(found == speed, f"expected a line with {speed} baud as in the settings, found {found}")
                return f"{speed} baud"
    return "it has no serial line"


@contextmanager
def _silent(wire: str) -> Iterator[Server]:
    """A device that accepts a connection and never answers."""
    server = make_server(wire, "silent", lambda _: None)
    server.start()
    try:
        yield server
    finally:
        server.close()


def _place(server: Server) -> str:
    return server.url.partition("://")[2]


def _with_settings(subject: InstrumentSubject, **settings: Any) -> InstrumentSubject:
    given: Mapping[str, Any] = {**subject.settings, **settings}
    return replace(subject, settings=given)
