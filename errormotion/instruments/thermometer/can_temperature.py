"""Thermometers with CANopen that follow CiA 404, read by SDO or by PDO."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar, Literal, Self

from pydantic import Field, model_validator

from errormotion.datasets.units import Time
from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.thermometer.can_inputs import Input, find_inputs, find_pdos
from errormotion.instruments.thermometer.cia404 import (
    CELSIUS,
    DEVICE_TYPE,
    FAHRENHEIT,
    IDENTITY,
    KELVIN,
    MAX_DIGITS,
    NAME,
    NUMBERS,
    PROFILE,
    flag_of,
)
from errormotion.instruments.thermometer.sensors import NO_ANSWER, Thermometer, ThermometerSettings
from errormotion.instruments.transports.can.bus import CanNode, open_can
from errormotion.instruments.transports.can.pdo import TransmitPdo
from errormotion.instruments.transports.can.sdo import SdoRefusal
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject

#: SDO abort codes of an input without a value at present: hardware error, device state, no data.
NO_VALUE = frozenset((0x06060000, 0x08000020, 0x08000021, 0x08000022, 0x08000024))
_UNITS = {"degC": CELSIUS, "K": KELVIN, "degF": FAHRENHEIT}
_LATENESS = 1.5
"""Largest interval between two PDOs that are sent by a timer, as a multiple of its interval."""


class CanSettings(ThermometerSettings):
    """Settings of a CiA 404 thermometer."""

    inputs: tuple[int, ...] = Field(
        default=(), description="subindex of each channel; default: 1, 2, ... in their order"
    )
    node: int = Field(default=1, description="node number, if the URL states none", ge=1, le=127)
    unit: Literal["as stated", "degC", "K", "degF"] = Field(
        default="as stated", description="unit of the values; 'as stated': the one in object 0x6131"
    )
    number: Literal["as found", "float", "integer 32", "integer 16"] = Field(
        default="as found",
        description="format of the values: object 0x6130, 0x9130 or 0x7130; 'as found': the first one of the node",
    )
    digits: int | None = Field(
        default=None,
        description="decimal digits of whole numbers; default: as stated in object 0x6132",
        ge=0,
        le=MAX_DIGITS,
    )
    transfer: Literal["sdo", "pdo"] = Field(
        default="sdo",
        description="'pdo': receive inputs that are sent at SYNC or at an interval, and request the others by SDO",
    )
    sync: bool = Field(
        default=False, description="whether each reading by PDO sends a SYNC, which every node on the bus receives"
    )
    start: bool = Field(
        default=False, description="whether the node is set to OPERATIONAL when it is opened, and after a boot-up"
    )
    timeout: Time = Field(default=1.0, description="time limit for an answer", gt=0)
    retry: Time = Field(default=1.0, description="minimum interval between two attempts to open a lost bus again", ge=0)

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
        summary="CANopen thermometers after CiA 404: values, units and states of inputs by SDO or PDO",
        status="peer_verified",
        simulator="errormotion.instruments.simulators.thermometer.canopen_node:SimulatedCanopen",
    )
    Settings: ClassVar[type[CanSettings]] = CanSettings
    settings: CanSettings

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit."""
        return InstrumentSubject(cls, "sim://cframe?seed=3")

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

    @property
    def emergency(self) -> int:
        """Code of the node's last emergency message; 0: none, or the emergency has ended."""
        return self.node.emergency

    def identify(self) -> Identity:
        """Check the profile of the node and return its identity.

        Raises
        ------
        InstrumentError
            The node is not a measuring device after CiA 404.
        """
        node = self.node
        device = node.unsigned(DEVICE_TYPE)
        if device & 0xFFFF != PROFILE:
            raise InstrumentError(
                f"{self.address}: node {node.node} follows the profile CiA {device & 0xFFFF}; expected CiA {PROFILE}",
                code="can.profile.other",
            )
        vendor = node.unsigned(IDENTITY, 1)
        product, serial = (_optional(node, IDENTITY, i) for i in (2, 4))
        try:
            name = node.upload(NAME).rstrip(b"\0").decode("latin-1")
        except SdoRefusal:  # the name is optional
            name = f"product {product}"
        return Identity(
            manufacturer=f"CiA vendor 0x{vendor:08X}",
            model=name,
            serial_number="unknown" if serial is None else str(serial),
            simulated=node.simulated,
            details={"address": self.address, "node": node.node, "product": product},
        )

    def configure(self, settings: CanSettings) -> None:
        """Use other settings from now on; the node itself is configured with the manufacturer's tool."""
        self.settings = settings
        if self._transport is not None:
            self._prepare()

    def _measure(self) -> dict[str, tuple[float, str]]:
        if self.node.boots != self._boots:  # its configuration may have changed
            self._prepare()
        frames = self._frames() if self._pdos else {}
        return {name: self._value(each, frames) for name, each in zip(self.channels, self._inputs, strict=True)}

    def _value(self, wanted: Input, frames: Mapping[int, bytes]) -> tuple[float, str]:
        try:
            value = wanted.number.decode(self._entry(wanted.number.index, wanted.subindex, frames))
            status = 0
            if wanted.status is not None:
                status = int.from_bytes(self._entry(*wanted.status, frames)[:1], "little")
        except SdoRefusal as refusal:
            if refusal.number in NO_VALUE:
                return math.nan, NO_ANSWER
            raise
        except ProtocolError as error:
            raise ProtocolError(f"{self.address}: node {self.node.node}, {error}", code=error.code) from None
        return wanted.scale.celsius(value), flag_of(status, value)

    def _entry(self, index: int, subindex: int, frames: Mapping[int, bytes]) -> bytes:
        """Return an entry from a received PDO, or from the object dictionary of the node."""
        for pdo in self._pdos:
            field = pdo.place(index, subindex)
            if field is not None:
                return field.data(frames[pdo.identifier])
        return self.node.upload(index, subindex)

    def _frames(self) -> dict[int, bytes]:
        """Return new PDOs."""
        cyclic = [pdo.transmission for pdo in self._pdos if pdo.cyclic]
        interval = max((pdo.event_timer for pdo in self._pdos if pdo.timed), default=0.0)
        return self.node.fresh_pdos(
            [pdo.identifier for pdo in self._pdos],
            self.settings.timeout + _LATENESS * interval,
            syncs=max(cyclic, default=0) if self.settings.sync else 0,
            sync=self._sync,
        )

    def _prepare(self) -> None:
        """Start the node if this is set, and read the inputs, units and PDOs, which do not change later."""
        node, settings = self.node, self.settings
        boots = node.boots
        if settings.start:
            node.start_node()
        self._inputs = find_inputs(
            node,
            settings.subindices,
            numbers=NUMBERS.values() if settings.number == "as found" else (NUMBERS[settings.number],),
            unit=_UNITS.get(settings.unit),
            digits=settings.digits,
        )
        self._pdos: list[TransmitPdo] = []
        if settings.transfer == "pdo":
            self._pdos = find_pdos(node, self._inputs)
            self._sync = node.sync_identifier()
            node.await_pdos([pdo.identifier for pdo in self._pdos])
        self._boots = boots

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
        self.identify()
        self._prepare()


def _optional(node: CanNode, index: int, subindex: int) -> int | None:
    try:
        return node.unsigned(index, subindex)
    except SdoRefusal:
        return None
