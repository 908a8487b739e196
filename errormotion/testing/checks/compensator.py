"""Checks of compensator plugins, with a simulated machine for their offsets."""
# ruff: noqa: D401 - the docstring of a check is its requirement

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Callable
from contextlib import closing, suppress
from typing import Any

from errormotion.errors import InstrumentError
from errormotion.plugins import Applied, Compensator, CompensatorSubject, InstrumentInfo, kind_registry
from errormotion.testing.checks import fuzz as fuzz_checks
from errormotion.testing.checks import shared
from errormotion.testing.compensator_sessions import (
    POLL,
    armed,
    as_instrument,
    follow,
    made,
    near,
    require_offset,
    require_ramp,
    started,
    um,
    wait_for,
    write,
)
from errormotion.testing.kit import Checks, require
from errormotion.testing.sessions import open_things

COMPENSATOR_CHECKS: Checks[CompensatorSubject] = Checks()

CYCLES = 12
"""Cycles of reading and writing within which a fault must be detected."""
PAUSE = 0.05
"""After a failed cycle, s."""


def _no_machine(subject: CompensatorSubject) -> str:
    return "" if subject.simulated else "nothing is written to a real machine"


def _no_recording(subject: CompensatorSubject) -> str:
    if not subject.mutants:
        return "the subject states no mutants"
    recorded = "record" in inspect.signature(subject.plugin).parameters
    return _no_machine(subject) or ("" if recorded else "the compensator records no sessions")


def _mutants_limit(subject: CompensatorSubject) -> float:
    return fuzz_checks.LIMIT if subject.mutants <= fuzz_checks.MUTANTS else math.inf


def _no_faults(subject: CompensatorSubject) -> str:
    return "" if subject.menu else "the simulated machine has no faults"


def _no_lost_connection(subject: CompensatorSubject) -> str:
    return "" if subject.lost_fault in subject.menu else f"the simulated machine has no fault '{subject.lost_fault}'"


def _no_states(subject: CompensatorSubject) -> str:
    return _no_machine(subject) or ("" if subject.states else "the compensator reports no states")


@COMPENSATOR_CHECKS.add()
def info_complete(subject: CompensatorSubject) -> str:
    """Class attribute `info` states id, the kind "compensator", summary, status, version; its simulator loads."""
    info = subject.plugin.info
    shared.check_info(info, InstrumentInfo, "id")
    require(info.kind == "compensator", f"info.kind: expected 'compensator', found {info.kind!r}")
    return f"{info.id}, {info.status}"


@COMPENSATOR_CHECKS.add()
def members(subject: CompensatorSubject) -> str:
    """The class has all members of the contract, and each accepts the arguments of the contract."""
    with started(subject) as device:
        found = kind_registry.deviations(made(subject, device), Compensator)
    require(not found, "; ".join(found))
    return f"{len(kind_registry.members(Compensator))} members"


@COMPENSATOR_CHECKS.add()
def settings_strict(subject: CompensatorSubject) -> str:
    """Settings are a PluginSettings, refuse unknown keys, and are unchanged after a round trip through JSON."""
    with started(subject) as device:
        return shared.check_settings(subject.plugin.Settings, made(subject, device).settings)


@COMPENSATOR_CHECKS.add()
def identify(subject: CompensatorSubject) -> str:
    """The compensator states manufacturer, model and serial number of the machine, the same each time."""
    with started(subject) as device, closing(made(subject, device)) as compensator:
        compensator.open()
        return shared.check_identity(compensator.identify(), compensator.identify())


@COMPENSATOR_CHECKS.add()
def open_and_close_twice(subject: CompensatorSubject) -> str:
    """Opening and closing are idempotent, closing before opening has no effect, and reopening is possible."""
    with started(subject) as device, closing(made(subject, device)) as compensator:
        compensator.close()
        for _ in range(2):
            compensator.open()
            compensator.open()
            compensator.read()
            compensator.close()
            compensator.close()
    return "opened and closed twice"


