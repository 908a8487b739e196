"""Time from an e-stop to its answer by the bridge of LinuxCNC, while other clients send requests as fast as possible.

It starts the real LinuxCNC on simulated joints. Each stop is requested over a separate connection; the flooding clients
are in another process. The effect of the bridge is the difference from the time without a flood.
"""

from __future__ import annotations

import json
import selectors
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

REQUESTS = b'{"id": 1, "op": "state"}\n' * 500
LIMIT = 20.0  # ms


def connected(path: Path, token: str, *, control: bool = False, name: str = "") -> socket.socket:
    """Return a connection that the bridge has accepted."""
    line = socket.socket(socket.AF_UNIX)
    line.connect(str(path))
    line.settimeout(10.0)
    hello = {"id": 0, "op": "hello", "token": token, "control": control, "client": name}
    answer = asked(line, hello)
    if not answer["ok"]:
        raise RuntimeError(answer["error"])
    return line


def asked(line: socket.socket, request: dict[str, object]) -> dict[str, object]:
    """Send a request and return its answer."""
    line.sendall(json.dumps(request).encode() + b"\n")
    data = b""
    while not data.endswith(b"\n"):
        data += line.recv(65536)
    found: dict[str, object] = json.loads(data)
    return found


def flood(path: Path, token: str, clients: int) -> None:
    """Send requests over many connections and read the answers, until the process is ended."""
    lines = [connected(path, token) for _ in range(clients)]
    chosen = selectors.DefaultSelector()
    for line in lines:
        line.setblocking(False)
        chosen.register(line, selectors.EVENT_READ | selectors.EVENT_WRITE)
    print("flooding", flush=True)
    while True:
        for key, events in chosen.select():
            assert isinstance(key.fileobj, socket.socket)
            if events & selectors.EVENT_READ:
                key.fileobj.recv(1 << 20)
            if events & selectors.EVENT_WRITE:
                key.fileobj.send(REQUESTS)


@contextmanager
def flooded(path: Path, token: str, clients: int) -> Iterator[None]:
    """Flood a bridge from another process."""
    command = [sys.executable, __file__, str(path), token, str(clients)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == b"flooding\n"
            yield
        finally:
            process.kill()


def stop_times(path: Path, token: str, count: int) -> list[float]:
    """Return the times from e-stops to their answers, ms; the machine is in e-stop afterwards."""
    found = []
    with connected(path, token) as line:
        for number in range(count):
            began = time.perf_counter()
            answer = asked(line, {"id": number, "op": "estop"})
            found.append(1e3 * (time.perf_counter() - began))
            assert answer["ok"], answer
    return found


def main() -> None:
    """Print the times without a flood, and with floods of several sizes."""
    from errormotion.instruments.controller.linuxcnc import LinuxCNC, LinuxCNCSettings
    from errormotion.instruments.simulators.controller import linuxcnc

    with ExitStack() as stack:
        machine = stack.enter_context(LinuxCNC("sim://cframe/linuxcnc?seed=3&linger=0", LinuxCNCSettings(arm=True)))
        (control,) = linuxcnc._controls.values()
        path, token = control.process.socket, control.process.token
        for clients in (0, 10, 60):
            found: list[float] = []
            with flooded(path, token, clients) if clients else ExitStack():
                for _ in range(20):  # each from a machine that is on
                    machine.reset()
                    machine.enable()
                    found += stop_times(path, token, 1)
            found.sort()
            print(
                f"{clients:3d} flooding clients: median {found[len(found) // 2]:5.1f} ms, slowest {found[-1]:5.1f} ms, "
                f"{sum(t < LIMIT for t in found)} of {len(found)} below {LIMIT:g} ms"
            )


if __name__ == "__main__":
    if len(sys.argv) > 1:
        flood(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
    else:
        main()
