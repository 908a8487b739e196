"""Checks of what a driver offers beyond readings: the members of its kind, and the requests that a device refuses."""
# ruff: noqa: D401 - the docstring of a check is its requirement

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator
from typing import Any

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.plugins import InstrumentSubject, kind_registry
from errormotion.testing.kit import require
from errormotion.testing.sessions import numbers

REFUSALS = ("refuse", "refused", "exception")
"""Names of faults of simulators that refuse requests."""
AT: tuple[int, ...] = (3, 6, 12, 20, 30, 45, 70, 110)
"""Candidates for the number of the first refused answer; the first one after opening is used."""
READINGS = 150
"""Largest number of readings up to the refused one."""
_ELSEWHERE = ("info", "Settings", "identify", "open", "close", "read", "stream", "configure")
"""Members that other checks use."""


def no_members(subject: InstrumentSubject) -> str:
    """Return why the check of the members does not apply; empty if it applies."""
    if not kind_registry.kind(subject.plugin.info.kind):
        return f"no kind '{subject.plugin.info.kind}' is registered"
    return "" if _usable(subject) else "its kind has no further members that need no argument"


def members(subject: InstrumentSubject) -> str:
    """Attributes of the kind, and its methods without arguments that change no machine, can be used after a reading."""
    names = _usable(subject)
    with subject.build() as instrument:
        instrument.read()
        for name in names:
            _use(instrument, name, "after a reading")
    for name in names:
        try:
            _use(instrument, name, "after close")
        except InstrumentError:
            continue
    return ", ".join(names)


def _usable(subject: InstrumentSubject) -> list[str]:
    """Return the members of the kind that the driver has, that need no argument and change no machine."""
    driver = subject.build()
    changing = kind_registry.changes_machine(driver)
    found = []
    for name, method in kind_registry.members_of(driver, kind_registry.kind(subject.plugin.info.kind)).items():
        if name in _ELSEWHERE or name in changing:
            continue
        parameters = list(inspect.signature(method).parameters.values())[1:] if method else []
        if all(each.default is not each.empty for each in parameters):
            found.append(name)
    return found


def _use(instrument: Any, name: str, when: str) -> None:
    try:
        value = getattr(instrument, name)
        if callable(value):
            value = value()
            if isinstance(value, Iterator):
                next(value, None)
                getattr(value, "close", lambda: None)()
    except InstrumentError as error:
        if when == "after close":
            raise
        require(False, f"'{name}' {when}: {type(error).__name__}: {error}")
    except Exception as error:  # noqa: BLE001 - named in the verdict
        require(
            False, f"'{name}' {when}: expected a value or an InstrumentError, found {type(error).__name__}: {error}"
        )


def no_refusals(subject: InstrumentSubject) -> str:
    """Return why the check of refused requests does not apply; empty if it applies."""
    return "" if _refusal(subject) else f"the simulator has none of the faults {', '.join(REFUSALS)}"


def refusals(subject: InstrumentSubject) -> str:
    """A refused request is an InstrumentError with the reason of the device, or NaN: no timeout, no invalid answer."""
    fault = _refusal(subject)
    for first in AT:
        instrument = subject.build(fault=f"{fault}&fault_at={first}")
        try:
            try:
                instrument.open()
            except InstrumentError as error:
                _require_refusal(error, "open()")
                continue
            return _refused_reading(instrument)
        finally:
            instrument.close()
    require(False, f"opening needs more than {AT[-1]} answers, so that no refused reading was examined")
    return ""


def _refused_reading(instrument: Any) -> str:
    for count in range(READINGS):
        try:
            reading = numbers(instrument.read())
        except Exception as error:  # noqa: BLE001 - judged
            _require_refusal(error, "read()")
            return f"after {count} readings: {error}"[:200]
        if any(map(math.isnan, reading)):
            return f"after {count} readings: NaN"
    require(False, f"{READINGS} readings, and none was refused; expected an InstrumentError or NaN")
    return ""


def _require_refusal(error: Exception, what: str) -> None:
    found = f"{type(error).__name__}: {error}"
    require(isinstance(error, InstrumentError), f"{what}: expected an InstrumentError, found {found}")
    wrong = isinstance(error, InstrumentTimeoutError | ProtocolError)
    require(not wrong, f"{what}: the device has refused, which is an answer; found {found}")
    require(bool(str(error).strip()), f"{what}: the error has no text; expected the reason of the device")


def _refusal(subject: InstrumentSubject) -> str:
    return next((name for name in REFUSALS if name in subject.menu), "")