@COMPENSATOR_CHECKS.add()
def use_before_open(subject: CompensatorSubject) -> str:
    """Before opening and after closing, the compensator raises an InstrumentError."""
    with started(subject) as device, closing(made(subject, device)) as compensator:
        for when in ("before open", "after close"):
            uses: dict[str, Callable[[], Any]] = {"identify": compensator.identify, "read": compensator.read}
            if subject.simulated:
                uses["write"] = lambda: compensator.write((0.0, 0.0, 0.0))
            for name, use in uses.items():
                shared.require_refusal(use, f"{name}() {when}")
            compensator.open()
            compensator.close()
    return "refused before open and after close"


@COMPENSATOR_CHECKS.add()
def no_device(subject: CompensatorSubject) -> str:
    """Without a machine, an instance can be created, and opening it raises a typed error within the time limit."""
    with started(subject) as device:
        settings = getattr(device, "driver_settings", None)
    with closing(subject.build(subject.dead_address, settings)) as compensator:
        return shared.check_absent(compensator.open, subject.dead_address, subject.time_limit)


@COMPENSATOR_CHECKS.add()
def readings(subject: CompensatorSubject) -> str:
    """A reading is an Applied: three numbers, NaN if unknown, and two texts."""
    with started(subject) as device, closing(made(subject, device)) as compensator:
        compensator.open()
        found = [compensator.read() for _ in range(3)]
    for each in found:
        require(isinstance(each, Applied), f"expected an Applied, found {type(each).__name__}")
        three = len(each.offset) == 3 and all(isinstance(value, float) for value in each.offset)
        require(three, f"expected three floats, found {each.offset!r}")
        large = [value for value in each.offset if abs(value) > 1e-2]
        require(not large, f"expected offsets in m, found {large}")
        texts = all(isinstance(text, str) and len(text) <= 1000 for text in (each.busy, each.fault))
        require(texts, f"busy and fault: expected short texts, found {each.busy!r:.80} and {each.fault!r:.80}")
    return f"{um(found[-1].offset)}"


@COMPENSATOR_CHECKS.add(why_not=_no_machine)
def nothing_on_connecting(subject: CompensatorSubject) -> str:
    """Opening, identifying, reading, arming and closing send no command to the machine."""
    with started(subject) as device:
        with armed(subject, device) as compensator:
            compensator.identify()
            compensator.read()
        time.sleep(10 * POLL)
        orders = device.machine.orders
        require(orders == 0, f"expected no command, found {orders}")
        require(not any(device.machine.offset), f"the machine has the offset {um(device.machine.offset)}")
    return "no command"


@COMPENSATOR_CHECKS.add(why_not=_no_machine)
def arrives(subject: CompensatorSubject) -> str:
    """A written offset comes into effect on each axis with its sign, and is read back."""
    with started(subject) as device, armed(subject, device) as compensator:
        follow(subject, compensator, device)
        _reads_what_is_in_effect(subject, compensator, device, "read()")
    return um(subject.offset)


@COMPENSATOR_CHECKS.add(why_not=_no_machine)
def refused_orders(subject: CompensatorSubject) -> str:
    """Offsets that are not three finite numbers within the limit are not sent; without arming, no offset is sent."""
    beyond = 1.001 * subject.limit
    wrong: list[tuple[Any, ...]] = [(), (0.0, 0.0), (0.0,) * 4, ("a", 0.0, 0.0), (None, 0.0, 0.0)]
    for value in (math.nan, math.inf, -math.inf, beyond, -beyond, 1e300):
        wrong += [tuple(value if i == axis else 0.0 for i in range(3)) for axis in range(3)]
    with started(subject) as device, closing(made(subject, device)) as compensator:
        compensator.open()
        for limit in (0.0, -1e-6, math.nan, math.inf):
            shared.require_refusal(lambda limit=limit: compensator.arm(limit), f"arm({limit})")  # type: ignore[misc]
        zero = (0.0, 0.0, 0.0)
        shared.require_refusal(lambda: compensator.write(zero), "write() unarmed")
        compensator.arm(subject.limit)
        for offset in wrong:
            shared.require_refusal(lambda offset=offset: compensator.write(offset), f"write({offset})")  # type: ignore[misc]
        compensator.close()
        compensator.open()
        shared.require_refusal(lambda: compensator.write(zero), "write() after it was closed and opened again")
        time.sleep(10 * POLL)
        require(device.machine.orders == 0, f"the machine received {device.machine.orders} commands")
    return f"{len(wrong) + 6} commands refused"


