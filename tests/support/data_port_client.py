"""A client of the simulated controllers that send their values on a second port."""

import socket
from typing import Any, Self


class DataPortClient:
    """Two sockets, as opened by a program of the manufacturer."""

    def __init__(self, device: Any) -> None:
        self.device = device
        self.commands = connect(device.url)
        self.data: socket.socket | None = None
        self.rest = b""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.commands.close()
        if self.data is not None:
            self.data.close()
        self.device.close()

    def send(self, text: str) -> None:
        self.commands.sendall(text.encode("latin-1"))

    def text(self, end: bytes) -> str:
        """Return the text before the next end of an answer."""
        data = b""
        while not data.endswith(end):
            data += self.commands.recv(1)
        return data.removesuffix(end).decode("latin-1")

    def open_data(self) -> None:
        if self.data is not None:
            self.data.close()
            self.rest = b""
        self.data = connect(self.device.urls["data"])

    def exactly(self, size: int) -> bytes:
        assert self.data is not None
        while len(self.rest) < size:
            piece = self.data.recv(65536)
            if not piece:
                raise ConnectionError("closed")
            self.rest += piece
        data, self.rest = self.rest[:size], self.rest[size:]
        return data

    def quiet(self) -> bool:
        """Read until no values arrive; return whether there were none."""
        assert self.data is not None
        self.data.settimeout(0.3)
        received, self.rest = bool(self.rest), b""
        try:
            while self.data.recv(1 << 20):
                received = True
        except TimeoutError:
            self.data.settimeout(5.0)
        return not received


def connect(url: str) -> socket.socket:
    """Return a connection to a ``tcp://`` address."""
    host, port = url.removeprefix("tcp://").split(":")
    return socket.create_connection((host, int(port)), timeout=5.0)
