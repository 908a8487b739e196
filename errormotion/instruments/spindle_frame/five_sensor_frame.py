"""Five point sensors around a bar in the spindle (ISO 230-3), on one clock.

X1 and Y1 look at the level L1 of the bar, X2 and Y2 at L2, Z at its end face. The first channel of a stream is the
master of the others: they are started first, and it last, so that sample 0 is the same instant for all.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.instruments.point_lds.optoncdt.codec import LOST, OFFSET, OVERRUN, SCALE
from errormotion.instruments.point_lds.optoncdt.driver import BLOCK_SECONDS, OptoNCDT, count_reasons
from errormotion.instruments.point_lds.optoncdt.settings import OptoSettings, SensorSettings
from errormotion.instruments.spindle_frame.geometry import frame_geometry
from errormotion.instruments.spindle_frame.settings import CHANNELS, FrameSettings
from errormotion.instruments.transports import parse_address
from errormotion.instruments.transports.recording import read_index, write_index
from errormotion.plugins import Identity, InstrumentInfo, Samples

WARM_UP = 2 * 3600.0
"""Seconds until a sensor has settled after it was switched on: 10.5 um in 2 h (Geiselhart et al. 2025)."""


class FiveSensorFrame:
    """Five optoNCDT sensors X1 X2 Y1 Y2 Z in a frame around a bar.

    Parameters
    ----------
    address : str
        Of the frame as a whole, where the settings do not give one for each sensor: ``sim://cframe?seed=3`` stands for
        ``sim://cframe/X1?seed=3`` and so on; ``replay://session.rec`` is a recording of all five.
    settings : FrameSettings, optional
    record : Path, optional
        ``session.rec`` names the recordings of the sensors, which lie beside it: ``session.X1.rec`` and so on.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="five_sensor_frame",
        kind="spindle_frame",
        summary="Five optoNCDT sensors X1 X2 Y1 Y2 Z around a bar in the spindle, on one clock",
        status="simulated_only",
        simulator=OptoNCDT.info.simulator,
    )
    Settings: ClassVar[type[FrameSettings]] = FrameSettings
    channels = CHANNELS

    def __init__(self, address: str = "", settings: FrameSettings | None = None, *, record: Path | None = None) -> None:
        self.address = address
        self.settings = FrameSettings() if settings is None else settings
        self.geometry = frame_geometry(self.settings)
        self._record = record
        self._sensors: dict[str, OptoNCDT] = {}
        self._streaming = False

    @property
    def rate(self) -> float:
        """Samples per second of each channel."""
        return self.settings.rate

    @property
    def encoding(self) -> dict[str, Any]:
        """How distances are kept without loss: the 16-bit numbers that came over the wire."""
        return {
            "dtype": "uint16",
            "scale_factor": SCALE * self.settings.range,
            "add_offset": -OFFSET * self.settings.range,
            "_FillValue": 65535,
        }

    @property
    def addresses(self) -> dict[str, str]:
        """URL of each sensor."""
        if self.settings.addresses:
            return dict(self.settings.addresses)
        if not self.address:
            raise InstrumentError(
                "The five_sensor_frame needs 'addresses' in its settings, one URL for each of " + ", ".join(CHANNELS)
            )
        place = parse_address(self.address)
        if place.scheme == "sim":
            return {name: place.with_path(name) for name in CHANNELS}
        if place.scheme == "replay":
            return {name: f"replay://{path}" for name, path in read_index(Path(place.path)).items()}
        raise InstrumentError(
            f"'{self.address}' is the address of one device, but five sensors are connected: give 'addresses' in the "
            "settings, one URL for each of " + ", ".join(CHANNELS)
        )

    # ------------------------------------------------------------------ opening and closing

    def open(self) -> None:
        """Connect and configure all five sensors; idempotent.

        Raises
        ------
        InstrumentError
            Names the channel that is not there.
        """
        if self._sensors:
            return
        records = {} if self._record is None else write_index(self._record, CHANNELS)
        settings = OptoSettings(**{name: getattr(self.settings, name) for name in SensorSettings.model_fields})
        sensors: dict[str, OptoNCDT] = {}
        try:
            for name, address in self.addresses.items():
                sensor = sensors[name] = OptoNCDT(address, settings, record=records.get(name))
                sensor.name = name
                try:
                    sensor.open()
                except InstrumentError as error:
                    raise type(error)(f"Channel {name}: {error}") from error
        except BaseException:
            for sensor in sensors.values():
                with suppress(InstrumentError):
                    sensor.close()
            raise
        self._sensors = sensors

    def close(self) -> None:
        """Disconnect all sensors and end every thread; idempotent."""
        sensors, self._sensors = self._sensors, {}
        _stop(list(sensors.values()))
        errors: list[InstrumentError] = []
        for sensor in sensors.values():
            try:
                sensor.close()
            except InstrumentError as error:
                errors.append(error)
        if errors:
            raise errors[0]

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
            return
        with suppress(InstrumentError):  # what happened inside says more
            self.close()

    # ------------------------------------------------------------------ asking

    def identify(self) -> Identity:
        """Ask all sensors who they are."""
        parts = {name: sensor.identify() for name, sensor in self._open_sensors().items()}
        return Identity(
            manufacturer="Micro-Epsilon",
            model="five_sensor_frame with " + ", ".join(sorted({part.model for part in parts.values()})),
            serial_number=", ".join(f"{name} {part.serial_number}" for name, part in parts.items()),
            firmware=", ".join(sorted({part.firmware for part in parts.values()})),
            simulated=any(part.simulated for part in parts.values()),
            details={
                "address": self.address or ", ".join(self.addresses.values()),
                "channels": {name: dict(part.details) for name, part in parts.items()},
            },
        )

    def configure(self, settings: FrameSettings) -> None:
        """Send other settings to all sensors; their addresses stay."""
        single = OptoSettings(**{name: getattr(settings, name) for name in SensorSettings.model_fields})
        for sensor in self._open_sensors().values():
            sensor.configure(single)
        self.settings = settings
        self.geometry = frame_geometry(settings)

    @property
    def warm(self) -> bool:
        """Whether all sensors have been on for two hours, by their own account or by ``powered_since``.

        False where nobody knows.
        """
        since = self.settings.powered_since
        known = 0.0 if since is None else (datetime.now(UTC) - since).total_seconds()
        return all(max(known, sensor.on_for()) >= WARM_UP for sensor in self._open_sensors().values())

    # ------------------------------------------------------------------ measuring

    def read(self) -> np.ndarray[Any, Any]:
        """Return one distance of each channel, m, (channel,); NaN where a sensor has none."""
        for samples in self.stream(block=1):
            return np.asarray(samples.values[:, 0])
        raise InstrumentError("The stream ended before its first sample")

    def stream(self, channels: Sequence[str] | None = None, *, block: int | None = None) -> Iterator[Samples]:
        """Yield blocks of samples of all channels, aligned by their counters, until the caller stops.

        Parameters
        ----------
        channels : sequence of str, optional
            Which channels, in this order; default: all five.
        block : int, optional
            Samples in a block; default: half a second.

        Yields
        ------
        Samples
            ``values`` (channel, block) in m. Sample 0 is the same instant for all. Reasons of missing values begin
            with the channel; ``dropped`` counts the instants at which any channel lost its sample.

        Raises
        ------
        InstrumentTimeoutError
            A channel stalls; names it.
        InstrumentError
            Unknown channel, not open, a connection breaks; names the channel.
        """
        names = self.channels if channels is None else tuple(channels)
        sensors = self._open_sensors()
        if not names or len(set(names)) < len(names) or any(name not in sensors for name in names):
            raise InstrumentError(f"Expected some of the channels {', '.join(CHANNELS)}, each once; found {names}")
        if self._streaming:
            raise InstrumentError("The frame is streaming already; leave that stream first")
        size = block or max(1, round(BLOCK_SECONDS * self.rate))
        return self._blocks([sensors[name] for name in names], size)

    def _blocks(self, sensors: list[OptoNCDT], size: int) -> Iterator[Samples]:
        master, *slaves = sensors
        first = 0
        try:
            self._streaming = True
            for slave in slaves:
                slave.start(size, "SLAVE")
            master.start(size, "MASTER" if slaves else "NONE")
            while True:
                values = np.empty((len(sensors), size))
                reasons = np.empty((len(sensors), size), dtype=np.uint8)
                for row, sensor in enumerate(sensors):
                    sensor.fill(values[row], reasons[row])
                yield self._samples(sensors, values, reasons, first)
                first += size
        finally:
            self._streaming = False
            _stop(sensors)

    def _samples(
        self, sensors: list[OptoNCDT], values: np.ndarray[Any, Any], reasons: np.ndarray[Any, Any], first: int
    ) -> Samples:
        dropped, invalid = 0, {}
        if reasons.any():
            dropped = int(np.isin(reasons, (LOST, OVERRUN)).any(axis=0).sum())
            for sensor, why in zip(sensors, reasons, strict=True):
                invalid.update(count_reasons(why, f"{sensor.name} ")[1])
        return Samples(values, first, self.rate, max(sensor.host_time for sensor in sensors), dropped, invalid)

    def _open_sensors(self) -> dict[str, OptoNCDT]:
        if not self._sensors:
            raise InstrumentError("The five_sensor_frame is not open: use it in a 'with' block, or call open() first")
        return self._sensors


def _stop(sensors: list[OptoNCDT]) -> None:
    """Stop the master first, then its slaves, while nobody is held back by a full queue."""
    for sensor in sensors:
        sensor.drain()
    end = time.monotonic() + 1.0
    for sensor in sensors:
        sensor.stop(max(end - time.monotonic(), 0.05))
