"""The simulated total station on its line: RS-232, or the same bytes over TCP."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.laser_tracker.leica_geocom import grammar
from errormotion.instruments.simulators.laser_tracker.leica_geocom.commands import DECIMALS, MODELS, Commands
from errormotion.instruments.simulators.laser_tracker.leica_geocom.grammar import Code, RefusedError
from errormotion.instruments.simulators.laser_tracker.leica_geocom.telescope import Telescope
from errormotion.instruments.transports import Address


class SimulatedGeoComStation(SimulatedDevice):
    """A total station with target recognition that measures the reflector at the machine's tool.

    Directions are clockwise, as those of the manufacturer: east, north and height are a right-handed system whose north
    is the x axis of `TrackerScene`, and whose east is its negative y axis.

    Further parameters of the address: those of `telescope.Telescope`; ``model`` (``TS30``, ``TCRP1201``, ``TM30``).

    Faults in addition to the menu, from ``fault_at`` on, ``fault_for`` times (without end): ``beam_broken`` (uses of
    the beam: distances and aiming), ``refuse`` (answers; ``code``, default 4, is their return code) and ``link_error``
    (answers; ``code``, default 3080, is the code of the communication).
    """

    faults = ("silence", "split", "garbage", "drop", "disconnect", "late", "beam_broken", "refuse", "link_error")

    def __init__(self, address: Address) -> None:
        super().__init__(address, line_end=grammar.LINE_END, default_name="station")
        try:
            self._set_up(address)
        except (InstrumentError, KeyError, ValueError) as error:
            self.close()
            raise InstrumentError(
                f"'{address.url}' has invalid parameters of a station: {error}", code="simulator.setting"
            ) from None

    def _set_up(self, address: Address) -> None:
        model = MODELS[address.params.get("model", "TS30")]
        self._code = int(
            address.number("code", Code.FATAL if self.fault.kind == "refuse" else Code.COM_CANT_DECODE_REQ)
        )
        self.telescope = Telescope(
            self.world, address, self._rng, lambda use: bool(self.fault.affects("beam_broken", use))
        )
        self.commands = Commands(self.world, self.telescope, model)

    @property
    def scene(self) -> Any:
        """The scene around the station."""
        return self.telescope.scene

    @property
    def dead_path(self) -> float:
        """Error of every distance, m."""
        return self.telescope.dead_path

    def carry_to(self, position: Sequence[float]) -> None:
        """Set up the station near a position in machine coordinates, m, and aim at the reflector."""
        self.telescope.carry_to(position)

    def _on_data(self, data: bytes) -> None:
        self._buffer += data
        while grammar.LINE_END in self._buffer:
            line, _, self._buffer = self._buffer.partition(grammar.LINE_END)
            line = line.rpartition(b"\n")[2]  # a line feed clears the buffer
            if line:
                self.reply(self.answer(line))
        self._buffer = self._buffer[: grammar.LONGEST + 1]

    def answer(self, request: bytes) -> bytes:
        """Return the reply to one request."""
        try:
            call = grammar.parse(request)
        except grammar.ProtocolError as error:
            return grammar.refusal(error.code, error.transaction)
        if self.fault.affects("refuse", self._answers):
            return grammar.reply(self._code, call.transaction)
        if self.fault.affects("link_error", self._answers):
            return grammar.refusal(self._code, call.transaction)
        self.commands.warning = 0
        try:
            values = self.commands.do(call.name, call.values)
        except RefusedError as refused:
            return grammar.reply(refused.code, call.transaction)
        return grammar.reply(self.commands.warning, call.transaction, grammar.encode(values, DECIMALS))
