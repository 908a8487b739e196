"""A PLC that accepts offsets in holding registers, with limit, slew limit and a watchdog on the heartbeat."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import ValidationError

from errormotion.errors import InstrumentError
from errormotion.instruments.compensator.register_map import SIZES, RegisterSettings
from errormotion.instruments.simulators.compensator.machine import MachinePart
from errormotion.instruments.simulators.modbus_device import FAILURE, SimulatedModbusDevice
from errormotion.instruments.transports import Address
from errormotion.instruments.transports.modbus.serving import ModbusServer

REFUSED = 2  # Modbus exception: illegal data address
_SAME = ("type", "word_order")


class SimulatedPlc(SimulatedModbusDevice):
    """A PLC with the program that is required of a machine.

    Registers: offsets, then the heartbeat; then offsets in effect, a stop and a busy register, which the PLC writes.
    With the parameter ``owner=1``, the next one is that of the owner, which the PLC sets to 0 when its watchdog has
    expired. Further parameters of the address: ``framing`` (``tcp`` or ``rtu``; default by ``wire``), ``unit`` (1),
    ``type``, ``word_order``, ``scale`` and ``function`` as in the settings of the compensator, ``first`` (0, the first
    register), and those of `MachinePart`.

    Further faults: ``exception`` (an exception reply), ``unit`` (the answer of another device), ``short`` (an
    incomplete answer), ``checksum`` (RTU).

    Attributes
    ----------
    machine : MachinePart
    driver_settings : mapping
        Settings of the compensator for this PLC.
    """

    faults: tuple[str, ...] = ("silence", "split", "garbage", "drop", "disconnect", "exception", "unit", "short")

    def __init__(self, address: Address) -> None:
        self.driver_settings = _settings(address)
        self._map = RegisterSettings.model_validate(self.driver_settings)
        self.machine = MachinePart(address)
        self._words: dict[int, int] = {}
        self._heartbeat = 0
        last = max(*self._map.states, self._map.owner or 0) + 1
        first = min(self._map.offset)
        super().__init__(address, "plc")
        self._device = ModbusServer(self._framing, self._unit, 3, {first: last - first}, self._registers, self._written)

    def _registers(self) -> dict[int, int] | int:
        """Return the present registers, or the code of an exception."""
        if self.fault.hits("exception", self._answers):
            return FAILURE
        registers, plc = dict(self._words), self._map
        if plc.owner is not None:
            if not self.machine.alive:
                self._words.pop(plc.owner, None)
            registers[plc.owner] = self._words.get(plc.owner, 0)
        for first, value in zip(plc.applied or (), self.machine.offset, strict=True):
            registers.update(enumerate(plc.words(round(value / plc.scale)), start=first))
        for register, text in ((plc.stop, self.machine.fault), (plc.busy, self.machine.busy)):
            if register is not None:
                registers[register] = int(bool(text))
        return registers

    def _written(self, registers: Mapping[int, int]) -> int:
        """Write registers; return 0, or the code of an exception. Registers that the PLC writes are refused."""
        if self.fault.hits("exception", self._answers):
            return FAILURE
        plc, size = self._map, SIZES[self._map.type]
        if list(registers) == [plc.owner]:
            self._words.update(registers)
            self.machine.begin()
            return 0
        if max(registers) > plc.heartbeat:
            return REFUSED
        self._words.update(registers)
        beat = self._words.get(plc.heartbeat, 0)
        alive, self._heartbeat = beat != self._heartbeat, beat
        counts = [plc.count([self._words.get(first + i, 0) for i in range(size)]) for first in plc.offset]
        self.machine.order([count * plc.scale for count in counts], alive=alive)
        return 0


def _settings(address: Address) -> dict[str, object]:
    """Return the settings of the compensator that the parameters of an address describe."""
    given: dict[str, object] = {key: address.params[key] for key in _SAME if key in address.params}
    size = SIZES.get(str(given.get("type", "i32")), 2)
    first = address.whole("first", 0, 60000)
    state = first + 3 * size + 1
    given |= {
        "scale": f"{address.number('scale', 1e-9)!r} m",
        "function": address.whole("function", 16, 16),
        "offset": tuple(first + i * size for i in range(3)),
        "heartbeat": state - 1,
        "applied": tuple(state + i * size for i in range(3)),
        "stop": state + 3 * size,
        "busy": state + 3 * size + 1,
    }
    if address.whole("owner", 0, 1):
        given["owner"] = state + 3 * size + 2
    try:
        RegisterSettings.model_validate(given)
    except ValidationError as error:
        raise InstrumentError(
            f"The registers in '{address.url}' are invalid: {error.errors()[0]['msg']}", code="simulator.setting"
        ) from None
    return given
