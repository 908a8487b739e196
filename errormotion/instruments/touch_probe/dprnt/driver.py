"""Driver of contacts that a program of the machine prints; read-only."""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.driver import Driver
from errormotion.instruments.touch_probe.dprnt.codec import MAX_LINE, Line, from_iso_code, parse_line, text_of
from errormotion.instruments.touch_probe.dprnt.matching import REPEATED, contact_of, touch_of
from errormotion.instruments.touch_probe.dprnt.settings import DprntSettings
from errormotion.instruments.touch_probe.probe import Probe, corrected, refuse_unmapped
from errormotion.instruments.touch_probe.touching import NOT_MADE, NOWHERE
from errormotion.instruments.transports.quiet import discard_input
from errormotion.plugins import Contact, Identity, InstrumentInfo, InstrumentSubject, Touch

_LINE_ENDS = {
    "ascii": {"lf": b"\n", "cr": b"\r"},
    "iso": {"lf": b"\n", "cr": b"\x8d"},  # with even parity
}
_LENGTHS = {"mm": 1e-3, "in": 25.4e-3}
_TIMES = {"ms": 1e-3, "s": 1.0}

log = logging.getLogger(__name__)


class Dprnt(Probe, Driver):
    """Lines that a macro prints, one for each touch, over a serial line or TCP.

    Parameters
    ----------
    address : str
        ``serial:///dev/ttyUSB0?baudrate=4800``, ``tcp://host:port``, ``sim://cframe/printer``, ``replay://file``.
    settings : DprntSettings, optional
    record : Path, optional
        Recording of the session.

    Attributes
    ----------
    last : Contact or None
        The last contact.
    unreadable, repeated, missing, late : int
        Number of unreadable lines, lines printed twice, touches without a line, and lines of a cycle that had ended in
        an error, since the driver was created.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="dprnt",
        kind="touch_probe",
        summary="Contacts that the machine's own probing program prints with DPRNT, over a serial line or TCP",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.touch_probe.dprnt:SimulatedPrinter",
    )
    Settings: ClassVar[type[DprntSettings]] = DprntSettings
    settings: DprntSettings

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit."""
        return InstrumentSubject(cls, "sim://cframe/printer", faults=())  # faults affect lines, and no program runs

    def __init__(self, address: str, settings: DprntSettings | None = None, *, record: Path | None = None) -> None:
        super().__init__(address, settings, record=record)
        self.unreadable = self.repeated = self.missing = self.late = 0
        self._before: Line | None = None  # the last line
        self._ahead: Line | None = None  # the first line of the next cycle, if received
        self._unfinished_from = 0  # touch at which the last cycle ended in an error; else 0

    def identify(self) -> Identity:
        """Return the identity stated in the settings: printed lines have none."""
        return Identity(
            manufacturer=self.settings.control,
            model="DPRNT",
            serial_number="not reported",
            simulated=self.transport.simulated,
            details={"address": self.address, "tip_radius": self.tip_radius},
        )

    def read(self) -> dict[str, Any]:
        """Return ``contacts``, ``unreadable``, ``repeated``, ``missing``, ``late`` so far, and the last ``contact``.

        The contact is X, Y, Z in m, NaN without one, with its ``time`` and ``flag``. Only `measure` reads lines.
        """
        _ = self.transport
        return {
            "contacts": self._contacts,
            "unreadable": self.unreadable,
            "repeated": self.repeated,
            "missing": self.missing,
            "late": self.late,
            "contact": list(self.last.position if self.last else NOWHERE),
            "time": self.last.time if self.last else float("nan"),
            "flag": self.last.flag if self.last else "",
        }

    def measure(self, touches: Sequence[Touch]) -> Iterator[Contact]:
        """Yield the printed contact of each touch, in order, while the machine's program makes them.

        A touch whose line is missing, as later lines show, is ``not made``. Repeated and unreadable lines are
        ignored and counted. Where the lines of the next cycle start, the rest of this one is missing. After a cycle
        that ended in an error, its remaining lines are ignored and counted as late, until an earlier touch is printed.

        Raises
        ------
        InstrumentTimeoutError
            No line within the time limit; the message states the touch.
        ProtocolError
            Too many lines that cannot be read.
        InstrumentError
            A position that belongs to no touch, touches from a direction that the pre-travel map does not cover, a lost
            connection.
        """
        touches = list(touches)
        refuse_unmapped(self._map, touches)
        due, unreadable = 0, self.unreadable
        while due < len(touches):
            where = f"Touch {due + 1} of {len(touches)} (item {touches[due].item})"
            try:
                line = self._next(self.settings.timeout if due else self.settings.start_timeout, unreadable)
                index = touch_of(line, touches, due, self._before, self.settings.first_number, self.settings.margin)
            except InstrumentError as error:
                self._unfinished_from = max(due, self._unfinished_from)
                raise error.restated(f"{where}: {error}") from error
            if index == REPEATED:
                self.repeated += 1
                continue
            if 0 < self._unfinished_from <= index:
                self.late += 1
                self._before = line
                continue
            self._unfinished_from = 0
            if index < due:
                self._ahead, index = line, len(touches)
            else:
                self._before = line
            for _ in range(due, index):
                self.missing += 1
                yield self._keep(Contact(NOWHERE, float("nan"), NOT_MADE))
            if index < len(touches):
                touch = touches[index]
                contact = contact_of(line, touch, self.settings.free, self.settings.at_target)
                yield self._keep(corrected(self._map, touch, contact))
            due = index + 1

    def _next(self, timeout: float, unreadable: int) -> Line:
        """Return the next line that states a position."""
        if self._ahead is not None:
            line, self._ahead = self._ahead, None
            return line
        end = time.monotonic() + timeout
        pattern = re.compile(self.settings.pattern)
        code = self.settings.code
        line_end = _LINE_ENDS[code][self.settings.line_end]
        while True:
            try:
                raw = self.transport.read_until(line_end, limit=MAX_LINE, timeout=max(end - time.monotonic(), 0.0))
                text = text_of(from_iso_code(raw) if code == "iso" else raw)
                if text:
                    units = _LENGTHS[self.settings.length_unit], _TIMES[self.settings.time_unit]
                    return parse_line(text, pattern, length=units[0], time=units[1])
            except InstrumentTimeoutError as error:
                raise InstrumentTimeoutError(
                    f"no line for {timeout:g} s; check the program and the cable. {error}", code="instrument.no_answer"
                ) from error
            except ProtocolError as error:
                self.unreadable += 1
                log.warning("%s: %s", self.address, error)
                if self.unreadable - unreadable > self.settings.most_unreadable:
                    raise ProtocolError(
                        f"{self.unreadable - unreadable} lines cannot be read; check baud rate and pattern. "
                        f"The last one: {error}",
                        code="protocol.lines.unreadable",
                    ) from error

    def _start_session(self) -> None:
        self._map = self.settings.pretravel_map()
        self._before = self._ahead = None
        self._unfinished_from = 0

    def _end_session(self) -> None:
        discard_input(self.transport)  # characters of PCLOS after the last line, so that a recording is read to its end
