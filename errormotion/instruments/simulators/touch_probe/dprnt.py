"""The printer port of the virtual machine's control, with the output of NC programs.

The port is a pty, or TCP if ``port`` or ``host`` is stated. A line is sent as soon as the world's clock has reached its
time. In addition to `faults` there is ``duplicate``: lines are sent twice. ``fault_at`` and ``fault_every`` count
lines; a ``late`` line is delayed until the next one at most.

Sources in addition to those of `virtual_world.printing`: Haas 96-8000, June 1999, p. 115 (DC1 to DC4, ``%``); FANUC
B-63524EN/01, p. 649 (end of a block as LF, or as LF CR CR).
"""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.faults import stray_bytes
from errormotion.instruments.simulators.virtual_world.printing import Block, PortCommand, in_iso_code
from errormotion.instruments.transports import Address

DC1, DC2, DC3, DC4 = 0x11, 0x12, 0x13, 0x14
SEVEN_BITS = 0x7F
ENDS = {"lf": b"\n", "cr": b"\r", "crlf": b"\r\n", "lfcr": b"\n\r", "lfcrcr": b"\n\r\r"}
_POLL_INTERVAL = 0.005  # s of real time between two checks of the clock


class SimulatedPrinter(SimulatedDevice):
    """The port of a FANUC or Haas control; it only receives DC1 and DC3.

    Parameters of the address: ``control`` (``fanuc``, ``haas``), ``eob`` (end of a block: ``lf``, ``cr``, ``crlf``,
    ``lfcr``, ``lfcrcr``; default LF, Haas CR), ``zeros`` (leading zeros of a FANUC: ``blank`` or ``none``), ``code``
    (``ascii``, ``iso``: with even parity in the eighth bit), ``percent`` (1: ``%`` after POPEN and before PCLOS). A
    FANUC only prints between POPEN and PCLOS.
    """

    faults = ("silence", "split", "garbage", "drop", "disconnect", "duplicate", "late")

    def __init__(self, address: Address) -> None:
        self._control: Any = _choice(address, "control", ("fanuc", "haas"))
        self._zeros: Any = _choice(address, "zeros", ("blank", "none"))
        self._iso = _choice(address, "code", ("ascii", "iso")) == "iso"
        ends = sorted(ENDS, key=("cr" if self._control == "haas" else "lf").__ne__)
        self._end = ENDS[_choice(address, "eob", tuple(ends))]
        self._percent = bool(address.whole("percent", 0, 1))
        self._ended = threading.Event()
        self._stopped = False  # by DC3
        self._open = self._control == "haas"
        wire = "tcp" if "port" in address.params or "host" in address.params else "pty"
        super().__init__(
            replace(address, params={"wire": wire, **address.params}), line_end=b"\n", default_name="printer"
        )
        self._sent: dict[int, Any] = {id(each): each for each in self.world.port_output if each[0] <= self.world.time}
        for _, command in self._sent.values():
            self._switch(command)
        self._lines = 0
        self._thread = threading.Thread(target=self._watch, name=f"sim-{self.name}-lines", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the device."""
        self._ended.set()
        if self._thread is not threading.current_thread():
            self._thread.join()
        super().close()

    def connection_opened(self) -> None:
        """Clear a stop by the previous client."""
        self._stopped = False

    def _on_data(self, data: bytes) -> None:
        for code in data:
            if code & SEVEN_BITS in (DC1, DC3):
                self._stopped = code & SEVEN_BITS == DC3

    def _watch(self) -> None:
        while not self._ended.wait(_POLL_INTERVAL):
            now = self.world.time
            for each in list(self.world.port_output):
                if self._stopped:
                    break
                if each[0] <= now and id(each) not in self._sent:
                    self._sent[id(each)] = each
                    self._execute(each[1])

    def _switch(self, command: PortCommand) -> None:
        if isinstance(command, str) and self._control != "haas":
            self._open = command == "POPEN"

    def _execute(self, command: PortCommand) -> None:
        self._switch(command)
        if isinstance(command, Block):
            if self._open:
                self._print(self._coded(command.text(self._control, self._zeros).encode("ascii") + self._end))
            return
        percent = b"%" + self._end if self._percent else b""
        self._send(self._coded(bytes((DC2,)) + percent if command == "POPEN" else percent + bytes((DC4,))))

    def _coded(self, data: bytes) -> bytes:
        return in_iso_code(data) if self._iso else data

    def _send(self, data: bytes) -> None:
        if self.fault.kind == "silence" and self._lines >= self.fault.at:
            return
        with self._server.lock:
            for piece in self.fault.pieces(data):
                self._server.send(piece)

    def _print(self, line: bytes) -> None:
        number, fault = self._lines, self.fault
        self._lines += 1
        if fault.suppresses(number):
            return
        if fault.kind == "disconnect" and number >= fault.at:
            self._server.disconnect()
            return
        if fault.hits("garbage", number):
            line = b"\xff" + stray_bytes(self._rng) + line
        self._late.send(self._server, fault, number, line * (2 if fault.hits("duplicate", number) else 1))


def _choice(address: Address, key: str, choices: tuple[str, ...]) -> str:
    """Return a parameter; by default the first choice."""
    choice = address.params.get(key, choices[0])
    if choice not in choices:
        raise InstrumentError(
            f"'{key}' in '{address.url}': expected {', '.join(choices)}; found '{choice}'", code="simulator.setting"
        )
    return choice
