"""TCP lines of simulated devices that are disturbed on request, all served by one thread, by a clock of any rate."""

import random
import selectors
import socket
import threading
from contextlib import suppress
from types import TracebackType
from typing import Self

import numpy as np

from errormotion.campaign.monitor.clock import Clock
from errormotion.instruments.thermometer.dcon import checksum

MAX_READINGS = 190_000
"""Readings of one module: numbers up to here are temperatures that the log of a monitor admits."""
POLL_INTERVAL, EVENT_POLL = 0.005, 0.02  # s


class FastClock(Clock):
    """A clock that advances to the next deadline while all threads wait; else at a multiple of the computer's rate.

    Parameters
    ----------
    speed : float
        Rate while a thread works, as while an instrument is awaited.
    threads : int
        Number of threads that wait by this clock.
    """

    def __init__(self, speed: float, threads: int) -> None:
        self.speed = speed
        self._threads = threads
        self._start = super().now()
        self._skipped = 0.0
        self._due: dict[int, float] = {}
        self._change = threading.Condition()

    def now(self) -> float:
        """Return the time, s."""
        with self._change:
            return (super().now() - self._start) * self.speed + self._skipped

    def sleep(self, seconds: float) -> None:
        """Wait."""
        self.wait(threading.Event(), seconds)

    def wait(self, event: threading.Event, seconds: float) -> None:
        """Wait for an event."""
        due, own = self.now() + seconds, threading.get_ident()
        with self._change:
            self._due[own] = due
            while not event.is_set() and (left := due - self.now()) > 0:
                if len(self._due) == self._threads and (ahead := min(self._due.values()) - self.now()) > 0:
                    self.leap(ahead)
                    continue
                self._change.wait(min(left / self.speed, EVENT_POLL))
            del self._due[own]

    def leap(self, seconds: float) -> None:
        """Advance at once, as the clock of a computer that was suspended."""
        with self._change:
            self._skipped += seconds
            self._change.notify_all()


class Module:
    """A DCON module whose temperatures state the number of the reading, so that each can be recognised in a log.

    Attributes
    ----------
    sent : array
        When each reading was sent, s; NaN where it was not.
    open : bool
        Whether the sensors are disconnected.
    """

    def __init__(self) -> None:
        self.sent = np.full(MAX_READINGS, np.nan)
        self.open = False
        self.count = 0
        self._rest = b""

    def connected(self) -> None:
        """Forget an unfinished request."""
        self._rest = b""

    def answers(self, data: bytes, now: float) -> list[bytes]:
        """Return the answers to the requests that are complete."""
        *requests, self._rest = (self._rest + data).split(b"\r")
        found = []
        for request in requests:
            text = {b"$01M": "!014018", b"$01F": "!01A1.0", b"$012": "!01100640"}.get(request[:-2])
            if text is None:
                self.count += 1
                self.sent[self.count] = np.nan if self.open else now
                text = ">" + 2 * ("+9999.9" if self.open else f"{self.count / 100:+08.2f}")
            found.append((text + checksum(text)).encode() + b"\r")
        return found


