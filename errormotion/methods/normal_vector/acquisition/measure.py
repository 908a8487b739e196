"""Measurement: cycles of touches while the machine warms up, by its controller or by a program that it executes.

Each cycle is yielded at its end; an interrupted cycle with its touches so far, after axes and spindle have been
stopped. An interrupted cold cycle is discarded, since it is no reference; the next run repeats it.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import xarray as xr

from errormotion.errors import InstrumentError, MethodError
from errormotion.methods.normal_vector.acquisition import cycle, programs
from errormotion.methods.normal_vector.acquisition.record import Record
from errormotion.methods.normal_vector.acquisition.warming import Warming, age, fault, run
from errormotion.plugins import Bench, Contact, Touch

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.settings import NormalVectorSettings

log = logging.getLogger(__name__)

MAX_DELAY = 1.0
"""Delay of a cycle above which a warning is logged, s."""
LAST_LINES_TIMEOUT = 2.0
"""Time after the end of a program within which its last printed lines arrive, s."""

Measure = Callable[[list[Touch]], Iterator[Contact]]


def acquire(bench: Bench, settings: NormalVectorSettings, done: xr.Dataset | None) -> Iterator[xr.Dataset]:
    """Yield one raw dataset for each cycle, the cold one first.

    Parameters
    ----------
    bench : Bench
        With a ``touch_probe``; a ``controller`` that moves the axes and turns the spindle, unless the operator starts a
        program that does so; and any number of thermometers.
    settings : NormalVectorSettings
    done : Dataset, optional
        Cycles of an interrupted run, which is continued.

    Raises
    ------
    MethodError
        Settings without balls, or a bench that lacks an instrument.
    InstrumentError
        A cycle was interrupted. The machine has been stopped.
    """
    if len(settings.balls) < 3:
        raise MethodError(
            f"balls: expected the approximate centres of three or more balls; found {len(settings.balls)}.",
            code="probing.balls.too_few",
        )
    probe, control, active, driven = route(bench)
    record = Record(bench, settings, probe, done)
    if not driven:
        yield from _listened(bench, probe, control, record, done)
        return
    fastest = max((event.spindle_speed for event in settings.schedule), default=0.0)
    if fastest and not settings.to_probe:
        bench.ask(
            f"The spindle will turn at up to {fastest:g} /min with the probe in it. If the probe is not designed for "
            "this, state in the settings the program lines that change the tool: to_probe, to_warm_up."
        )
    measure = probe.measure if active else _ByProgram(probe, control, record).measure
    yield from _driven(Warming(control, settings, done), measure, record)


def route(bench: Bench) -> tuple[Any, Any, bool, bool]:
    """Return probe and controller (or None), whether the probe moves the machine, and whether anything does.

    Otherwise the operator starts a program.

    Raises
    ------
    MethodError
        The probe moves the machine, and no controller turns the spindle.
    """
    probe = bench.of_kind("touch_probe")
    control = bench.of_kind("controller") if bench.has_kind("controller") else None
    moves = hasattr(control, "spindle") and hasattr(control, "move_to")
    active = hasattr(type(probe), "control")  # it moves the machine itself
    if active and not moves:
        raise MethodError(
            f"The touch probe '{probe.info.id}' moves the machine through its controller, and the warm-up needs an "
            "instrument of kind 'controller' that turns the spindle; the bench has none. Add one; or let the machine "
            "execute a program ('errormotion program') and use a touch probe that reads its printed lines.",
            code="probing.controller.missing",
        )
    return probe, control, active, moves and (active or hasattr(control, "run_program"))


def _driven(machine: Warming, measure: Measure, record: Record) -> Iterator[xr.Dataset]:
    """Yield cycles that the controller executes, with the warm-up between them."""
    settings, number = record.settings, 0 if machine.repeats else record.first
    try:
        while (number := _due(settings, number, machine.now)) < cycle.cycles(settings):
            machine.warm_until(number * settings.interval)
            start, history = machine.now, machine.history()
            if start - number * settings.interval > MAX_DELAY:
                log.warning("cycle %d starts %.0f s late", number, start - number * settings.interval)
            record.start_cycle()
            contacts: list[Contact] = []
            try:
                machine.rest()
                for contact in measure(record.touches):
                    contacts.append(contact)
            except BaseException:  # including an interruption by the operator
                machine.stop()
                if number and number >= record.first and _any_good(contacts):
                    yield record.dataset(contacts, start, start, machine.origin, history)
                raise
            if number == 0:
                record.refuse_unknown_balls(contacts)
                machine.warm_from = machine.now
            chunk = record.dataset(contacts, start, machine.now, machine.origin, history)
            if number >= record.first:
                yield chunk
            number += 1
        machine.turn(0.0)
    except GeneratorExit:  # the acquisition was ended; the bench may be closed already
        machine.stop(reconnect=False)
        raise
    except BaseException as error:
        failure = machine.stop()
        if failure and isinstance(error, InstrumentError):
            raise error.restated(
                f"{error}. Axes and spindle could not be stopped ({failure}): stop them at the machine"
            ) from error
        raise


def _listened(bench: Bench, probe: Any, control: Any, record: Record, done: xr.Dataset | None) -> Iterator[xr.Dataset]:
    """Yield cycles of a program that the operator starts and that includes the warm-up."""
    settings, virtual = record.settings, probe.identify().simulated
    parts = [part for part in cycle.parts(settings) if part.number >= record.first]
    if not parts:
        return
    where = f" from sequence number N{parts[0].number}" if record.first else ""
    minutes = (parts[-1].number - parts[0].number) * settings.interval / 60
    bench.ask(
        f"Start the program {programs.WARM_UP}{where} on the machine ('errormotion program' writes it). Its last cycle "
        f"starts after about {minutes:.0f} min."
    )
    origin: float | None = None  # of the machine's clock
    for part in parts:
        contacts: list[Contact] = []
        broken: BaseException | None = None
        start, history = part.number * settings.interval, cycle.planned_history(part, settings)
        try:
            for contact in record.in_time(probe.measure(record.touches)):
                if not contacts:
                    record.start_cycle()
                    if done is not None and origin is None and not virtual:
                        start = age(done)
                contacts.append(contact)
        except BaseException as error:  # noqa: BLE001 - including an interruption by the operator; raised below
            broken = _with_machine_state(error, control)
            if not (part.number and _any_good(contacts)):
                raise broken  # noqa: B904 - the same error, or caused by it
        if part.number == 0:
            record.refuse_unknown_balls(contacts)
        if known := [contact.time for contact in contacts if math.isfinite(contact.time)]:
            origin = known[0] - start if origin is None else origin
            start, end = known[0] - origin, known[-1] - origin
        else:
            end = start + math.fsum(step.seconds for step in part.cycle)
        yield record.dataset(contacts, start, end, origin or 0.0, history)
        if broken is not None:
            raise broken


def _with_machine_state(error: BaseException, control: Any) -> BaseException:
    """Return an error with the state of the controller appended, if the bench has one."""
    if not isinstance(error, InstrumentError):
        return error
    state = ""
    if control is not None:
        try:
            state = fault(control.state())
        except InstrumentError as silent:
            state = f"not answering either ({silent})"
    suffix = f". The machine is {state}" if state else ""
    extended = error.restated(f"{error}{suffix}. If its program is still running, stop it at the machine")
    extended.__cause__ = error
    return extended


def _due(settings: NormalVectorSettings, number: int, now: float) -> int:
    """Return the number of the next cycle, and log those that are omitted."""
    due = cycle.due(settings, number, now)
    if due > number:
        log.warning("cycles %d to %d are omitted: their start times have passed", number, due - 1)
    return due


def _any_good(contacts: list[Contact]) -> bool:
    return any(not contact.flag for contact in contacts)


class _ByProgram:
    """A probe that reads printed lines, with a controller that executes a program for every cycle."""

    def __init__(self, probe: Any, control: Any, record: Record) -> None:
        self._probe, self._control, self._record = probe, control, record
        self._text = programs.cycle_program(record.settings, record.tip_radius)

    def measure(self, touches: list[Touch]) -> Iterator[Contact]:
        """Execute the program of a cycle, and yield its printed contacts, also if it ended in alarm."""
        failure: InstrumentError | None = None
        try:
            run(self._control, self._text)
        except InstrumentError as error:
            failure = error
        usual = self._probe.settings
        self._probe.configure(_short_timeouts(usual))  # all lines have been sent
        try:
            yield from self._record.in_time(self._probe.measure(touches))
        except InstrumentError as error:
            raise failure or error from error
        finally:
            self._probe.configure(usual)
        if failure is not None:
            raise failure


def _short_timeouts(settings: Any) -> Any:
    """Return settings of a probe with timeouts for lines that have already been sent."""
    limits = {"timeout", "start_timeout"} & set(type(settings).model_fields)
    return settings.model_copy(update={name: min(getattr(settings, name), LAST_LINES_TIMEOUT) for name in limits})
