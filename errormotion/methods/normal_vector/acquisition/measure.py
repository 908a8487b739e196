"""Measuring: cycles of touches while the machine warms up, by its controller or by a program that it runs itself.

Every cycle is handed over when it is over, and one that breaks off with what it has. Before that axes and spindle are
stopped: nothing moves on. A cold cycle that breaks off is no reference for anything; the next run makes it anew.
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
from errormotion.methods.normal_vector.acquisition.warming import Warming, age, run, trouble
from errormotion.plugins import Bench, Contact, Touch

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.settings import Settings

log = logging.getLogger(__name__)

LATE = 1.0
"""So much behind its time a cycle may begin before it is told, s."""
LAST_LINES = 2.0
"""When a program has ended, its last lines come within this time, s."""

Measure = Callable[[list[Touch]], Iterator[Contact]]


def acquire(bench: Bench, settings: Settings, done: xr.Dataset | None) -> Iterator[xr.Dataset]:
    """Yield one raw dataset a cycle, the cold one first.

    Parameters
    ----------
    bench : Bench
        With a ``touch_probe``; a ``controller`` that moves and turns the spindle, unless the operator starts a program
        that does so; and as many thermometers as there are.
    settings : Settings
    done : Dataset, optional
        Cycles that an interrupted run holds: the next one follows.

    Raises
    ------
    MethodError
        Settings without balls, or a bench that cannot do it.
    InstrumentError
        Whatever stops a cycle. The machine stands then.
    """
    if len(settings.balls) < 3:
        raise MethodError(f"balls: expected the rough places of three balls or more; found {len(settings.balls)}.")
    probe = bench.of_kind("touch_probe")
    control = bench.of_kind("controller") if bench.has_kind("controller") else None
    moves = hasattr(control, "spindle") and hasattr(control, "move_to")
    active = hasattr(type(probe), "control")  # it moves the machine itself
    if active and not moves:
        raise MethodError(
            f"The touch probe '{probe.info.id}' has the machine moved, and a machine that is to warm up needs an "
            "instrument of kind 'controller' that turns its spindle; the bench has none. Add it; or let the machine "
            "run a program ('errormotion program') and use a touch probe that reads the lines that the program prints."
        )
    record = Record(bench, settings, probe, done)
    if not moves or not (active or hasattr(control, "run_program")):
        yield from _listened(bench, probe, control, record, done)
        return
    fastest = max((event.spindle_speed for event in settings.schedule), default=0.0)
    if fastest and not settings.to_probe:
        bench.ask(
            f"The spindle will turn at up to {fastest:g} /min with the probe in it. If the probe is not made for that, "
            "say in the settings by which lines of a program the tool is changed: to_probe, to_warm_up."
        )
    measure = probe.measure if active else _ByProgram(probe, control, record).measure
    yield from _driven(Warming(control, settings, done), measure, record)


def _driven(machine: Warming, measure: Measure, record: Record) -> Iterator[xr.Dataset]:
    """Yield cycles that the controller makes, and warm the machine up in between."""
    settings, number = record.settings, record.first
    try:
        while (number := _due(settings, number, machine.now)) < cycle.cycles(settings):
            machine.warm_until(number * settings.interval)
            begin, history = machine.now, machine.history()
            if begin - number * settings.interval > LATE:
                log.warning("cycle %d begins %.0f s late", number, begin - number * settings.interval)
            record.begin()
            contacts: list[Contact] = []
            try:
                machine.rest()
                for contact in measure(record.touches):
                    contacts.append(contact)
            except BaseException:  # an interruption by the operator, too
                machine.halt()
                if number and _any_good(contacts):
                    yield record.dataset(contacts, begin, begin, machine.origin, history)
                raise
            if number == 0:
                record.refuse_unknown_balls(contacts)
                machine.warm_from = machine.now
            yield record.dataset(contacts, begin, machine.now, machine.origin, history)
            number += 1
        machine.turn(0.0)
    except GeneratorExit:  # nobody takes the cycles any more; the bench may be closed by now
        machine.halt(anew=False)
        raise
    except BaseException as error:
        why = machine.halt()
        if why and isinstance(error, InstrumentError):
            raise type(error)(
                f"{error}. Axes and spindle could not be stopped ({why}): stop them at the machine"
            ) from error
        raise


def _listened(bench: Bench, probe: Any, control: Any, record: Record, done: xr.Dataset | None) -> Iterator[xr.Dataset]:
    """Yield cycles of a program that the operator starts, and that warms the machine up as well."""
    settings, virtual = record.settings, probe.identify().simulated
    parts = [part for part in cycle.parts(settings) if part.number >= record.first]
    if not parts:
        return
    where = f" from its sequence number N{parts[0].number} on" if record.first else ""
    minutes = (parts[-1].number - parts[0].number) * settings.interval / 60
    bench.ask(
        f"Start the program {programs.WARM_UP}{where} on the machine ('errormotion program' writes it). Its last cycle "
        f"begins after about {minutes:.0f} min."
    )
    origin: float | None = None  # of the machine's clock
    for part in parts:
        contacts: list[Contact] = []
        broken: BaseException | None = None
        begin, history = part.number * settings.interval, cycle.planned_history(part, settings)
        try:
            for contact in record.in_time(probe.measure(record.touches)):
                if not contacts:
                    record.begin()
                    if done is not None and origin is None and not virtual:
                        begin = age(done)
                contacts.append(contact)
        except BaseException as error:  # noqa: BLE001 - an interruption by the operator, too; it is raised below
            broken = _told(error, control)
            if not (part.number and _any_good(contacts)):
                raise broken  # noqa: B904 - it is the same one, or says so
        if part.number == 0:
            record.refuse_unknown_balls(contacts)
        if known := [contact.time for contact in contacts if math.isfinite(contact.time)]:
            origin = known[0] - begin if origin is None else origin
            begin, end = known[0] - origin, known[-1] - origin
        else:
            end = begin + math.fsum(step.seconds for step in part.cycle)
        yield record.dataset(contacts, begin, end, origin or 0.0, history)
        if broken is not None:
            raise broken


def _told(error: BaseException, control: Any) -> BaseException:
    """Return an error with what the control says of itself, where one is on the bench."""
    if not isinstance(error, InstrumentError):
        return error
    why = ""
    if control is not None:
        try:
            why = trouble(control.state())
        except InstrumentError as silent:
            why = f"silent as well ({silent})"
    said = f". The machine is {why}" if why else ""
    told = type(error)(f"{error}{said}. What its program still moves only the operator can stop")
    told.__cause__ = error
    return told


def _due(settings: Settings, number: int, now: float) -> int:
    """Return which cycle is next, and tell which are left out."""
    due = cycle.due(settings, number, now)
    if due > number:
        log.warning("cycles %d to %d are left out: their time is past", number, due - 1)
    return due


def _any_good(contacts: list[Contact]) -> bool:
    return any(not contact.flag for contact in contacts)


class _ByProgram:
    """A probe that only listens, at a controller that runs a program for every cycle."""

    def __init__(self, probe: Any, control: Any, record: Record) -> None:
        self._probe, self._control, self._record = probe, control, record
        self._text = programs.cycle_program(record.settings, record.tip_radius)

    def measure(self, touches: list[Touch]) -> Iterator[Contact]:
        """Run the program of a cycle, and yield what it has printed; also where it ended in alarm."""
        failure: InstrumentError | None = None
        try:
            run(self._control, self._text)
        except InstrumentError as error:
            failure = error
        usual = self._probe.settings
        self._probe.configure(_impatient(usual))  # all lines are there, or on the wire
        try:
            yield from self._record.in_time(self._probe.measure(touches))
        except InstrumentError as error:
            raise failure or error from error
        finally:
            self._probe.configure(usual)
        if failure is not None:
            raise failure


def _impatient(settings: Any) -> Any:
    """Return settings of a probe whose time limits are those of lines that have been sent."""
    limits = {"timeout", "start_timeout"} & set(type(settings).model_fields)
    return settings.model_copy(update={name: min(getattr(settings, name), LAST_LINES) for name in limits})
