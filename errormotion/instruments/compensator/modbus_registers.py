"""``modbus_registers``: offsets in holding registers of a PLC, with a heartbeat register.

The program of the PLC adds the offsets. It must have a watchdog on the heartbeat, a slew limit and its own limit of the
offset.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from errormotion.errors import InstrumentError
from errormotion.instruments.compensator.owner import NO_OWNER, Owner
from errormotion.instruments.compensator.register_map import SIZES, RegisterSettings, runs
from errormotion.instruments.interlock import ROUNDING, OffsetInterlock
from errormotion.instruments.modbus_driver import ModbusDriver
from errormotion.instruments.transports.modbus.client import READ_HOLDING
from errormotion.plugins import Applied, CompensatorSubject, Identity, InstrumentInfo

MAX_READ, MAX_WRITTEN = 125, 123
"""Largest number of registers in one request."""


class ModbusRegisters(ModbusDriver):
    """Writes offsets to a PLC by Modbus TCP, RTU on a serial line, or RTU through a serial server.

    Adjacent registers are written by one request; the heartbeat is written by the last request, so that it does not
    change if an offset was written only in part.

    Parameters
    ----------
    address : str
        ``modbus+tcp://host:502?unit=1``, ``modbus+rtu:///dev/ttyUSB0?baudrate=19200&unit=1``,
        ``modbus+rtu-tcp://host:4001?unit=1``, ``sim://cframe/plc``.
    settings : RegisterSettings, optional
    record : Path, optional
        Recording of the session.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="modbus_registers",
        kind="compensator",
        summary="Offsets in holding registers of a PLC, with a heartbeat: Modbus TCP, RTU, RTU over TCP.",
        status="peer_verified",
        simulator="errormotion.instruments.simulators.compensator.plc:SimulatedPlc",
    )
    Settings: ClassVar[type[RegisterSettings]] = RegisterSettings
    settings: RegisterSettings

    @classmethod
    def conformance(cls) -> tuple[CompensatorSubject, ...]:
        """Return the subject of the conformance kit: TCP, and 16 bits on a serial line."""
        limits = {"timeout": 0.3, "retry": 0.0}
        tcp = CompensatorSubject(cls, settings=limits, dead_address="modbus+tcp://127.0.0.1:9")
        address = f"{tcp.address}&wire=pty&type=i16&scale=1e-8&word_order=little&function=6"
        faults = ("silence", "checksum")
        rtu = CompensatorSubject(
            cls, address, limits, "rtu", faults=faults, dead_address="modbus+rtu:///dev/no_such_line"
        )
        return tcp, rtu

    def __init__(self, address: str, settings: RegisterSettings | None = None, *, record: Path | None = None) -> None:
        super().__init__(address, settings, record=record)
        self._interlock = OffsetInterlock(f"{self.info.id} at {address}")
        self._heartbeat = 0
        self._owner = Owner(f"{self.info.id} at {address}", self._read_owner, self._write_owner)
        self.note = "" if self.settings.owner is not None else NO_OWNER

    def close(self) -> None:
        """Disconnect and disarm; the watchdog of the PLC ramps to zero. Idempotent."""
        self._interlock.disarm()
        self._owner.release()
        super().close()

    def identify(self) -> Identity:
        """Return the address of the unit; PLCs report no name in their registers."""
        self.line.registers(READ_HOLDING, self.settings.heartbeat, 1)
        return self.identity("holding registers")

    def arm(self, limit: float) -> None:
        """Permit offsets up to a limit for each axis, m; nothing is sent but the owner, if it has a register.

        Raises
        ------
        InstrumentError
            The registers cannot represent this limit, one count is more than the limit, or another program is the
            owner.
        """
        largest, scale = self.settings.largest, self.settings.scale
        if not scale <= limit <= largest:
            raise InstrumentError(
                f"{self.address}: the registers represent offsets from {scale * 1e6:g} um to {largest * 1e6:g} um; the "
                f"limit is {limit * 1e6:g} um. Change 'scale' or 'type'",
                code="offset.range.too_small",
            )
        if self.settings.owner is not None:
            self._owner.take()
        self._interlock.arm(limit)

    def read(self) -> Applied:
        """Return the offset in effect, m, and the states of the PLC.

        Raises
        ------
        ProtocolError, InstrumentTimeoutError, InstrumentError
            See `ModbusLine.registers`.
        """
        settings = self.settings
        wanted = {first + i: 0 for first, n in settings.states.items() for i in range(n)}
        values = self._read(wanted)
        size = SIZES[settings.type]
        x, y, z = (
            settings.count([values[first + i] for i in range(size)]) * settings.scale
            for first in settings.applied or settings.offset
        )
        return Applied((x, y, z), self._state(values, "busy"), self._state(values, "stop"))

    def write(self, offset: Sequence[float]) -> None:
        """Write the offset of X, Y, Z, m, and the next number of the heartbeat.

        Raises
        ------
        InstrumentError
            The driver is not armed, another program is the owner, or an offset is beyond the limit or not finite: no
            offset was sent. For other errors see `ModbusLine.write_registers`.
        """
        line, settings = self.line, self.settings
        values = self._interlock.offset(offset)
        if settings.owner is not None:
            self._owner.require()
        most = int(self._interlock.limit * (1 + ROUNDING) / settings.scale)
        words: dict[int, int] = {}
        for first, value in zip(settings.offset, values, strict=True):
            count = min(max(round(value / settings.scale), -most), most)
            words.update(enumerate(settings.words(count), start=first))
        self._heartbeat = (self._heartbeat + 1) % (1 << 16)
        words[settings.heartbeat] = self._heartbeat
        parts = list(runs(words, MAX_WRITTEN if settings.function == 16 else 1))
        alive = settings.heartbeat
        for first, part in sorted(parts, key=lambda part: part[0] <= alive < part[0] + len(part[1])):
            line.write_registers(first, part, function=settings.function)

    def _read_owner(self) -> int:
        (found,) = self.line.registers(READ_HOLDING, self.settings.owner or 0, 1)
        return int(found)

    def _write_owner(self, number: int) -> None:
        self.line.write_registers(self.settings.owner or 0, [number], function=self.settings.function)

    def _state(self, values: dict[int, int], name: str) -> str:
        register = getattr(self.settings, name)
        value = values[register] if register is not None else 0
        return f"the PLC states {name} (register {register} is {value})" if value else ""

    def _read(self, wanted: dict[int, int]) -> dict[int, int]:
        """Return registers by their numbers."""
        values: dict[int, int] = {}
        for first, part in runs(wanted, MAX_READ):
            values.update(enumerate(self.line.registers(READ_HOLDING, first, len(part)), start=first))
        return values

    def _start_session(self) -> None:
        """Continue from the last heartbeat, so that the first write changes it; check the other registers."""
        (self._heartbeat,) = self.line.registers(READ_HOLDING, self.settings.heartbeat, 1)
        self.read()
