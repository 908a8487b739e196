"""A simulated CANopen slave (CiA 301): NMT states, boot-up, heartbeat, SYNC, emergencies and transmit PDOs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial

from errormotion.instruments.simulators.thermometer.canopen_objects import (
    NOT_MAPPABLE,
    PDO_TOO_LONG,
    VALUE_OUT_OF_RANGE,
    WRONG_STATE,
    Dictionary,
    Entry,
    Refused,
    SdoServer,
)

STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x04, 0x05, 0x7F
START, STOP, ENTER_PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 0x01, 0x02, 0x80, 0x81, 0x82
SYNC = 0x80
INVALID, NO_REMOTE, FRAME_29_BIT = 1 << 31, 1 << 30, 1 << 29
FIRST_TPDO = 0x180  # COB-ID of TPDO 1 without the node; the others follow at intervals of 0x100
PREDEFINED_TPDOS = 4
MAX_MAPPED = 8  # objects of a TPDO
OLDEST_ERRORS = 10  # entries of 0x1003


@dataclass
class Tpdo:
    """One transmit PDO.

    Attributes
    ----------
    cob_id : int
        COB-ID, with bit 31 if it is switched off, and bit 30 if remote frames are not answered.
    kind : int
        Transmission type: 0 to 240 on SYNC, 254 and 255 by event.
    event_timer : int
        Milliseconds; 0: none.
    inhibit : int
        Minimum interval, in units of 100 us.
    mapping : list of int
        Index, sub-index and bits of each object.
    used : int
        Number of mapped objects.
    """

    cob_id: int
    kind: int
    event_timer: int
    mapping: list[int]
    used: int
    inhibit: int = 0
    syncs: int = field(default=0, compare=False)
    due: float = field(default=math.inf, compare=False)

    @property
    def valid(self) -> bool:
        """Whether it is switched on."""
        return not self.cob_id & INVALID


class Slave:
    """The communication of a node; not thread-safe.

    Parameters
    ----------
    node : int
    dictionary : Dictionary
        Objects of the device; the slave adds those of the communication profile.
    send : callable
        ``send(can_id, data)``.
    tpdos : list of Tpdo
    heartbeat : float
        Period after power-on, s; 0: none.
    autonomous : bool
        Whether it enters OPERATIONAL by itself.
    errors : tuple of int, optional
        Emergency code and error register that are reported after each boot.
    """

    def __init__(
        self,
        node: int,
        dictionary: Dictionary,
        send: Callable[[int, bytes], None],
        tpdos: list[Tpdo],
        *,
        heartbeat: float,
        autonomous: bool = False,
        errors: tuple[int, int] | None = None,
    ) -> None:
        self.node, self.state = node, PRE_OPERATIONAL
        self._dictionary, self._send, self._tpdos = dictionary, send, tpdos
        self._sdo = SdoServer(dictionary)
        self._heartbeat = round(1000 * heartbeat)
        self._next_heartbeat = math.inf
        self._autonomous = autonomous
        self._errors: list[int] = []
        self._register = 0
        self._at_boot = errors
        self._defaults = [(p.cob_id, p.kind, p.event_timer, list(p.mapping), p.used) for p in tpdos]
        self._default_heartbeat = self._heartbeat
        self._add_objects()

    def boot(self) -> None:
        """Start as after power-on: boot-up message, then PRE-OPERATIONAL, or OPERATIONAL if it is autonomous."""
        for tpdo, (cob_id, kind, timer, mapping, used) in zip(self._tpdos, self._defaults, strict=True):
            tpdo.cob_id, tpdo.kind, tpdo.event_timer, tpdo.used, tpdo.inhibit = cob_id, kind, timer, used, 0
            tpdo.mapping[:] = mapping
        self._sdo = SdoServer(self._dictionary)
        self._errors, self._register = [], 0
        self._send(0x700 + self.node, b"\0")
        self._set_heartbeat(self._default_heartbeat)
        self.enter(OPERATIONAL if self._autonomous else PRE_OPERATIONAL)
        if self._at_boot:
            self.report(*self._at_boot)

    def enter(self, state: int) -> None:
        """Change the state; in OPERATIONAL the event timers run, and SYNC is processed."""
        entered, self.state = state != self.state, state
        for tpdo in self._tpdos:
            if entered:
                self._restart(tpdo)

    def report(self, code: int, register: int) -> None:
        """Send an emergency; code 0: no errors."""
        self._register = register
        if code:
            self._errors = [code, *self._errors][:OLDEST_ERRORS]
        if self.state != STOPPED:
            self._send(0x80 + self.node, code.to_bytes(2, "little") + bytes((register, 0, 0, 0, 0, 0)))

    def receive(self, can_id: int, data: bytes, remote: bool) -> None:
        """Process a frame from the bus."""
        if remote:
            self._answer_remote(can_id)
        elif can_id == 0:
            self._manage(data)
        elif can_id == SYNC and self.state == OPERATIONAL:
            self._synchronise()
        elif can_id == 0x600 + self.node and self.state != STOPPED:
            answer = self._sdo.answer(data)
            if answer is not None:
                self._send(0x580 + self.node, answer)

    def due(self, now: float) -> float:
        """Send the messages due at a time (`time.monotonic`, s) and return the time of the next one."""
        if now >= self._next_heartbeat:
            self._next_heartbeat = max(self._next_heartbeat + self._heartbeat / 1000, now)
            self._send(0x700 + self.node, bytes((self.state,)))
        for tpdo in self._tpdos:
            if now >= tpdo.due:
                self._transmit(tpdo)
        return min([self._next_heartbeat, *(tpdo.due for tpdo in self._tpdos)])

    def _manage(self, data: bytes) -> None:
        if len(data) != 2 or data[1] not in (0, self.node):
            return
        states = {START: OPERATIONAL, STOP: STOPPED, ENTER_PRE_OPERATIONAL: PRE_OPERATIONAL}
        if data[0] in states:
            self.enter(states[data[0]])
        elif data[0] in (RESET_NODE, RESET_COMMUNICATION):
            self.state = PRE_OPERATIONAL
            self.boot()

    def _synchronise(self) -> None:
        for tpdo in self._tpdos:
            if tpdo.valid and tpdo.kind <= 240:
                tpdo.syncs += 1
                if tpdo.syncs >= max(tpdo.kind, 1):
                    tpdo.syncs = 0
                    self._transmit(tpdo)

    def _answer_remote(self, can_id: int) -> None:
        for tpdo in self._tpdos:
            requested = tpdo.valid and not tpdo.cob_id & NO_REMOTE and can_id == tpdo.cob_id & 0x7FF
            if requested and self.state == OPERATIONAL:
                self._transmit(tpdo)

    def _transmit(self, tpdo: Tpdo) -> None:
        timed = tpdo.kind >= 254 and tpdo.event_timer
        tpdo.due = time.monotonic() + max(tpdo.event_timer / 1e3, tpdo.inhibit / 1e4) if timed else math.inf
        mapped = [(each >> 16, each >> 8 & 0xFF) for each in tpdo.mapping[: tpdo.used]]
        with suppress(Refused):  # a value is not available: the PDO is not sent
            if mapped:
                self._send(tpdo.cob_id & 0x7FF, b"".join(self._dictionary.read(*each) for each in mapped))

    def _add_objects(self) -> None:
        add, constant = self._dictionary.add, self._dictionary.constant
        add(0x1001, 0, Entry("u8", lambda: self._register, mappable=True))
        add(0x1003, 0, Entry("u8", lambda: len(self._errors), self._clear_errors))
        for k in range(OLDEST_ERRORS):
            add(0x1003, k + 1, Entry("u32", partial(self._error, k)))
        constant(0x1005, "u32", SYNC)
        constant(0x1014, "u32", 0x80 + self.node)
        add(0x1017, 0, Entry("u16", lambda: self._heartbeat, self._set_heartbeat))
        for number, tpdo in enumerate(self._tpdos):
            self._add_tpdo(number, tpdo)

    def _add_tpdo(self, number: int, tpdo: Tpdo) -> None:
        add, index = self._dictionary.add, 0x1800 + number
        add(index, 0, Entry("u8", lambda: 5))
        add(index, 1, Entry("u32", lambda: tpdo.cob_id, partial(self._set_cob_id, tpdo)))
        add(index, 2, Entry("u8", lambda: tpdo.kind, partial(self._set_kind, tpdo)))
        add(index, 3, Entry("u16", lambda: tpdo.inhibit, partial(self._set_inhibit, tpdo)))
        add(index, 5, Entry("u16", lambda: tpdo.event_timer, partial(self._set_timer, tpdo)))
        add(0x1A00 + number, 0, Entry("u8", lambda: tpdo.used, partial(self._set_used, tpdo)))
        for k in range(MAX_MAPPED):
            add(0x1A00 + number, k + 1, Entry("u32", partial(_mapped, tpdo, k), partial(self._map, tpdo, k)))

    def _error(self, k: int) -> int:
        return self._errors[k] if k < len(self._errors) else 0

    def _clear_errors(self, value: int) -> None:
        if value:
            raise Refused(VALUE_OUT_OF_RANGE)
        self._errors = []

    def _set_heartbeat(self, value: int) -> None:
        self._heartbeat = value
        self._next_heartbeat = time.monotonic() + value / 1000 if value else math.inf

    def _set_cob_id(self, tpdo: Tpdo, value: int) -> None:
        changed = (value ^ tpdo.cob_id) & ~INVALID
        if tpdo.valid and not value & INVALID and changed:  # an ID may only change while the PDO is switched off
            raise Refused(WRONG_STATE)
        if value & FRAME_29_BIT or not 0x181 <= value & 0x7FF <= 0x57F or value & 0x1FFFF800:
            raise Refused(VALUE_OUT_OF_RANGE)
        tpdo.cob_id = value
        self._restart(tpdo)

    def _set_kind(self, tpdo: Tpdo, value: int) -> None:
        if 240 < value < 254:  # 252 and 253, only by remote frame, are not supported
            raise Refused(VALUE_OUT_OF_RANGE)
        tpdo.kind = value
        self._restart(tpdo)

    def _set_inhibit(self, tpdo: Tpdo, value: int) -> None:
        if tpdo.valid:
            raise Refused(WRONG_STATE)
        tpdo.inhibit = value

    def _set_timer(self, tpdo: Tpdo, value: int) -> None:
        tpdo.event_timer = value
        self._restart(tpdo)

    def _restart(self, tpdo: Tpdo) -> None:
        tpdo.syncs, timed = 0, tpdo.kind >= 254 and tpdo.event_timer and tpdo.valid and self.state == OPERATIONAL
        tpdo.due = time.monotonic() + tpdo.event_timer / 1e3 if timed else math.inf

    def _set_used(self, tpdo: Tpdo, value: int) -> None:
        if tpdo.valid:
            raise Refused(WRONG_STATE)
        if value > MAX_MAPPED:
            raise Refused(VALUE_OUT_OF_RANGE)
        if sum(mapped & 0xFF for mapped in tpdo.mapping[:value]) > 64:
            raise Refused(PDO_TOO_LONG)
        if any(not mapped for mapped in tpdo.mapping[:value]):
            raise Refused(NOT_MAPPABLE)
        tpdo.used = value

    def _map(self, tpdo: Tpdo, k: int, value: int) -> None:
        if tpdo.valid or tpdo.used:  # the mapping is written while sub-index 0 is 0
            raise Refused(WRONG_STATE)
        if value:
            entry = self._dictionary.find(value >> 16, value >> 8 & 0xFF)
            if not entry.mappable or entry.bits != value & 0xFF:
                raise Refused(NOT_MAPPABLE)
        tpdo.mapping[k] = value


def _mapped(tpdo: Tpdo, k: int) -> int:
    return tpdo.mapping[k]