class Line:
    """A port with a module behind it, or a device at another address; one connection at a time.

    Attributes
    ----------
    fault : str
        ``silence``, ``garbage``, ``corrupt``, ``late``, ``refuse``, ``open`` or empty.
    until : float
        When it ends, s.
    """

    def __init__(self, name: str, clock: Clock, device: Module | str, seed: int) -> None:
        self.name, self._clock, self.device = name, clock, device
        self.fault, self.until = "", 0.0
        self._next: tuple[str, float] | None = None  # from another thread
        self._random = random.Random(f"{seed} {name}")
        self._held = b""
        self._client: socket.socket | None = None
        self._upstream: socket.socket | None = None
        self._listener: socket.socket | None = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])

    def disturb(self, fault: str, seconds: float) -> None:
        """Start a fault; ``disconnect`` happens once."""
        self._next = fault, self._clock.now() + seconds

    def serve(self, selector: selectors.BaseSelector) -> None:
        """Start or end faults."""
        if self._next is not None:
            (self.fault, self.until), self._next = self._next, None
        over = self._clock.now() >= self.until
        if self.fault == "disconnect" or (self.fault == "refuse" and not over):
            self._hang_up(selector)
        if self.fault == "refuse" and not over and self._listener is not None:
            selector.unregister(self._listener)
            self._listener.close()
            self._listener = None
        if self.fault and (over or self.fault == "disconnect"):
            held, self._held, self.fault = self._held, b"", ""
            if held and self._client is not None:
                self._send(held)
        if self._listener is None and self.fault != "refuse":
            self._listener = socket.create_server(("127.0.0.1", self.port))
            self.listen(selector)
        if isinstance(self.device, Module):
            self.device.open = self.fault == "open"

    def listen(self, selector: selectors.BaseSelector) -> None:
        """Wait for a client."""
        assert self._listener is not None
        self._listener.setblocking(False)
        selector.register(self._listener, selectors.EVENT_READ, lambda: self._accept(selector))

    def close(self, selector: selectors.BaseSelector) -> None:
        """End the line."""
        self._hang_up(selector)
        if self._listener is not None:
            self._listener.close()

    def _accept(self, selector: selectors.BaseSelector) -> None:
        try:
            client, _ = self._listener.accept()  # type: ignore[union-attr]
        except (OSError, AttributeError):  # closed since, or the client has left
            return
        self._hang_up(selector)
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client, self._held = client, b""
        selector.register(client, selectors.EVENT_READ, lambda: self._asked(selector))
        if isinstance(self.device, Module):
            self.device.connected()
        else:
            host, port = self.device.removeprefix("tcp://").split(":")
            self._upstream = socket.create_connection((host, int(port)))
            self._upstream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._upstream.setblocking(False)
            selector.register(self._upstream, selectors.EVENT_READ, lambda: self._answered(selector))

    def _hang_up(self, selector: selectors.BaseSelector) -> None:
        for each in (self._client, self._upstream):
            if each is not None:
                selector.unregister(each)
                each.close()
        self._client = self._upstream = None

    def _received(self, line: socket.socket | None, selector: selectors.BaseSelector) -> bytes:
        data = b""
        if line is not None:
            with suppress(OSError):
                data = line.recv(65536)
            if not data:
                self._hang_up(selector)
        return data

    def _asked(self, selector: selectors.BaseSelector) -> None:
        data = self._received(self._client, selector)
        if data and isinstance(self.device, Module):
            for answer in self.device.answers(data, self._clock.now()):
                self._deliver(answer)
        elif data and self._upstream is not None:
            with suppress(OSError):
                self._upstream.sendall(data)

    def _answered(self, selector: selectors.BaseSelector) -> None:
        if data := self._received(self._upstream, selector):
            self._deliver(data)

    def _deliver(self, data: bytes) -> None:
        if self._clock.now() >= self.until:
            self._send(data)
            return
        if self.fault == "silence":
            return
        if self.fault == "late":
            self._held = self._held or data
            return
        if self.fault == "garbage":
            data = self._random.randbytes(self._random.randint(1, 5)) + data
        if self.fault == "corrupt":
            place = self._random.randrange(len(data) - 1)  # not the end of the line
            data = data[:place] + bytes([data[place] ^ 1 << self._random.randrange(7)]) + data[place + 1 :]
        self._send(data)

    def _send(self, data: bytes) -> None:
        if self._client is not None:
            with suppress(OSError):
                self._client.sendall(data)


class Lines:
    """The thread that serves lines; a context manager."""

    def __init__(self, lines: list[Line]) -> None:
        self._lines = lines
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="disturbed-lines")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        with selectors.DefaultSelector() as selector:
            for line in self._lines:
                line.listen(selector)
            while not self._ended.is_set():
                calls = [key.data for key, _ in selector.select(POLL_INTERVAL)]
                for line in self._lines:
                    line.serve(selector)
                for call in calls:
                    call()
            for line in self._lines:
                line.close(selector)
