"""A wire that disturbs: between a driver and its simulated device, on TCP and on pseudo terminals.

`behind` puts a `Wire` in front of every connection that simulators of this process offer while a context lasts, and
keeps the devices when a driver closes, as a real device would. A wire passes bytes on; at one piece of one direction
it does what its `Fault` says, and is calm from then on. A piece is what is received at once.
"""

import os
import random
import select
import socket
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any
from unittest.mock import patch

from errormotion.instruments import transports
from errormotion.instruments.transports.address import parse_address

KINDS = (
    "delay", "late", "split", "drip", "duplicate", "reorder", "exchange", "corrupt", "lose", "half-open", "cut",
)  # fmt: skip
"""What a wire does to a piece: it comes 0.1 s later, or after the time limit of the driver; in two parts; byte by byte;
twice; after the next one; its halves exchanged; with one byte changed; never; never, as all that follow; and the
connection ends."""
HARMLESS = ("delay", "split", "drip")
"""After these a driver must give right readings, and no error."""
DELAY, LATE, GAP = 0.1, 1.4, 0.002
"""Of `delay`, of `late`, and between the bytes of `drip` and the parts of `split`, s."""
DRIPPED = 12
"""Bytes that come one by one."""
BUFFER = 32768
"""Of a connection, bytes: bounds how far a virtual clock runs ahead of its reader."""
LOADERS = ("", ".reconnecting", ".lines", ".opc", ".http.client")
"""Modules of `errormotion.instruments.transports` that load simulators."""
DOWN, UP = "down", "up"
"""From the device to the driver, and the other way."""


@dataclass
class Fault:
    """What happens once.

    Attributes
    ----------
    kind : str
        One of `KINDS`; "" for a wire that only passes on.
    way : str
        Direction.
    at : int
        Number of the piece in that direction, counted over all connections.
    seed : int
        Of places and values.
    """

    kind: str = ""
    way: str = DOWN
    at: int = 0
    seed: int = 0


@dataclass
class Wire:
    """All connections between a driver and a device, and the one fault of them.

    Attributes
    ----------
    pieces : dict of str to int
        Number of pieces so far, by direction.
    done : bool
        Whether the fault has happened.
    what : str
        What it did, in words.
    calmed : bool
        Whether it only passes on from now, also where it was half-open, or a serial line was cut.
    """

    fault: Fault
    pieces: dict[str, int] = field(default_factory=lambda: {DOWN: 0, UP: 0})
    done: bool = False
    what: str = ""
    calmed: bool = False
    proxies: "list[Proxy]" = field(default_factory=list)
    cut: "Proxy | None" = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def calm(self) -> None:
        """Only pass on from now."""
        self.done = self.calmed = True

    def await_connections(self) -> None:
        """Wait until all connections that the driver has opened have reached the device, as they do without a proxy."""
        end = time.monotonic() + 2.0
        while any(proxy.is_accepting() for proxy in self.proxies) and time.monotonic() < end:
            time.sleep(0.001)

    def due(self, way: str) -> bool:
        """Count a piece; whether the fault happens to it."""
        with self._lock:
            number = self.pieces[way]
            self.pieces[way] += 1
            happens = bool(self.fault.kind) and not self.done and way == self.fault.way and number >= self.fault.at
            self.done = self.done or happens
            return happens

    def deliveries(self, data: bytes) -> list[tuple[float, bytes]]:
        """Return what becomes of the piece to which the fault happens: waiting times (s), and bytes."""
        rng = random.Random(self.fault.seed)
        half = rng.randrange(len(data) + 1)
        self.what = f"{self.fault.kind} of piece {self.fault.at} {self.fault.way}, {data[:40]!r}"
        match self.fault.kind:
            case "delay" | "late":
                return [(DELAY if self.fault.kind == "delay" else LATE, data)]
            case "split":
                return [(0.0, data[:half]), (10 * GAP, data[half:])]
            case "drip":
                first = [(GAP, data[k : k + 1]) for k in range(min(len(data), DRIPPED))]
                return [*first, (GAP, data[DRIPPED:])]
            case "duplicate":
                return [(0.0, data + data)]
            case "exchange":
                return [(0.0, data[half:] + data[:half])]
            case "corrupt":
                place, changed = rng.randrange(len(data)), bytearray(data)
                digit = chr(changed[place]).isdigit() and rng.random() < 0.5
                changed[place] = rng.choice(b"0123456789") if digit else changed[place] ^ 1 << rng.randrange(8)
                self.what += f": byte {place} becomes {bytes(changed[place : place + 1])!r}"
                return [(0.0, bytes(changed))]
        return []  # lose, half-open, cut, reorder