@COMPENSATOR_CHECKS.add(why_not=_no_machine)
def heartbeat(subject: CompensatorSubject) -> str:
    """Repeated writing keeps an offset active; without writing, the machine ramps to zero."""
    with started(subject) as device, armed(subject, device) as compensator:
        follow(subject, compensator, device)
        for _ in range(5):
            write(compensator, device, subject.offset)
            device.machine.elapse(0.6 * device.machine.watchdog)
        require_offset(subject, device.machine.offset, subject.offset, "the offset after it was repeated")
        compensator.read()  # does not reset the watchdog
        require_ramp(device, "without writing")
    return f"active for {5 * 0.6:g} times the time of the watchdog, then a ramp to zero"


@COMPENSATOR_CHECKS.add(why_not=_no_machine)
def closed(subject: CompensatorSubject) -> str:
    """Closing has no immediate effect: the machine ramps to zero by its watchdog."""
    with started(subject) as device:
        with armed(subject, device) as compensator:
            follow(subject, compensator, device)
            orders = device.machine.orders
        time.sleep(10 * POLL)
        require(device.machine.orders == orders, "closing sent a command")
        require_ramp(device, "after close")
    return "a ramp to zero"


@COMPENSATOR_CHECKS.add(why_not=_no_machine)
def restart(subject: CompensatorSubject) -> str:
    """A new connection reads the offset in effect and continues from it; its first write resets the watchdog."""
    with started(subject) as device:
        with armed(subject, device) as compensator:
            follow(subject, compensator, device)
        machine = device.machine
        with armed(subject, device) as compensator:
            _reads_what_is_in_effect(subject, compensator, device, "after a restart")
            for _ in range(3):
                write(compensator, device, subject.offset)
                machine.elapse(0.6 * machine.watchdog)
                require_offset(subject, machine.offset, subject.offset, "the offset after a restart")
    return "no jump"


@COMPENSATOR_CHECKS.add(limit=60.0, why_not=_no_machine)
def two_connections(subject: CompensatorSubject) -> str:
    """A second connection is refused with a typed error, or reads the same; the first one is not affected."""
    with started(subject) as device, armed(subject, device) as compensator:
        follow(subject, compensator, device)
        start, seen, orders = time.perf_counter(), "both read the same", device.machine.orders
        with closing(made(subject, device)) as second:
            try:
                second.open()
                _reads_what_is_in_effect(subject, second, device, "the second connection")
            except InstrumentError as error:
                seen = f"the second one is refused: {type(error).__name__}"
        seconds = time.perf_counter() - start
        require(seconds <= subject.time_limit, f"it took {seconds:.1f} s, limit {subject.time_limit:g} s")
        time.sleep(10 * POLL)
        require(device.machine.orders == orders, "the second connection sent a command")
        write(compensator, device, subject.offset)
        _reads_what_is_in_effect(subject, compensator, device, "the first connection")
    return seen


def _reads_what_is_in_effect(subject: CompensatorSubject, compensator: Any, device: Any, who: str) -> None:
    """Wait until a compensator reads the offset in effect."""
    wait_for(
        lambda: near(compensator.read().offset, device.machine.offset, subject.resolution),
        lambda: f"{who}: expected {um(device.machine.offset)}, found {um(compensator.read().offset)}",
    )


