"""Measuring: cycles of touches while the machine warms up, by its controller or by a program that it runs itself.

Every cycle is handed over when it is over, and one that breaks off with what it has. Then nothing moves on: axes and
spindle are stopped before the error goes up.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.errors import InstrumentError, MethodError
from errormotion.methods.normal_vector import cycle, programs
from errormotion.methods.normal_vector.record import Record
from errormotion.methods.normal_vector.warming import Warming
from errormotion.plugins import Bench, Contact, Touch

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.settings import Settings

log = logging.getLogger(__name__)

LATE = 1.0
"""So much behind its time a cycle may begin before it is told, s."""


def acquire(
    bench: Bench, settings: Settings, inputs: Mapping[str, xr.Dataset], done: xr.Dataset | None
) -> Iterator[xr.Dataset]:
    """Yield one raw dataset a cycle, the cold one first.

    Parameters
    ----------
    bench : Bench
        With a ``touch_probe``; a ``controller`` that moves and turns the spindle, unless the operator starts a program
        that does so; and as many thermometers as there are.
    settings : Settings
    inputs : mapping
        Not used.
    done : Dataset, optional
        Cycles that an interrupted run holds: the next one follows.

    Raises
    ------
    MethodError
        Settings without balls, or a bench that cannot do it.
    InstrumentError
        Whatever stops a cycle. The machine stands then.
    """
    del inputs
    if len(settings.balls) < 3:
        raise MethodError(f"balls: expected the rough places of three balls or more; found {len(settings.balls)}.")
    probe = bench.of_kind("touch_probe")
    control = bench.of_kind("controller") if bench.has_kind("controller") else None
    moves = hasattr(control, "spindle") and hasattr(control, "move_to")
    record = Record(bench, settings, probe, done)
    if hasattr(type(probe), "control"):  # it moves the machine itself
        if not moves:
            raise MethodError(
                "A machine that is to warm up needs an instrument of kind 'controller' that turns the spindle and "
                "moves the axes; the bench has none. Or let the machine run a program ('errormotion program') and take "
                "a touch probe that reads what it prints, such as 'dprnt'."
            )
        yield from _driven(Warming(control, settings, done), probe, record)
    elif moves and hasattr(control, "run_program"):
        yield from _driven(Warming(control, settings, done), _ByProgram(probe, control, settings), record)
    else:
        yield from _listened(bench, probe, record)


def _driven(machine: Warming, probe: Any, record: Record) -> Iterator[xr.Dataset]:
    """Yield cycles that the controller makes, and warm the machine up in between."""
    settings = record.settings
    try:
        for number in range(record.first, cycle.cycles(settings)):
            machine.warm_until(number * settings.interval)
            late = machine.now - number * settings.interval
            if late > LATE:
                log.warning("cycle %d begins %.0f s late", number, late)
            begin, history = machine.now, machine.history()
            record.read_temperatures()
            machine.rest()
            contacts: list[Contact] = []
            try:
                _collect(probe, record.touches, contacts)
            except InstrumentError:
                if any(not contact.flag for contact in contacts):
                    yield record.dataset(contacts, begin, machine.origin, history)
                raise
            if number == 0:
                machine.warm_from = machine.now
            yield record.dataset(contacts, begin, machine.origin, history)
        machine.turn(0.0)
    except BaseException:
        machine.halt()
        raise


def _listened(bench: Bench, probe: Any, record: Record) -> Iterator[xr.Dataset]:
    """Yield cycles of a program that the operator starts, and that warms the machine up as well."""
    settings, first = record.settings, record.first
    again = f", from cycle {first} on," if first else ""
    minutes = (cycle.cycles(settings) - 1 - first) * settings.interval / 60
    bench.ask(
        f"Start the program {programs.WARM_UP}{again} on the machine ('errormotion program' writes it). Its last cycle "
        f"begins after {minutes:.0f} min."
    )
    origin: float | None = None
    for number in range(first, cycle.cycles(settings)):
        contacts: list[Contact] = []
        planned = number * settings.interval
        try:
            _collect(probe, record.touches, contacts)
        except InstrumentError:
            if any(not contact.flag for contact in contacts):
                begin, origin = _begin(contacts, planned, origin)
                yield record.dataset(contacts, begin, origin, cycle.planned_history(settings, number))
            raise
        begin, origin = _begin(contacts, planned, origin)
        record.read_temperatures()
        yield record.dataset(contacts, begin, origin, cycle.planned_history(settings, number))


def _begin(contacts: list[Contact], planned: float, origin: float | None) -> tuple[float, float]:
    """Return when a cycle began, s since the cold one, and the reading of the machine's clock at that one."""
    times = np.array([contact.time for contact in contacts])
    if not np.isfinite(times).any():  # the program does not print the time
        return planned, 0.0
    first = float(np.nanmin(times))
    origin = first - planned if origin is None else origin
    return first - origin, origin


def _collect(probe: Any, touches: list[Touch], into: list[Contact]) -> None:
    """Put contacts into a list as they come, so that those before an error are kept."""
    for contact in probe.measure(touches):
        into.append(contact)


class _ByProgram:
    """A probe that only listens, at a controller that runs a program for every cycle."""

    def __init__(self, probe: Any, control: Any, settings: Settings) -> None:
        self._probe, self._control = probe, control
        self._text = programs.cycle_program(settings)

    def measure(self, touches: list[Touch]) -> Iterator[Contact]:
        """Run the program of a cycle and yield what it prints."""
        expected = self._control.run_program(self._text)
        if hasattr(self._control, "elapse"):
            self._control.elapse(float(expected["duration"]) + float(expected["longest_lead_in"]))
        if alarms := self._control.state()["alarms"]:
            raise InstrumentError(f"The control is in alarm: {'; '.join(alarms)}")
        yield from self._probe.measure(touches)