class Proxy:
    """One line of a device, as a server of its own."""

    def __init__(self, url: str, wire: Wire) -> None:
        self._wire, self._ended = wire, threading.Event()
        wire.proxies.append(self)
        self._address = parse_address(url)
        self._threads: list[threading.Thread] = []
        self._ends: list[Any] = []
        if self._address.scheme == "serial":
            near, far = os.openpty()
            tty.setraw(far)
            device = os.open(self._address.path, os.O_RDWR | os.O_NOCTTY)
            tty.setraw(device)
            self.url = url.replace(self._address.path, os.ttyname(far))
            self._ends += [_Terminal(near), _Terminal(device), _Terminal(far)]
            self._pass_on(self._ends[0], self._ends[1])
            return
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.settimeout(0.1)
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER)
        port = self._listener.getsockname()[1]
        self.url = url.replace(f":{self._address.port}", f":{port}")
        self._start(self._accept)

    def close(self) -> None:
        """End all connections; idempotent."""
        self._ended.set()
        for thread in self._threads:
            thread.join(5.0)
        for end in self._ends:
            with suppress(OSError):
                end.close()
        if self._address.scheme != "serial":
            self._listener.close()

    def _start(self, target: Any, *arguments: Any) -> None:
        thread = threading.Thread(target=target, args=arguments, name="wire-proxy", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while not self._ended.is_set():
            try:
                driver, _ = self._listener.accept()
            except (TimeoutError, OSError):
                continue
            device = socket.socket()
            device.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
            try:
                device.connect((self._address.host, self._address.port))
            except OSError:
                device.close()
                driver.close()
                continue
            for end in (driver, device):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._ends += [driver, device]
            self._pass_on(driver, device)

    def is_accepting(self) -> bool:
        """Whether the driver has opened a connection that has not reached the device yet."""
        return self._address.scheme != "serial" and bool(select.select([self._listener], [], [], 0.0)[0])

    def _pass_on(self, driver: Any, device: Any) -> None:
        self._start(self._relay, driver, device, UP)
        self._start(self._relay, device, driver, DOWN)

    def _relay(self, source: Any, target: Any, way: str) -> None:
        """Pass on what comes in one direction, until one end is closed."""
        kept, wire = b"", self._wire
        silent = False
        try:
            while not self._ended.is_set():
                if not select.select([source], [], [], 0.05)[0]:
                    continue
                data = source.recv(4096)
                if not data:
                    return
                if way == UP:
                    wire.await_connections()
                if (silent or wire.cut is self) and not wire.calmed:
                    continue
                if wire.due(way):
                    for wait, part in wire.deliveries(data):
                        self._ended.wait(wait)
                        target.sendall(part)
                    kept = data if wire.fault.kind == "reorder" else b""
                    silent = wire.fault.kind == "half-open"
                    if wire.fault.kind == "cut":
                        wire.cut = self
                        if not isinstance(source, _Terminal):
                            return
                    continue
                target.sendall(data + kept)
                kept = b""
        except (OSError, ValueError):  # ValueError: of select, where the other direction has closed the socket
            return
        finally:
            for end in (source, target):
                if not isinstance(end, _Terminal):
                    with suppress(OSError):
                        end.shutdown(socket.SHUT_RDWR)
                    end.close()


class _Terminal:
    """A file descriptor of a terminal, used as a socket is."""

    def __init__(self, number: int) -> None:
        self._number = number

    def fileno(self) -> int:
        return self._number

    def recv(self, most: int) -> bytes:
        return os.read(self._number, most)

    def sendall(self, data: bytes) -> None:
        while data:
            data = data[os.write(self._number, data) :]

    def close(self) -> None:
        os.close(self._number)


class _Behind:
    """A simulated device with proxies in front of its lines; a driver that closes it leaves it as it is."""

    def __init__(self, device: Any, wire: Wire) -> None:
        self._device = device
        self._proxies = {"": Proxy(device.url, wire)}
        self._proxies |= {name: Proxy(url, wire) for name, url in getattr(device, "urls", {}).items()}
        self.url = self._proxies[""].url
        self.urls = {name: proxy.url for name, proxy in self._proxies.items() if name}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)

    def close(self) -> None:
        """Stay: a device is not closed by its driver."""

    def end(self) -> None:
        """End device and proxies."""
        self._device.close()
        for proxy in self._proxies.values():
            proxy.close()


@contextmanager
def behind(fault: Fault) -> Iterator[Wire]:
    """Put a wire in front of all simulated devices that drivers open in this context; they end with it."""
    wire, devices = Wire(fault), dict[str, _Behind]()
    load = transports.load_simulator

    def loader(name: str | None, url: str) -> Any:
        make = load(name, url)

        def device(address: Any) -> _Behind:
            if url not in devices:
                devices[url] = _Behind(make(address), wire)
            return devices[url]

        return device

    with ExitStack() as stack:
        for name in LOADERS:
            module = import_module(f"errormotion.instruments.transports{name}")
            stack.enter_context(patch.object(module, "load_simulator", loader))
        try:
            yield wire
        finally:
            for each in devices.values():
                each.end()
