"""Five point sensors around a bar in the spindle (ISO 230-3), on one clock.

X1 and Y1 measure the level L1 of the bar, X2 and Y2 the level L2, Z its end face. Sensors of one driver that can be
synchronised sample on their own clock, others are read together on the clock of this computer: see `sampling`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.driver import Openable
from errormotion.instruments.point_lds.optoncdt.driver import BLOCK_SECONDS, OptoNCDT
from errormotion.instruments.point_lds.optoncdt.settings import OptoSettings, SensorSettings
from errormotion.instruments.spindle_frame import sampling
from errormotion.instruments.spindle_frame.geometry import frame_geometry
from errormotion.instruments.spindle_frame.settings import CHANNELS, FrameSettings
from errormotion.instruments.transports import parse_address
from errormotion.instruments.transports.recording import read_index, write_index
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject, Samples

WARM_UP = 2 * 3600.0
"""Time until a sensor is stable after it was switched on, s: it drifts by 10.5 um (Geiselhart et al. 2025)."""


class FiveSensorFrame(Openable):
    """Five point sensors X1 X2 Y1 Y2 Z in a frame around a bar.

    Parameters
    ----------
    address : str
        Address of the whole frame, unless the settings state one for each sensor: ``sim://cframe?seed=3`` stands for
        ``sim://cframe/X1?seed=3`` and so on; ``tcp://host:4001?X2=4002&Y1=4003&Y2=4004&Z=4005`` for the ports of one
        serial server, X1 at the first port; ``replay://session.rec`` is a recording of all five.
    settings : FrameSettings, optional
    record : Path, optional
        ``session.rec`` names the recordings of the sensors, which lie beside it: ``session.X1.rec`` and so on.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="five_sensor_frame",
        kind="spindle_frame",
        summary="Five point sensors X1 X2 Y1 Y2 Z around a bar in the spindle, on one clock",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.spindle_frame.five_sensors:SimulatedFrame",
    )
    Settings: ClassVar[type[FrameSettings]] = FrameSettings
    channels = CHANNELS

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit."""
        return InstrumentSubject(cls, "sim://cframe?seed=3")

    def __init__(self, address: str = "", settings: FrameSettings | None = None, *, record: Path | None = None) -> None:
        self.address = address
        self.settings = FrameSettings() if settings is None else settings
        self.geometry = frame_geometry(self.settings)
        self._record = record
        self._sensors: dict[str, Any] = {}
        self._streaming = False

    @property
    def rate(self) -> float:
        """Samples per second of each channel."""
        return self.settings.rate

    @property
    def encoding(self) -> dict[str, Any]:
        """Encoding that stores samples without loss, where all sensors have the same one; else empty."""
        encodings = [dict(getattr(sensor, "encoding", {})) for sensor in self._open_sensors().values()]
        return encodings[0] if all(each == encodings[0] for each in encodings) else {}

    @property
    def addresses(self) -> dict[str, str]:
        """URL of each sensor."""
        stated = self.settings.addresses or {name: each["address"] for name, each in self.settings.sensors.items()}
        if self.address.startswith("replay://"):
            return {
                name: f"replay://{path}" for name, path in read_index(Path(parse_address(self.address).path)).items()
            }
        if stated:
            return dict(stated)
        if not self.address:
            raise InstrumentError(
                "The five_sensor_frame needs 'addresses' in its settings, one URL for each of " + ", ".join(CHANNELS),
                code="frame.addresses.missing",
            )
        frame = parse_address(self.address)
        if frame.scheme == "sim":
            return {name: frame.with_path(name) for name in CHANNELS}
        first, *others = CHANNELS
        if frame.scheme == "tcp" and frame.params.keys() == set(others):
            at_first = f"tcp://{frame.host}:{frame.port}"
            return {first: at_first} | {name: frame.line(name, 0).url for name in others}
        raise InstrumentError(
            f"'{self.address}' is the address of one device; expected 'addresses' in the settings, one URL for each of "
            f"{', '.join(CHANNELS)}, or 'tcp://HOST:PORT?{'&'.join(f'{name}=PORT' for name in others)}'",
            code="frame.addresses.missing",
        )

    # ------------------------------------------------------------------ opening and closing

    def open(self) -> None:
        """Connect and configure all five sensors; idempotent.

        Raises
        ------
        InstrumentError
            A channel does not answer; the message names it.
        """
        if self._sensors:
            return
        records = {} if self._record is None else write_index(self._record, CHANNELS)
        sensors: dict[str, Any] = {}
        try:
            for name, address in self.addresses.items():
                driver, settings = self._choice(name, self.settings)
                sensor = sensors[name] = driver(address, settings, record=records.get(name))
                if self.settings.synchronised:
                    sensor.name = name
                try:
                    sensor.open()
                except InstrumentError as error:
                    raise error.restated(f"Channel {name}: {error}") from error
        except BaseException:
            for sensor in sensors.values():
                with suppress(InstrumentError):
                    sensor.close()
            raise
        self._sensors = sensors

    def close(self) -> None:
        """Disconnect all sensors and end every thread; idempotent."""
        sensors, self._sensors = self._sensors, {}
        if self.settings.synchronised:
            sampling.stop(list(sensors.values()))
        errors: list[InstrumentError] = []
        for sensor in sensors.values():
            try:
                sensor.close()
            except InstrumentError as error:
                errors.append(error)
        if errors:
            raise errors[0]

    # ------------------------------------------------------------------ state

    def identify(self) -> Identity:
        """Query all sensors for their identity."""
        parts = {name: sensor.identify() for name, sensor in self._open_sensors().items()}
        return Identity(
            manufacturer=", ".join(sorted({part.manufacturer for part in parts.values()})),
            model="five_sensor_frame with " + ", ".join(sorted({part.model for part in parts.values()})),
            serial_number=", ".join(f"{name} {part.serial_number}" for name, part in parts.items()),
            firmware=", ".join(sorted({part.firmware for part in parts.values()})),
            simulated=any(part.simulated for part in parts.values()),
            details={
                "address": self.address or ", ".join(self.addresses.values()),
                "synchronised": self.settings.synchronised,
                "channels": {name: dict(part.details) for name, part in parts.items()},
            },
        )

    def configure(self, settings: FrameSettings) -> None:
        """Send other settings to all sensors; their addresses do not change."""
        for name, sensor in self._open_sensors().items():
            sensor.configure(self._choice(name, settings)[1])
        self.settings = settings
        self.geometry = frame_geometry(settings)

    @property
    def warm(self) -> bool:
        """Whether all sensors have been on for two hours, as they state or by ``powered_since``; False if unknown."""
        since = self.settings.powered_since
        known = 0.0 if since is None else (datetime.now(UTC) - since).total_seconds()
        stated = [each.on_for() if hasattr(each, "on_for") else 0.0 for each in self._open_sensors().values()]
        return all(max(known, seconds) >= WARM_UP for seconds in stated)

    # ------------------------------------------------------------------ measuring

    def read(self) -> np.ndarray[Any, Any]:
        """Return one distance of each channel, m, (channel,); NaN where a sensor has none."""
        for samples in self.stream(block=1):
            return np.asarray(samples.values[:, 0])
        raise InstrumentError("The stream ended before its first sample", code="stream.ended")

    def stream(self, channels: Sequence[str] | None = None, *, block: int | None = None) -> Iterator[Samples]:
        """Yield blocks of samples of all channels, aligned by their counters, until the caller stops.

        Parameters
        ----------
        channels : sequence of str, optional
            Channels, in this order; default: all five.
        block : int, optional
            Samples in a block; default: half a second.

        Yields
        ------
        Samples
            ``values`` (channel, block) in m. Sample 0 is the same instant for all. Reasons of missing values start
            with the channel; ``dropped`` counts the instants at which any channel lost its sample.

        Raises
        ------
        InstrumentTimeoutError
            A channel sends no data; the message names it.
        InstrumentError
            Unknown channel, frame not open, or a connection is lost; the message names the channel.
        """
        names = self.channels if channels is None else tuple(channels)
        sensors = self._open_sensors()
        if not names or len(set(names)) < len(names) or any(name not in sensors for name in names):
            raise InstrumentError(
                f"Expected some of the channels {', '.join(CHANNELS)}, each once; found {names}",
                code="frame.channels.unknown",
            )
        if self._streaming:
            raise InstrumentError("The frame is already streaming; close that stream first", code="stream.running")
        size = block or max(1, round(BLOCK_SECONDS * self.rate))
        return self._stream({name: sensors[name] for name in names}, size)

    def _stream(self, sensors: dict[str, Any], size: int) -> Iterator[Samples]:
        blocks = sampling.synchronised if self.settings.synchronised else sampling.polled
        self._streaming = True
        try:
            yield from blocks(sensors, size, self.rate)
        finally:
            self._streaming = False

    def _choice(self, name: str, settings: FrameSettings) -> tuple[Any, Any]:
        """Return the driver of a channel and its settings."""
        if settings.sensors:
            return settings.sensor(name)
        shared = {key: getattr(settings, key) for key in SensorSettings.model_fields}
        return OptoNCDT, OptoSettings(range=settings.range, **shared)

    def _open_sensors(self) -> dict[str, Any]:
        if not self._sensors:
            raise InstrumentError(
                "The five_sensor_frame is not open: use it in a 'with' block, or call open() first",
                code="instrument.not_open",
            )
        return self._sensors
