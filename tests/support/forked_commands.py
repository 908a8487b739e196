"""Commands of errormotion in processes of their own, forked from one that has imported the package.

A process then takes the time of its work, and not that of the imports, which is 1 to 2 s of processor time. The command
``pytest`` runs tests of a plugin.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

POLL_INTERVAL = 0.02
"""Between two looks at a process, s."""
LARGEST = 1 << 16
"""Bytes of a request."""
LOADED = ("plugins", "list")
"""The command that loads the plugins, and with them what most commands need, before any process is forked."""


class Command:
    """A running command, in a session of its own, with the interface of `subprocess.Popen` as far as tests need it."""

    def __init__(self, server: socket.socket, pid: int, out: int, err: int) -> None:
        self._server, self.pid = server, pid
        self.stdout, self.stderr = (os.fdopen(each, encoding="utf-8", errors="replace") for each in (out, err))
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Return the exit status; None while it runs."""
        if self.returncode is None:
            self.returncode = _ask(self._server, {"poll": self.pid})
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def communicate(self, timeout: float) -> tuple[str, str]:
        """Wait for the end; return the rest of what it wrote, which must be less than a pipe holds."""
        until = time.monotonic() + timeout
        while self.poll() is None:
            if time.monotonic() > until:
                raise subprocess.TimeoutExpired("errormotion", timeout)
            time.sleep(POLL_INTERVAL)
        return self.stdout.read(), self.stderr.read()

    def close(self) -> None:
        """Forget its output."""
        self.stdout.close()
        self.stderr.close()


class Commands:
    """The process that all commands are forked from; a context manager.

    Parameters
    ----------
    path : sequence of Path
        Folders with further modules and distributions.
    """

    def __init__(self, path: Sequence[Path] = ()) -> None:
        self._server, theirs = socket.socketpair()
        places = [*map(str, path), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
        self._process = subprocess.Popen(
            [sys.executable, __file__, str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, places))},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )
        theirs.close()

    def __enter__(self) -> Commands:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.close()
        self._process.wait()

    def start(self, *arguments: Any, cwd: Path | None = None, environment: Mapping[str, str] | None = None) -> Command:
        """Start a command in a folder, with further variables of its environment."""
        (out, theirs_out), (err, theirs_err) = os.pipe(), os.pipe()
        try:
            return Command(self._server, self._fork(arguments, cwd, environment, theirs_out, theirs_err), out, err)
        finally:
            os.close(theirs_out)
            os.close(theirs_err)

    def start_on(
        self, terminal: int, *arguments: Any, cwd: Path | None = None, environment: Mapping[str, str] | None = None
    ) -> Command:
        """Start a command whose input and output is a terminal."""
        empty = [os.open(os.devnull, os.O_RDONLY) for _ in range(2)]
        return Command(self._server, self._fork(arguments, cwd, environment, *3 * [terminal]), *empty)

    def run(
        self,
        *arguments: Any,
        cwd: Path | None = None,
        environment: Mapping[str, str] | None = None,
        text: str = "",
        timeout: float = 300.0,
    ) -> subprocess.CompletedProcess[str]:
        """Run a command with an input to its end; return its exit status and what it wrote, however much."""
        with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err, tempfile.TemporaryFile() as given:
            given.write(text.encode())
            given.seek(0)
            pid = self._fork(arguments, cwd, environment, out.fileno(), err.fileno(), given.fileno())
            until = time.monotonic() + timeout
            while (status := _ask(self._server, {"poll": pid})) is None:
                if time.monotonic() > until:
                    os.kill(pid, signal.SIGKILL)
                time.sleep(POLL_INTERVAL)
            texts = []
            for each in (out, err):
                each.seek(0)
                texts.append(each.read().decode(errors="replace"))
        return subprocess.CompletedProcess(["errormotion", *map(str, arguments)], status, *texts)

    def _fork(
        self,
        arguments: Sequence[Any],
        cwd: Path | None,
        environment: Mapping[str, str] | None,
        out: int,
        err: int,
        given: int | None = None,
    ) -> int:
        request = {
            "arguments": list(map(str, arguments)),
            "cwd": str(cwd or Path.cwd()),
            "environment": dict(environment or {}),
        }
        return int(_ask(self._server, request, [out, err] if given is None else [out, err, given]))


def _ask(server: socket.socket, request: Any, descriptors: Sequence[int] = ()) -> Any:
    socket.send_fds(server, [json.dumps(request).encode()], list(descriptors))
    return json.loads(server.recv(LARGEST))


def _serve(client: socket.socket) -> tuple[Any, list[int]]:
    """Answer requests; return, in a forked process, a command and its descriptors. Ends with its client."""
    while True:
        message, descriptors, *_ = socket.recv_fds(client, LARGEST, 3)
        if not message:
            os._exit(0)
        request = json.loads(message)
        if "poll" in request:
            pid, status = os.waitpid(request["poll"], os.WNOHANG)
            answer = os.waitstatus_to_exitcode(status) if pid else None
        else:
            answer = os.fork()
            if answer == 0:
                client.close()
                return request, descriptors
            for each in descriptors:
                os.close(each)
        client.sendall(json.dumps(answer).encode())


def _main() -> None:
    from errormotion.cli import main
    from errormotion.instruments.simulators import reset, world

    with contextlib.suppress(SystemExit):
        main(list(LOADED))
    world("cframe", 0)
    reset()
    sys.stdout.flush()
    gc.collect()
    gc.freeze()
    request, descriptors = _serve(socket.socket(fileno=int(sys.argv[1])))
    os.setsid()
    for number, each in zip((1, 2, 0), descriptors, strict=False):
        os.dup2(each, number)
        os.close(each)
    os.chdir(request["cwd"])
    os.environ |= request["environment"]
    command, *options = request["arguments"]
    if command == "pytest":
        import pytest

        sys.exit(pytest.main(options))
    sys.argv = ["errormotion", command, *options]
    main()


if __name__ == "__main__":
    _main()
