"""Thermometers with CANopen that follow CiA 404: float values, read by SDO."""

from __future__ import annotations

import math
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from errormotion.datasets.units import Time
from errormotion.errors import InstrumentError
from errormotion.instruments.thermometer.cia404 import (
    CELSIUS,
    DEVICE_TYPE,
    IDENTITY,
    KELVIN,
    NAME,
    PROFILE,
    STATUS,
    UNIT,
    VALUE,
    decode_unsigned,
    decode_value,
    flag_of,
    to_celsius,
)
from errormotion.instruments.thermometer.sensors import NO_ANSWER, Thermometer, ThermometerSettings
from errormotion.instruments.transports.can.bus import CanNode, SdoRefusal, open_can
from errormotion.plugins import Identity, InstrumentInfo

#: SDO abort codes of an input that has no value just now: hardware error, device state, no data.
NO_VALUE = frozenset((0x06060000, 0x08000020, 0x08000021, 0x08000022, 0x08000024))
_UNITS = {"degC": CELSIUS, "K": KELVIN}


class CanSettings(ThermometerSettings):
    """Settings of a CiA 404 thermometer."""

    inputs: tuple[int, ...] = Field(
        default=(), description="subindex of each channel; default: from 1 on, in their order"
    )
    node: int = Field(default=1, description="node number, where the URL has none", ge=1, le=127)
    unit: Literal["as stated", "degC", "K"] = Field(
        default="as stated", description="unit of the values; 'as stated': what object 0x6131 states"
    )
    start: bool = Field(default=False, description="send the node to OPERATIONAL when it is opened")
    timeout: Time = Field(default=1.0, description="time limit of an answer", gt=0)
    retry: Time = Field(default=1.0, description="least interval between two attempts to open a lost bus", ge=0)

    @model_validator(mode="after")
    def _one_each(self) -> Self:
        if self.inputs and len(self.inputs) != len(self.channels):
            raise ValueError(
                f"'inputs': expected one for each of the {len(self.channels)} channels; found {len(self.inputs)}"
            )
        if wrong := [i for i in self.subindices if not 1 <= i <= 254]:
            raise ValueError(f"'inputs': expected subindices from 1 to 254; found {wrong[0]}")
        return self

    @property
    def subindices(self) -> tuple[int, ...]:
        """Subindex of each channel."""
        return self.inputs or tuple(range(1, len(self.channels) + 1))


class CanTemperature(Thermometer):
    """A CANopen node whose analogue inputs are temperatures (CiA 404).

    Parameters
    ----------
    address : str
        ``can://socketcan/can0?node=5``, ``can://udp_multicast/239.74.163.2?node=5``, ``sim://cframe/can``,
        ``replay://file``.
    settings : CanSettings, optional
    record : Path, optional
        Recording of the session.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="can_temperature",
        kind="thermometer",
        summary="CANopen thermometers after CiA 404: values, units and states of inputs by SDO",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.thermometer.canopen_node:SimulatedCanopen",
    )
    Settings: ClassVar[type[CanSettings]] = CanSettings
    settings: CanSettings

    @property
    def node(self) -> CanNode:
        """The node on its bus; InstrumentError before ``open``."""
        node = self.transport
        if not isinstance(node, CanNode):
            raise TypeError(f"expected a CanNode, found {type(node).__name__}")
        return node

    @property
    def state(self) -> str:
        """NMT state that the node's last heartbeat reported; empty before the first one."""
        return self.node.state

    def identify(self) -> Identity:
        """Return the identity from the profile, name and numbers of the node.

        Raises
        ------
        InstrumentError
            The node is not a measuring device after CiA 404.
        """
        node = self.node
        device = decode_unsigned(node.upload(DEVICE_TYPE), DEVICE_TYPE)
        if device & 0xFFFF != PROFILE:
            raise InstrumentError(
                f"{self.address}: node {node.node} follows the profile CiA {device & 0xFFFF}; expected CiA {PROFILE}"
            )
        vendor, product, serial = (decode_unsigned(node.upload(IDENTITY, i), IDENTITY) for i in (1, 2, 4))
        try:
            name = node.upload(NAME).rstrip(b"\0").decode("latin-1")
        except SdoRefusal:  # the name is optional
            name = f"product {product}"
        return Identity(
            manufacturer=f"CiA vendor 0x{vendor:08X}",
            model=name,
            serial_number=str(serial),
            simulated=node.simulated,
            details={"address": self.address, "node": node.node, "product": product},
        )

    def configure(self, settings: CanSettings) -> None:
        """Use other settings from now on; the node itself is configured with the maker's tool."""
        self.settings = settings
        if self._transport is not None:
            self._read_units()

    def _measure(self) -> dict[str, tuple[float, str]]:
        node = self.node
        return {
            name: self._input(node, subindex, *scale)
            for name, subindex, scale in zip(self.channels, self.settings.subindices, self._scales, strict=True)
        }

    def _input(self, node: CanNode, subindex: int, scale: float, offset: float) -> tuple[float, str]:
        try:
            value = decode_value(node.upload(VALUE, subindex))
            status = decode_unsigned(node.upload(STATUS, subindex), STATUS) if self._has_status else 0
        except SdoRefusal as refusal:
            if refusal.code in NO_VALUE:
                return math.nan, NO_ANSWER
            raise
        return scale * value + offset, flag_of(status, value)

    def _read_units(self) -> None:
        """Read the constant data once: the units, and whether inputs have a status."""
        node, settings = self.node, self.settings
        self._scales: list[tuple[float, float]] = []
        for subindex in settings.subindices:
            unit = _UNITS.get(settings.unit)
            stated = decode_unsigned(node.upload(UNIT, subindex), UNIT) if unit is None else unit
            self._scales.append(to_celsius(stated))
        try:
            node.upload(STATUS, 0)
            self._has_status = True
        except SdoRefusal:
            self._has_status = False

    def _connect(self) -> CanNode:
        return open_can(
            self.address,
            node=self.settings.node,
            simulator=self.info.simulator,
            record=self._record,
            timeout=self.settings.timeout,
            retry=self.settings.retry,
        )

    def _start_session(self) -> None:
        if self.settings.start:
            self.node.start_node()
        self.identify()
        self._read_units()
