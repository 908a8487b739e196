"""Driver of MTConnect agents: the present state of the machine, and all observations."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.controller.mtconnect.choice import choose
from errormotion.instruments.controller.mtconnect.codec import (
    DataItem,
    Device,
    Document,
    Observation,
    parse,
)
from errormotion.instruments.controller.mtconnect.settings import MTConnectSettings
from errormotion.instruments.controller.mtconnect.state import machine_state
from errormotion.instruments.driver import Driver
from errormotion.instruments.transports.http.client import HttpTransport
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject

OUT_OF_RANGE = "OUT_OF_RANGE"
_ATTEMPTS = 3  # to catch up with an agent that overwrites its buffer

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Observed:
    """Observations in the order of their sequence numbers, and the number of lost ones before them.

    Attributes
    ----------
    observations : tuple of Observation
        May be empty: an agent without new observations also answers.
    next : int
        Sequence number of the next observation.
    lost : int
        Number of observations, of all devices, that the agent had overwritten before they were requested.
    restarted : bool
        Whether the agent was restarted: its sequence numbers start again, and its earlier observations are lost and not
        counted.
    """

    observations: tuple[Observation, ...]
    next: int
    lost: int = 0
    restarted: bool = False


class MTConnect(Driver):
    """A machine with an MTConnect agent; read-only.

    Parameters
    ----------
    address : str
        ``http://host:5000/device`` (without device if the agent has only one), ``sim://cframe/mtconnect``,
        ``replay://file``.
    settings : MTConnectSettings, optional
    record : Path, optional
        Recording of the session.

    Attributes
    ----------
    lost, restarts : int
        Number of observations that were overwritten before they were read, and of restarts of the agent, since the
        driver was created.
    unclear : mapping of str to str
        Quantities that are unknown because several data items report them equally well, with a message on what to state
        in the settings.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="mtconnect",
        kind="controller",
        summary="Any machine with an MTConnect agent, read-only: positions, spindle, feed, mode, program, alarms",
        status="peer_verified",
        simulator="errormotion.instruments.simulators.controller.mtconnect:SimulatedAgent",
    )
    Settings: ClassVar[type[MTConnectSettings]] = MTConnectSettings
    settings: MTConnectSettings

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit."""
        # Faults of observations do not affect the state, in which an alarm is only a text.
        harmless = ("split", "overrun", "jump", "restart", "alarm")
        return InstrumentSubject(cls, "sim://cframe/mtconnect", harmless=harmless)

    def __init__(self, address: str, settings: MTConnectSettings | None = None, *, record: Path | None = None) -> None:
        super().__init__(address, settings, record=record)
        self.lost = 0
        self.restarts = 0
        self._instance: int | None = None
        self._model_changed = ""
        self._newest = 0  # sequence number after the newest observation of the agent, as last stated
        self._next: int | None = None
        self._buffer_size = 0  # number of observations in the buffer of the agent
        self._started_at: float | None = None
        self._restarted = False  # whether the agent was restarted while the driver was not connected
        self._device = Device("", "")
        self._items: Mapping[str, DataItem] = {}
        self.unclear: Mapping[str, str] = {}

    @property
    def items(self) -> Mapping[str, DataItem]:
        """Data items of the device by id, with type, units and component."""
        return self._device.items

    def identify(self) -> Identity:
        """Return the identity of the device that the agent reports."""
        document = self._query("probe")
        device = self._one(document)
        return Identity(
            manufacturer=device.manufacturer or "unknown",
            model=device.model or device.name,
            serial_number=device.serial_number or device.uuid,
            firmware=f"MTConnect {document.header.version}",
            simulated=self.transport.simulated,
            details={"address": self.address, "device": device.name, "sender": document.header.sender},
        )

    def configure(self, settings: MTConnectSettings) -> None:
        """Use other settings from now on."""
        self._choose(settings)
        self.settings = settings

    def read(self) -> dict[str, Any]:
        """Return the present state, without values that are None."""
        return {name: value for name, value in self.state().items() if value is not None}

    def state(self) -> dict[str, Any]:
        """Return the state of the machine as the agent reports it.

        Returns
        -------
        dict
            ``time`` (s on the agent's clock since the driver was first opened), ``position`` and ``commanded_position``
            (X, Y, Z, m), ``position_time`` (when the position last changed, s on the same clock), ``spindle_speed``
            (1/min), ``spindle_load`` (fraction), ``feed`` (m/s), ``mode`` (``manual``, ``mdi``, ``automatic`` or
            empty), ``program``, ``running``, ``homed`` (None: agents do not report it), ``enabled``, ``estop``,
            ``alarms`` and ``warnings`` (lists of str), ``unavailable``: names of unknown values, and ``reasons``: why a
            value that the agent states is unknown (``1,5`` is not a number), by its name. Unknown numbers are NaN.

        Raises
        ------
        ProtocolError
            The answer is not that of an agent.
        InstrumentTimeoutError
            No answer within the time limit.
        """
        document = self._query("current")
        self._detect_restart(document)
        return machine_state(document, self._items, self._start(document))

    def sample(self) -> Observed:
        """Return the observations since the last call; the first call returns the last value of every data item.

        Raises
        ------
        ProtocolError
            The answer is not that of an agent.
        InstrumentError
            The agent overwrites its buffer faster than it can be read.
        """
        if self._next is None:
            document = self._query("current")
            self._detect_restart(document)
            restarted, self._restarted = self._restarted, False
            return self._take(document, 0, restarted=restarted)
        document = self._query("sample", self._from(), refused=False)
        return self._next_observed(document) or self._resynchronise(document)

    def observations(self, interval: float = 0.1) -> Iterator[Observed]:
        """Yield observations as the agent sends them, starting where `sample` or an earlier stream ended.

        A stream that the agent ends is requested again. During a stream nothing else can be requested on this
        connection.

        Parameters
        ----------
        interval : float
            Minimum interval between two deliveries, s.

        Raises
        ------
        InstrumentTimeoutError
            Neither data nor heartbeat, which is requested at half the time limit.
        ProtocolError, InstrumentError
            See `sample`.
        """
        if self._next is None:
            yield self.sample()
        while True:
            received = False
            query = self._from() | {
                "interval": str(round(1000 * interval)),
                "heartbeat": str(max(1, round(500 * self.settings.timeout))),
            }
            parts = self._http.parts(self._path("sample"), query, limit=self.settings.most_bytes)
            try:
                for part in parts:
                    document, received = parse(part), True
                    observed = self._next_observed(document)
                    if observed is None:
                        break
                    yield observed
            finally:
                parts.close()  # type: ignore[attr-defined]
            if not received:
                raise InstrumentError(f"The agent at {self.address} ended its stream without data", code="stream.ended")
            yield self.sample()

    # ------------------------------------------------------------------ sequence numbers

    def _from(self) -> dict[str, str]:
        count = min(
            self.settings.count, self._buffer_size or self.settings.count
        )  # an agent refuses more than the size of its buffer
        return {"from": str(self._next), "count": str(count)}

    def _next_observed(self, document: Document) -> Observed | None:
        """Return the observations of an answer; None if the sequence numbers must be determined again."""
        assert self._next is not None
        header = document.header
        if header.instance != self._instance or OUT_OF_RANGE in document.errors or 0 < header.next < self._next:
            return None
        self._refuse(document, "sample")
        return self._take(document, max(0, document.header.first - self._next), restarted=False)

    def _take(self, document: Document, lost: int, *, restarted: bool) -> Observed:
        first = 0 if self._next is None else self._next
        fresh = tuple(each for each in document.observations if each.sequence >= first)
        after = fresh[-1].sequence + 1 if fresh else first  # for an agent that does not state the next number
        self._next = max(document.header.next or after, first)
        self._newest = max(self._newest, self._next)
        self._count(lost)
        return Observed(fresh, self._next, lost, restarted)

    def _resynchronise(self, document: Document) -> Observed:
        """Continue at the first observation in the buffer of the agent."""
        lost, restarted = 0, False
        for _ in range(_ATTEMPTS):
            document = self._query("current")
            header = document.header
            assert self._next is not None
            again = self._detect_restart(document)
            if again or self._next > _end(document):  # sequence numbers also indicate a restart
                restarted = True
                self._next = header.first
            elif header.first > self._next:
                lost += header.first - self._next
                self._next = header.first
            document = self._query("sample", self._from(), refused=False)
            if document.header.instance == self._instance and OUT_OF_RANGE not in document.errors:
                self._refuse(document, "sample")
                lost += max(0, document.header.first - self._next)
                return self._take(document, lost, restarted=restarted)
        self._count(lost)
        raise InstrumentError(
            f"The agent at {self.address} overwrites its {document.header.buffer} observations faster than they can be "
            "requested; configure a larger buffer or fewer data items",
            code="mtconnect.buffer.too_small",
        )

    def _count(self, lost: int) -> None:
        if lost:
            self.lost += lost
            log.warning("%s: %d observations were overwritten before they were requested", self.address, lost)

    def _detect_restart(self, document: Document) -> bool:
        """Read the description of the device again if the agent was restarted; return whether it was.

        An agent without a clock may have the same instance again: then its sequence numbers begin anew. A description
        that has changed without a restart is read again, too.
        """
        header = document.header
        again = header.instance != self._instance or _end(document) < self._newest
        self._newest = _end(document)
        if not again:
            if header.model_changed != self._model_changed:
                log.warning("%s: the description of the device has changed", self.address)
                self._examine()
            return False
        self.restarts += 1
        log.warning("%s: the agent was restarted", self.address)
        self._examine()
        if self._next is not None:
            self._next = document.header.first
        return True

    # ------------------------------------------------------------------ values

    def _start(self, document: Document) -> float:
        if self._started_at is None:
            self._started_at = document.header.created
        return self._started_at

    # ------------------------------------------------------------------ requests

    @property
    def _http(self) -> HttpTransport:
        transport = self.transport
        assert isinstance(transport, HttpTransport)
        return transport

    def _path(self, request: str) -> str:
        target = self._http.target
        device = target.path if target.scheme in ("http", "tcp") else ""
        return f"/{device}/{request}" if device else f"/{request}"

    def _query(self, request: str, query: Mapping[str, str] | None = None, *, refused: bool = True) -> Document:
        answer = self._http.get(self._path(request), query, limit=self.settings.most_bytes)
        try:
            document = parse(answer.body)
        except ProtocolError as error:
            if answer.status != 200:
                raise ProtocolError(
                    f"The server at {self.address} answers '{request}' with HTTP status {answer.status} without a "
                    "document of MTConnect. Check the address, its port and path",
                    code="protocol.http.status",
                ) from None
            raise ProtocolError(f"{self.address}/{request}: {error}", code=error.code) from None
        self._buffer_size = document.header.buffer
        if refused:
            self._refuse(document, request)
        return document

    def _refuse(self, document: Document, request: str) -> None:
        if document.errors:
            errors = "; ".join(f"{code}: {text}" for code, text in document.errors.items())
            raise InstrumentError(
                f"The agent at {self.address} refuses '{request}': {errors}", code="instrument.refused"
            )

    def _one(self, document: Document) -> Device:
        if len(document.devices) != 1:
            names = ", ".join(device.name or device.uuid for device in document.devices) or "none"
            raise InstrumentError(
                f"The agent at {self.address} has the devices {names}; state one in the address, as in "
                "http://HOST:5000/DEVICE",
                code="mtconnect.device.ambiguous",
            )
        return document.devices[0]

    def _examine(self) -> None:
        document = self._query("probe")
        self._instance, self._model_changed = document.header.instance, document.header.model_changed
        self._device = self._one(document)
        self._choose(self.settings)
        self._start(document)

    def _choose(self, settings: MTConnectSettings) -> None:
        """Assign the data items, and log quantities that could not be assigned."""
        choice = choose(self._device, settings)
        for key, item in choice.items.items():
            if item.category == "SAMPLE":
                _ = item.scale  # unknown units are reported now
            if key.startswith("position") and item.coordinate_system not in ("MACHINE", ""):
                log.warning(
                    "%s: '%s' is in the coordinate system %s, not of the machine: '%s'",
                    self.address,
                    key,
                    item.coordinate_system,
                    item.id,
                )
        for text in choice.unclear.values():
            log.warning("%s: %s", self.address, text)
        self._items, self.unclear = choice.items, choice.unclear

    def _connect(self) -> HttpTransport:
        return HttpTransport(
            self.address, simulator=self.info.simulator, recorder=self._record, timeout=self.settings.timeout
        )

    def _start_session(self) -> None:
        before = self._instance
        self._examine()
        if before is not None and before != self._instance:
            self.restarts += 1
            self._next, self._restarted = None, True


def _end(document: Document) -> int:
    """Return the sequence number after the newest observation of the agent."""
    header = document.header
    newest = document.observations[-1].sequence if document.observations else -1
    return header.next or max(header.last, newest) + 1
