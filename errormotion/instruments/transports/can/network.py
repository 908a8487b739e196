"""A CAN bus: sending frames, receiving frames by identifier, and loss of the bus; live or from a recording.

A recording contains the frames of subscribed identifiers: four bytes of identifier, as in SocketCAN (bit 29: an error
frame), then the data. `MARK` is not a frame: it states that the driver waits for new frames from there on.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import suppress

import can

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ReplayError
from errormotion.instruments.transports.address import Address, parse_address
from errormotion.instruments.transports.recording import Recorder, ReplayTransport

logging.getLogger("can").addHandler(logging.NullHandler())  # errors raised here contain its messages

ERROR_FRAME = 0x20000000
BUS_OFF = 0x40
"""Bit in the identifier of an error frame: the controller is off the bus."""
MARK = b"\xff\xff\xff\xff"
_CYCLE = 0.05  # s, time limit for one receive of the listening thread, for which closing waits
_REPLAY_INTERVAL = 0.001  # s

Receive = Callable[[bytes], None]
Reset = Callable[[], None]


class Network:
    """A bus that sends and receives frames.

    Parameters
    ----------
    address : Address
    recorder : Recorder or None

    Attributes
    ----------
    failed : str
        Reason why the bus can no longer be used; empty while it can.

    Raises
    ------
    InstrumentError
        The bus cannot be opened.
    """

    def __init__(self, address: Address, recorder: Recorder | None) -> None:
        self.failed = ""
        self._recorder = recorder
        self._receivers: dict[int, Receive] = {}
        self._order = threading.Lock()  # sending and receiving of frames exclude each other
        self._stopped = threading.Event()
        self._open(address)
        self._thread = threading.Thread(target=self._listen, name="can-listen", daemon=True)
        self._thread.start()

    def subscribe(self, identifier: int, receive: Receive) -> None:
        """Pass frames with an identifier to ``receive(data)``, in the listening thread."""
        self._receivers[identifier] = receive

    def send(self, identifier: int, data: bytes, reset: Reset | None = None) -> None:
        """Send a frame.

        Parameters
        ----------
        identifier : int
        data : bytes
        reset : callable, optional
            Called after all frames before this one were received, and before any later frame.

        Raises
        ------
        can.CanError, OSError
            The bus is lost.
        """
        with self._order:
            self._play_due()
            if reset is not None:
                reset()
            self._note_sent(to_bytes(identifier, data))
            self._put(identifier, data)

    def mark(self, reset: Reset) -> None:
        """Call ``reset`` as in `send`, and record that the driver waits for new frames from there on."""
        with self._order:
            self._play_due()
            reset()
            self._note_sent(MARK)

    def close(self) -> None:
        """Close the connection to the bus; idempotent."""
        self._stopped.set()
        self._thread.join()
        self._end()

    def _open(self, address: Address) -> None:
        further = {k: int(v) if v.isdigit() else v for k, v in address.params.items() if k != "node"}
        try:
            self._bus = can.Bus(interface=address.host, channel=address.path, ignore_config=True, **further)  # type: ignore[arg-type]
        except (can.CanError, OSError, ValueError, TypeError, ImportError, NotImplementedError) as error:
            raise InstrumentError(
                f"The CAN bus '{address.url}' cannot be opened: {error}", code="connection.not_opened"
            ) from None

    def _listen(self) -> None:
        while not self._stopped.is_set():
            try:
                message = self._bus.recv(_CYCLE)
            except (can.CanError, OSError) as error:
                self.failed = f"the bus is lost: {error}"
                return
            if message is None:
                continue
            if message.is_error_frame:
                self._on_error_frame(message.arbitration_id)
            elif not (message.is_extended_id or message.is_remote_frame):
                with self._order:
                    self._on_frame(message.arbitration_id, bytes(message.data))

    def _put(self, identifier: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def _note_sent(self, frame: bytes) -> None:
        if self._recorder is not None:
            self._recorder.frame("W", frame)

    def _play_due(self) -> None:
        """Receive the frames that a recording has before the next frame that is sent."""

    def _on_frame(self, identifier: int, data: bytes) -> None:
        receive = self._receivers.get(identifier)
        if receive is None:
            return
        if self._recorder is not None:
            self._recorder.frame("R", to_bytes(identifier, data))
        receive(data)

    def _on_error_frame(self, identifier: int) -> None:
        if self._recorder is not None:
            self._recorder.frame("R", to_bytes(identifier | ERROR_FRAME, b""))
        if identifier & BUS_OFF:
            self.failed = "the controller is bus-off"

    def _end(self) -> None:
        with suppress(can.CanError, OSError):  # it is not used any further
            self._bus.shutdown()


class ReplayedNetwork(Network):
    """Replays the frames of a recorded session."""

    def __init__(self, frames: ReplayTransport) -> None:
        self._frames = frames
        self._ended = False
        super().__init__(parse_address(frames.url), None)

    def _open(self, address: Address) -> None:
        pass

    def _put(self, identifier: int, data: bytes) -> None:
        pass

    def _note_sent(self, frame: bytes) -> None:
        self._frames.write(frame)  # must be the next recorded one

    def _listen(self) -> None:
        while not self._stopped.wait(_REPLAY_INTERVAL):
            with self._order:
                self._play_due()

    def _end(self) -> None:
        if not self._ended:
            self._ended = True
            self._play_due()

    def _play_due(self) -> None:
        with suppress(InstrumentTimeoutError, ReplayError):  # the next one follows a request, or there is none
            while frame := self._frames.read(timeout=0.0):
                identifier = int.from_bytes(frame[:4], "big")
                if identifier & ERROR_FRAME:
                    self._on_error_frame(identifier & ~ERROR_FRAME)
                else:
                    self._on_frame(identifier, frame[4:])


def to_bytes(identifier: int, data: bytes) -> bytes:
    """Return a frame in the format of a recording."""
    return identifier.to_bytes(4, "big") + data
