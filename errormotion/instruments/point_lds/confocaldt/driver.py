"""Driver of a confocalDT controller with one sensor."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, ClassVar

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.point_lds.blocks import Block, BlockDecoder
from errormotion.instruments.point_lds.confocaldt import codec
from errormotion.instruments.point_lds.confocaldt.blocks import REASONS, block_decoder, readings, scale
from errormotion.instruments.point_lds.confocaldt.settings import ConfocalSettings
from errormotion.instruments.point_lds.counted import CountedReadings
from errormotion.instruments.point_lds.counting import CountingDriver, check_range
from errormotion.instruments.point_lds.optoncdt.commands import setting
from errormotion.instruments.point_lds.optoncdt.dialogue import Dialogue
from errormotion.plugins import Identity, InstrumentInfo

ON, OFF = f"{codec.OUTPUT} ETHERNET", f"{codec.OUTPUT} NONE"


class ConfocalDT(CountingDriver):
    """A confocal chromatic sensor at a Micro-Epsilon confocalDT IFC2451, IFC2461 or IFC2471.

    Readings are the distance from the start of the measuring range in m, larger for a more distant surface; NaN if the
    sensor has none.

    Opening switches the output of values off and selects one distance for Ethernet; closing restores both.

    Parameters
    ----------
    address : str
        ``tcp://host:23`` (``?data=1024`` for another data port), ``sim://cframe/X1?seed=3``, ``replay://file``.
    settings : ConfocalSettings, optional
    record : Path, optional
        Recording of the session.

    Attributes
    ----------
    no_value : str
        Why the last reading is NaN, one of `blocks.REASONS`; empty if it is valid.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="confocaldt",
        kind="point_lds",
        summary="Micro-Epsilon confocalDT 2451, 2461, 2471 confocal chromatic sensor, Ethernet",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.point_lds.confocaldt:SimulatedConfocal",
    )
    Settings: ClassVar[type[ConfocalSettings]] = ConfocalSettings
    settings: ConfocalSettings
    data_port: ClassVar[int] = codec.DATA_PORT
    _dialogue: Dialogue | None = None
    _facts: dict[str, str]
    _sensor: dict[str, str]
    _range = float("nan")

    @property
    def measuring_range(self) -> tuple[float, float]:
        """Lowest and highest reading, m, as the controller states them."""
        self._commands()
        return 0.0, self._range

    def identify(self) -> Identity:
        """Return the identity that the controller reports, and its sensor."""
        self._commands()
        sensor = f"{self._sensor.get('name', '')} {self._sensor.get('serial', '')}".strip()
        details: dict[str, Any] = {"address": self.address, "sensor": sensor}
        return Identity(
            manufacturer="Micro-Epsilon",
            model=self._facts["name"],
            serial_number=self._facts.get("serial", "unknown"),
            firmware=self._facts.get("version", ""),
            simulated=self.transport.simulated,
            details=details,
        )

    def configure(self, settings: ConfocalSettings) -> None:
        """Compare the settings with the controller and send the rate if it is given.

        Raises
        ------
        InstrumentError
            The measuring range differs, a master value is set, or the controller refuses.
        """
        self._refuse_while_streaming()
        dialogue = self._commands()
        self._sensor = codec.facts_of(dialogue.command(codec.SENSOR))
        found = codec.range_of(self._sensor)
        check_range(settings.measuring_range, found, "", "select the sensor in the controller (SENSORHEAD)")
        answer = dialogue.command(codec.MASTER)
        stated = " ".join(answer)[:60]
        if setting(codec.MASTER, answer) != f"{codec.MASTER} NONE":
            raise InstrumentError(
                f"{self.address}: a master value may be set (the answer is '{stated}'), so that values are not "
                f"relative to the start of the range. Reset it: {codec.MASTER} NONE, or on the web page",
                code="sensor.master.set",
            )
        if settings.rate is not None:
            dialogue.command(codec.rate_request(settings.rate))
        self._rate = codec.rate_of(dialogue.command(codec.RATE))
        self._range, self.settings = found, settings

    def read(self) -> float:
        """Return the present reading, m; NaN if the sensor has none, with the reason in ``no_value``.

        Raises
        ------
        InstrumentTimeoutError
            No answer or no value within the time limit.
        InstrumentError
            The controller refuses, or sends other values.
        """
        self._commands()
        self._refuse_while_streaming()
        block = self._one_block()
        if not block.intact:
            raise ProtocolError(
                f"{self.address}: the block of a reading is incomplete, or stray bytes follow; read again",
                code="protocol.reading.damaged",
            )
        values, codes = scale(block.values[:1, 0])
        self.no_value = REASONS[int(codes[0])]
        return float(values[0])

    # ------------------------------------------------------------------ values

    def _decoder(self) -> BlockDecoder:
        return block_decoder()

    def _readings(self) -> CountedReadings:
        self._commands()
        return readings()

    def _start_values(self) -> None:
        self._stale = True
        self._commands().command(ON)

    def _stop_values(self) -> None:
        self._commands().command(OFF)

    def _refresh(self) -> bool:
        """Switch the output off and open the data line again if values may wait; return whether it was opened."""
        if not self._stale:
            return False
        self._stop_values()
        self._data.reopen()
        self._commands().command(codec.OUTPUT)  # by its answer the controller has accepted the connection
        self._stale = False
        return True

    def _one_block(self) -> Block:
        self._refresh()
        self._start_values()
        block, *_ = self._next_blocks(self.settings.timeout)
        self._data.report_delivered(1)
        self._refresh()
        return block

    # ------------------------------------------------------------------ commands

    def _commands(self) -> Dialogue:
        self.transport  # noqa: B018 - raises before open
        if self._dialogue is None:
            raise InstrumentError(f"{self.address}: the controller has not been set up", code="sensor.not_set_up")
        return self._dialogue

    # ------------------------------------------------------------------ opening and closing

    def _start_session(self) -> None:
        self._failed = False
        self._data.report_delivered(0)
        dialogue = self._dialogue = Dialogue(self.exchange, self.settings.timeout)
        self._facts = codec.facts_of(dialogue.command(codec.INFO))
        codec.model_of(self._facts)
        self._stale = dialogue.remember(codec.OUTPUT) == ON
        dialogue.set(OFF)
        for name in (codec.ADDITIONAL, codec.STATISTICS):
            if dialogue.remember(name) != f"{name} NONE":
                dialogue.set(f"{name} NONE")
        if codec.reduction_of(dialogue.command(codec.REDUCTION)) != 1:
            dialogue.set(f"{codec.REDUCTION} 1 ETHERNET")
        self.configure(self.settings)

    def _end_session(self) -> None:
        dialogue, self._dialogue = self._dialogue, None
        if dialogue is not None:
            with suppress(InstrumentError):  # after a lost connection nothing can be restored
                dialogue.restore()
