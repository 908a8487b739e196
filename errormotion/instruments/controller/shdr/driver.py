"""Driver of SHDR adapters: the state of the machine, from the text that an MTConnect agent would read."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError, ReplayError
from errormotion.instruments.controller.shdr.codec import (
    PING,
    Command,
    Keys,
    Lines,
    Observed,
    parse_line,
    pong,
)
from errormotion.instruments.controller.shdr.memory import Memory
from errormotion.instruments.controller.shdr.settings import (
    ANGLES,
    DEFAULT_ITEMS,
    FEEDS,
    LENGTHS,
    LOADS,
    SPEEDS,
    ShdrSettings,
)
from errormotion.instruments.driver import Driver
from errormotion.instruments.transports import Transport
from errormotion.instruments.transports.reconnecting import ReconnectingTransport, open_reconnecting
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject

MAX_COMMANDS = 100  # largest number of statements of an adapter about itself
QUIET = 0.1  # s without data after which an adapter has sent the present values
_MODES = {"AUTOMATIC": "automatic", "SEMI_AUTOMATIC": "automatic", "MANUAL": "manual", "MANUAL_DATA_INPUT": "mdi"}
_TEXTS = ("mode", "program", "execution", "estop", "availability")

log = logging.getLogger(__name__)


class Shdr(Driver):
    """A machine with an SHDR adapter; read-only: only ``* PING`` is sent.

    The values of all keys are stored as received. Each reading first processes the received data, up to the answer to a
    ``* PING``. A connection that is lost, or was not read for longer than its heartbeat, is opened again by the next
    reading, and all values are unknown until the adapter has sent them again.

    Parameters
    ----------
    address : str
        ``tcp://host:7878``, ``sim://cframe/shdr``, ``replay://file``.
    settings : ShdrSettings, optional
    record : Path, optional
        Recording of the session.

    Attributes
    ----------
    heartbeat : float
        Heartbeat that the adapter requires, s; infinite if it does not answer ``* PING``.
    malformed : int
        Number of lines that were ignored because they do not follow the protocol (``lenient``), and of values that
        could not be told from their line.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="shdr",
        kind="controller",
        summary="Any machine with an SHDR adapter (text protocol of MTConnect), read-only: positions, spindle, alarms",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.controller.shdr:SimulatedAdapter",
    )
    Settings: ClassVar[type[ShdrSettings]] = ShdrSettings
    settings: ShdrSettings

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit."""
        return InstrumentSubject(
            cls, "sim://cframe/shdr?style=vmc", settings={"timeout": 0.7}, harmless=("split", "alarm", "late")
        )

    def __init__(self, address: str, settings: ShdrSettings | None = None, *, record: Path | None = None) -> None:
        super().__init__(address, settings, record=record)
        self.heartbeat = math.inf
        self.malformed = 0
        self._lines = Lines()
        self._about: dict[str, str] = {}
        self._memory = Memory()
        self._last_data = self._last_ping = time.monotonic()
        self._fresh = True
        self._assign()

    @property
    def values(self) -> Mapping[str, str]:
        """Last value of each key, as received."""
        return {key: each.value for key, each in self._memory.values.items()}

    def identify(self) -> Identity:
        """Return the identity of the device that its adapter reports."""
        about = self._about
        return Identity(
            manufacturer=about.get("manufacturer", "unknown"),
            model=about.get("device", "SHDR adapter"),
            serial_number=about.get("serialNumber", "unknown"),
            firmware=f"adapter {about.get('adapterVersion', 'unknown')}",
            simulated=self.transport.simulated,
            details={"address": self.address, "heartbeat": self.heartbeat, "keys": len(self._memory.values)},
        )

    def configure(self, settings: ShdrSettings) -> None:
        """Use other settings from now on."""
        self.settings = settings
        self._assign()

    def read(self) -> dict[str, Any]:
        """Return the present state, without values that are None."""
        return {name: value for name, value in self.state().items() if value is not None}

    def state(self) -> dict[str, Any]:
        """Return the state of the machine as the adapter reports it.

        Returns
        -------
        dict
            ``time`` (of the newest line, s on the adapter's clock since the driver was first opened; NaN where the
            adapter sends no times), ``position`` and ``commanded_position`` (X, Y, Z, m), ``position_time`` (when the
            position last changed, s on the same clock), ``spindle_speed`` (1/min), ``spindle_load`` (fraction),
            ``feed`` (m/s), ``mode`` (``manual``, ``mdi``, ``automatic`` or empty), ``program``, ``running``, ``homed``
            (None: adapters do not report it), ``enabled``, ``estop``, ``alarms`` and ``warnings`` (lists of str),
            ``temperatures`` (degC) and ``angles`` (rad) by the names in the settings, ``unavailable``: names of what is
            unknown, and ``reasons``: why a value that the adapter sends is unknown, by its key. Unknown numbers are
            NaN.

        Raises
        ------
        InstrumentTimeoutError
            No answer to ``* PING`` within the time limit.
        ProtocolError
            A line that is not of the protocol (unless ``lenient``).
        InstrumentError
            The connection is lost.
        """
        self._update()
        self._reasons = dict(self._memory.doubtful)
        settings, memory = self.settings, self._memory
        position, moved = self._position("position")
        numbers = {
            "spindle_speed": self._number(self._items["spindle_speed"], SPEEDS[settings.speed_unit]),
            "spindle_load": self._number(self._items["spindle_load"], LOADS[settings.load_unit]),
            "feed": self._number(self._items["feed"], FEEDS[settings.feed_unit]),
        }
        text = {key: memory.text(self._items[key]) for key in _TEXTS}
        state: dict[str, Any] = {
            "time": memory.newest - memory.started,
            "position": position,
            "commanded_position": self._position("commanded_position")[0],
            "position_time": moved - memory.started,
            **numbers,
            "mode": _MODES.get(text["mode"], ""),
            "program": text["program"],
            "running": text["execution"] == "ACTIVE",
            "homed": None,
            "enabled": text["availability"] == "AVAILABLE" and text["estop"] != "TRIGGERED",
            "estop": text["estop"] == "TRIGGERED",
            "alarms": memory.reported("FAULT"),
            "warnings": memory.reported("WARNING"),
            "temperatures": {
                name: _celsius(self._number(key), settings.temperature_unit)
                for name, key in settings.temperatures.items()
            },
            "angles": {name: self._number(key, ANGLES[settings.angle_unit]) for name, key in settings.angles.items()},
        }
        state["unavailable"] = [
            *(key for key in ("position", "commanded_position") if any(math.isnan(x) for x in state[key])),
            *(key for key, value in numbers.items() if math.isnan(value)),
            *(
                f"{kind}.{name}"
                for kind in ("temperatures", "angles")
                for name, x in state[kind].items()
                if math.isnan(x)
            ),
            *(key for key, value in text.items() if not value),
        ]
        state["reasons"] = self._reasons
        return state

    # ------------------------------------------------------------------ values

    def _assign(self) -> None:
        settings = self.settings
        self._items = {**DEFAULT_ITEMS, **settings.items}
        mark = f"{settings.device}:" if settings.device else ""
        used = (*self._items.values(), *settings.temperatures.values(), *settings.angles.values())
        stated = (settings.conditions, settings.messages, settings.series, [f"{mark}{key}" for key in used])
        self._keys = Keys(*(frozenset(each) for each in stated))

    def _number(self, key: str, scale: float = 1.0) -> float:
        found = self._memory.numbers(key, self._reasons)
        if len(found) > 1:
            self._reasons[key] = f"expected one number; found '{self._memory.text(key)[:40]}'"
            return math.nan
        return found[0] * scale

    def _position(self, quantity: str) -> tuple[list[float], float]:
        """Return X, Y, Z in m, and the time of their last change, s since 1970."""
        scale, memory = LENGTHS[self.settings.length_unit], self._memory
        whole = self._items.get(quantity, "")
        if whole in memory.values:
            found = [scale * x for x in memory.numbers(whole, self._reasons)]
            return (found[:3] if len(found) >= 3 else [math.nan] * 3), memory.values[whole].time
        keys = [self._items[f"{quantity}.{axis}"] for axis in "XYZ"]
        return [self._number(key, scale) for key in keys], memory.changed(keys)

    # ------------------------------------------------------------------ lines

    def _process(self, data: bytes) -> bool:
        """Process received bytes; return whether they contain ``* PONG``."""
        answered = False
        wrong: ProtocolError | None = None
        for line in self._lines.feed(data):
            try:
                observations = parse_line(line, self._keys)
            except ProtocolError as error:
                self.malformed += 1
                wrong = wrong or error
                continue
            if isinstance(observations, Command):
                answered = self._command(observations) or answered
            else:
                for observed in filter(None, map(self._of_device, observations)):
                    self._memory.store(observed)
                    if observed.doubt:
                        self.malformed += 1
                        log.warning("%s: key '%s' is unknown: %s", self.address, observed.key, observed.doubt)
        if wrong and not self.settings.lenient:
            raise ProtocolError(
                f"{self.address}: {wrong}; set 'lenient' to ignore and count such lines", code=wrong.code
            )
        if wrong:
            log.warning("%s: %s; the line was ignored", self.address, wrong)
        return answered

    def _command(self, command: Command) -> bool:
        period = pong(command)
        if period is not None:
            self.heartbeat = period or math.inf
            return True
        if len(self._about) < MAX_COMMANDS:
            self._about[command.name[:100]] = command.value[:1000]
        return False

    def _of_device(self, observed: Observed) -> Observed | None:
        """Return a value without the name of its device; None if it belongs to another device."""
        mark = f"{self.settings.device}:" if self.settings.device else ""
        return replace(observed, key=observed.key.removeprefix(mark)) if observed.key.startswith(mark) else None

    # ------------------------------------------------------------------ connection

    def _update(self) -> None:
        """Process everything that the adapter has sent up to now."""
        try:
            self._renew()
            if self._silent:
                self._drain(0.0)
                if time.monotonic() - self._last_data > self.settings.silence:
                    raise InstrumentTimeoutError(
                        f"{self.address}: no data for {self.settings.silence:g} s", code="instrument.no_answer"
                    )
                return
            self._ping()
            if self._fresh:
                self._drain(QUIET)  # the present values may follow the first answer
            self._fresh = False
        except InstrumentError as error:
            self._forget(str(error))
            raise

    @property
    def _silent(self) -> bool:
        return not self._fresh and math.isinf(self.heartbeat)

    def _renew(self) -> None:
        """Drop a connection that the adapter may have closed: it waits for two heartbeats at most."""
        if time.monotonic() - self._last_ping > self.heartbeat and isinstance(self.transport, ReconnectingTransport):
            self._forget("it was not read for longer than its heartbeat")

    def _forget(self, reason: str) -> None:
        self._lines.clear()
        self._memory.clear()
        self._fresh = True
        if isinstance(self._transport, ReconnectingTransport):
            self._transport.drop(f"The connection to {self.address} was closed: {reason}")

    def _ping(self) -> None:
        self.transport.write(PING)
        self._last_ping = time.monotonic()
        end, received = self._last_ping + self.settings.timeout, 0
        while True:
            left = end - time.monotonic()
            if left <= 0:
                break
            try:
                data = self.transport.read(timeout=left)
            except InstrumentTimeoutError:
                break
            self._last_data = time.monotonic()
            received += len(data)
            if self._process(data):
                return
        if not (self._fresh and self._memory.values):
            others = f", but {received} bytes of other lines" if received else "; is it an SHDR adapter?"
            raise InstrumentTimeoutError(
                f"{self.address}: no answer to '* PING' within {self.settings.timeout:g} s{others}",
                code="instrument.no_answer",
            )
        self.heartbeat = math.inf
        log.warning("%s: the adapter has no heartbeat; values expire after %g s", self.address, self.settings.silence)

    def _drain(self, quiet: float) -> None:
        """Process data until none arrive for ``quiet`` s, at most for the time limit."""
        end = time.monotonic() + self.settings.timeout
        while time.monotonic() < end:
            try:
                data = self.transport.read(timeout=quiet)
            except (InstrumentTimeoutError, ReplayError):
                return
            self._last_data = time.monotonic()
            self._process(data)

    def _connect(self) -> Transport:
        return open_reconnecting(
            self.address,
            simulator=self.info.simulator,
            record=self._record,
            timeout=self.settings.timeout,
        )

    def _start_session(self) -> None:
        self._lines.clear()
        self._memory.clear()  # of an earlier session
        self._fresh, self.heartbeat = True, math.inf
        self._update()


def _celsius(value: float, unit: str) -> float:
    if unit == "degF":
        return (value - 32.0) / 1.8
    return value - 273.15 if unit == "K" else value
