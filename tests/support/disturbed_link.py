"""A connection to a Unix socket that is disturbed from some moment on, and calm again later."""

import random
import re
import select
import socket
import threading
from contextlib import suppress
from pathlib import Path

HARMLESS = ("split", "slow")
HARMFUL = ("changed", "late", "half-open", "numbers")
"""What a link does to each piece: it comes in single bytes, or 20 ms later; one byte in 16 is changed; it comes 1.5 s
later; it does not come; and digits of the offsets that are asked for are other ones."""
SLOW, LATE = 0.02, 1.5  # s
EVERY = 16
"""Bytes of which one is changed."""


class Link:
    """Passes on what arrives at ``path`` to a Unix socket, and its answers; ``kind`` says how it is disturbed."""

    def __init__(self, path: Path, target: Path) -> None:
        self.kind, self._target = "", target
        self._random = random.Random(1)
        self._ended = threading.Event()
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        path.chmod(0o600)
        self._listener.listen()
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    def close(self) -> None:
        """End all connections."""
        self._ended.set()
        for thread in self._threads:
            thread.join(30.0)
        self._listener.close()

    def _accept(self) -> None:
        while not self._ended.is_set():
            if not select.select([self._listener], [], [], 0.05)[0]:
                continue
            near, _ = self._listener.accept()
            far = socket.socket(socket.AF_UNIX)
            far.connect(str(self._target))
            for source, end, asks in ((near, far, True), (far, near, False)):
                thread = threading.Thread(target=self._relay, args=(source, end, asks), daemon=True)
                self._threads.append(thread)
                thread.start()

    def _relay(self, source: socket.socket, end: socket.socket, asks: bool) -> None:
        with suppress(OSError, ValueError):  # ValueError: of select, where the other direction has closed the socket
            while not self._ended.is_set():
                if not select.select([source], [], [], 0.05)[0]:
                    continue
                data = source.recv(65536)
                if not data:
                    break
                for part in self._parts(data, asks):
                    end.sendall(part)
        for each in (source, end):
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _parts(self, data: bytes, asks: bool) -> list[bytes]:
        kind = self.kind
        if kind in ("slow", "late"):
            self._ended.wait(SLOW if kind == "slow" else LATE)
        if kind == "half-open":
            return []
        if kind == "split":
            return [data[k : k + 1] for k in range(len(data))]
        if kind == "changed":
            changed = bytearray(data)
            for start in range(0, len(data), EVERY):
                changed[min(start + self._random.randrange(EVERY), len(data) - 1)] ^= 1 << self._random.randrange(8)
            return [bytes(changed)]
        if kind == "numbers" and asks:
            return [re.sub(rb'(?<="offset": \[)[^]]*', self._other_digits, data)]
        return [data]

    def _other_digits(self, found: re.Match[bytes]) -> bytes:
        return re.sub(rb"\d", lambda _: str(self._random.randrange(10)).encode(), found[0])