@COMPENSATOR_CHECKS.add(why_not=_no_states)
def states(subject: CompensatorSubject) -> str:
    """A machine that is busy or accepts no offsets is reported; with a fault its offset ramps to zero."""
    with started(subject) as device, armed(subject, device) as compensator:
        follow(subject, compensator, device)
        for state in subject.states:
            wait_for(lambda: not compensator.read().busy and not compensator.read().fault, "a state that is not")
            setattr(device.machine, state, "set by the check")
            wait_for(lambda state=state: bool(getattr(compensator.read(), state)), f"{state} is not reported")  # type: ignore[misc]
            if state == "fault":
                require_ramp(device, "with a fault")
            setattr(device.machine, state, "")
    return " and ".join(subject.states)


@COMPENSATOR_CHECKS.add(limit=60.0, why_not=_no_lost_connection)
def lost_connection(subject: CompensatorSubject) -> str:
    """A lost connection is a typed error; the machine ramps to zero, and the compensator can be opened again."""
    with started(subject, f"{subject.lost_fault}&fault_at={CYCLES}") as device, armed(subject, device) as compensator:
        error = _first_error(subject, compensator)
        require(error is not None, "the lost connection was not detected")
        require_ramp(device, "after the connection was lost")
    return f"{type(error).__name__}, then a ramp to zero"


@COMPENSATOR_CHECKS.add(limit=90.0, why_not=_no_faults)
def faults(subject: CompensatorSubject) -> str:
    """Each fault causes a typed error within the time limit, and no offset beyond the limit comes into effect."""
    seen: list[str] = []
    wrong: list[str] = []
    for fault in subject.menu:
        with started(subject, fault) as device:
            start = time.perf_counter()
            error: Exception | None = None
            with closing(made(subject, device)) as compensator:
                try:
                    compensator.open()
                    compensator.arm(subject.limit)
                    error = _first_error(subject, compensator)
                except Exception as found:  # noqa: BLE001 - judged below
                    error = found
            seconds = time.perf_counter() - start
            device.machine.elapse(0.5 * device.machine.watchdog)
            highest = max(map(abs, device.machine.offset))
        complaint = _complaint(subject, fault, error, seconds, highest)
        text = "no error" if error is None else f"{type(error).__name__} after {seconds:.2f} s"
        (wrong if complaint else seen).append(f"{fault}: {complaint or text}")
    require(not wrong, "; ".join(wrong))
    return "; ".join(seen)


def _first_error(subject: CompensatorSubject, compensator: Any) -> Exception | None:
    """Read and write alternately until an error; return it."""
    for _ in range(CYCLES):
        try:
            compensator.read()
            compensator.write(subject.offset)
        except Exception as error:  # noqa: BLE001 - judged by the caller
            return error
        time.sleep(POLL)
    return None


def _complaint(subject: CompensatorSubject, fault: str, error: Exception | None, seconds: float, highest: float) -> str:
    if error is not None and not isinstance(error, InstrumentError):
        return f"expected an InstrumentError, found {error!r}"
    if seconds > subject.time_limit:
        return f"it took {seconds:.1f} s, limit {subject.time_limit:g} s"
    if highest > subject.limit:
        return f"the machine has an offset of {highest * 1e6:g} um"
    if (error is not None) == (fault in subject.harmless):
        return "not detected" if error is None else f"expected no effect: {error}"
    return ""


@COMPENSATOR_CHECKS.add(limit=_mutants_limit, why_not=_no_recording)
def mutants(subject: CompensatorSubject) -> str:
    """With any received bytes, only errors of the package are raised, within limits of time and memory."""
    return fuzz_checks.mutants(as_instrument(subject))


@COMPENSATOR_CHECKS.add()
def nothing_left(subject: CompensatorSubject) -> str:
    """After closing, also after an error, no thread, socket or port is left open."""
    before = open_things()
    for fault in ("", *subject.menu[-1:]):
        with (
            started(subject, fault) as device,
            closing(made(subject, device)) as compensator,
            suppress(InstrumentError),
        ):
            compensator.open()
            compensator.read()
    return shared.check_nothing_open(before)
