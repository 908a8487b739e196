"""The dashboard: 100 sensors, 8 hours of history, 20 clients with ten requests a second, one client that hangs.

The server is a separate process with the real monitor, rows of a second, and thermometers without communication. It is
compared with a plain tornado server that sends a text of the same length to the same clients. Accuracy: the peak of
one row in each reduced curve.

The same number of clients requests the page Compensate of a running compensation of 8 hours with a period of a second.

``python benchmarks/dashboard.py [SECONDS]``
"""

import asyncio
import gzip
import http.client
import itertools
import json
import math
import os
import random
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import numpy as np
from tornado.httpserver import HTTPServer
from tornado.netutil import bind_sockets
from tornado.web import Application, RequestHandler

from errormotion.campaign.compensation.following import AUDIT, Status, write_status
from errormotion.campaign.files import BenchInstrument, BenchPlan, parse_bench
from errormotion.campaign.folder import RunFolder
from errormotion.compensation.online.audit import AuditLog
from errormotion.compensation.online.settings import Limits
from errormotion.dashboard import server
from errormotion.dashboard.watch import SPAN, Watch
from errormotion.plugins import Identity, InstrumentInfo, PluginSettings

CLIENTS, RATE = 20, 10.0
"""Number, and requests of each in a second."""
NOW, COMPENSATE = "/now/values.json", "/compensate/state.json"
WHOLE = f"span={int(SPAN)}"
MODULES, CHANNELS = 20, 5
CURVES = 8
CORES, MEMORY, UPDATE = 1.0, 1 << 30, 0.2
"""Limits: processors, bytes, and time of an answer, s."""
PEAK = 99.0
"""degC, of one value in the history"""


class Thermometer:
    """Five sensors with small changes."""

    info = InstrumentInfo("thermometer", "thermometer", "for the benchmark", "simulated_only")
    Settings = PluginSettings

    def __init__(self, address: str, settings: Any) -> None:
        del settings
        self.channels = tuple(f"T{address}.{k}" for k in range(CHANNELS))

    def open(self) -> None:
        """Do nothing."""

    close = open

    def identify(self) -> Identity:
        """Return the identity."""
        return Identity("benchmark", "thermometer", "1", simulated=True)

    def read(self) -> dict[str, float]:
        """Return a reading, degC."""
        return {name: 20.0 + random.random() for name in self.channels}


def plan() -> BenchPlan:
    """Return a bench of 100 sensors."""
    empty = parse_bench('schema = "errormotion.bench/1"\nname = "Shop"\nmachine = "Mill"\n', Path("bench.toml"))
    modules = (BenchInstrument(f"m{k}", Thermometer, str(k), PluginSettings()) for k in range(MODULES))
    return replace(empty, instruments=tuple(modules))


class Filled(Watch):
    """A watch with a history of 8 hours."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        history = self._history
        history.times[:] = np.arange(-history.size, 0.0) * self.interval
        history.rows[:] = 20.0 + np.random.default_rng(0).random(history.rows.shape)
        history.rows[history.size // 3, :CURVES] = PEAK
        history.count = history.size


def compensate(runs: Path) -> None:
    """Write the log of a compensation of 8 hours, and continue it in a thread, once a second."""
    folder = RunFolder.create(runs, "compensation", "00000001", {"status": "running", "bench": {"machine": "Mill"}})
    rest: dict[str, Any] = {"machine": "Mill", "bench": "bench.toml", "compensator": "none", "armed": False}
    rest |= {"limits": Limits(), "stopping": False, "missing": (), "outside": (), "limited": (), "estop": False}
    inputs = {f"T{k}": 20.0 for k in range(CHANNELS * 4)}

    def step(log: AuditLog, elapsed: float) -> dict[str, Any]:
        offset = [1e-6 * math.sin(elapsed / 900.0 + k) for k in range(3)]
        decided = {"elapsed": elapsed, "state": "following", "cause": "", "offset": offset, "applied": offset}
        log.write({**decided, "target": offset, "uncertainty": [1e-7] * 3, "limited": [], "inputs": inputs})
        return decided

    def work() -> None:
        with folder.locked(), AuditLog(folder.path / AUDIT) as log:
            log.write({"event": "shadow", "machine": "Mill", "model": "benchmark"})
            for k in range(int(SPAN)):
                decided = step(log, float(k))
            for k in itertools.count(int(SPAN)):
                decided = step(log, float(k))
                told = {"predicted": [0.0] * 6, "uncertainty": [1e-7] * 6, "inputs": inputs, "program": ""}
                write_status(folder.path, Status(time=datetime.now(UTC), **rest, **decided, **told))
                ready.set()
                time.sleep(1.0)

    ready = threading.Event()
    threading.Thread(target=work, daemon=True).start()
    ready.wait()


def serve(runs: Path) -> None:
    """Serve the dashboard; print its port."""
    compensate(runs)
    server.load_bench = lambda _: plan()  # type: ignore[attr-defined]
    server.Watch = Filled  # type: ignore[misc]
    options = server.Options(runs, port=0, bench=Path("bench.toml"))
    server.run(options, lambda address, _: print(address.rstrip("/").rpartition(":")[2], flush=True))


def serve_bare(length: int) -> None:
    """Serve a text of one length; print the port."""
    text = json.dumps([random.random() for _ in range(length // 20)])[:length]

    class Same(RequestHandler):
        def get(self) -> None:
            self.finish(text)

    async def run() -> None:
        sockets = bind_sockets(0, "127.0.0.1")
        bare = HTTPServer(Application([(r"/.*", Same)], compress_response=True))
        bare.add_sockets(sockets)
        print(sockets[0].getsockname()[1], flush=True)
        await asyncio.Event().wait()

    asyncio.run(run())


@dataclass
class Taken:
    """Measurements of the clients."""

    values: list[float] = field(default_factory=list)
    """Times of the answers with present values, s."""
    curves: list[float] = field(default_factory=list)
    highest: list[float] = field(default_factory=list)
    length: int = 0
    cores: float = 0.0
    memory: int = 0


def ask(connection: http.client.HTTPConnection, path: str) -> tuple[bytes, float]:
    """Return an answer and its time, s."""
    start = time.perf_counter()
    connection.request("GET", path, headers={"Accept-Encoding": "gzip"})
    answer = connection.getresponse()
    text, needed = answer.read(), time.perf_counter() - start
    assert answer.status == 200, f"{path}: {answer.status} {answer.reason}"
    return (gzip.decompress(text) if answer.getheader("Content-Encoding") == "gzip" else text), needed


def client(port: int, seconds: float, taken: Taken, lock: threading.Lock, page: str) -> None:
    """Request values ten times a second, and once curves of 8 hours."""
    connection, names = http.client.HTTPConnection("127.0.0.1", port), "&".join(f"name=T0.{k}" for k in range(CHANNELS))
    names += "&" + "&".join(f"name=T1.{k}" for k in range(CURVES - CHANNELS))
    curves_of = {NOW: f"/now/history.json?span={int(SPAN)}&{names}", COMPENSATE: f"/compensate/curves.json?{WHOLE}"}
    if page == COMPENSATE:
        text, _ = ask(connection, page)
        curves_of[page] += "&" + urlencode({"run": json.loads(text)["chosen"]["key"]})
    text, needed = ask(connection, curves_of[page])
    with lock:
        taken.curves.append(needed)
        if page == NOW and b'"x"' in text:  # not with the plain server
            curves = [curve["y"] for curve in json.loads(text).values()]
            taken.highest += [max(each for each in curve if each is not None) for curve in curves]
    until = time.perf_counter() + seconds
    while (start := time.perf_counter()) < until:
        text, needed = ask(connection, page)
        with lock:
            taken.values.append(needed)
            taken.length = len(text)
        time.sleep(max(0.0, start + 1 / RATE - time.perf_counter()))


def used(process: int) -> tuple[float, int]:
    """Return processor time (s) and largest memory (bytes) of a process."""
    stat = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    peak = next(line for line in Path(f"/proc/{process}/status").read_text().splitlines() if line.startswith("VmHWM"))
    return (int(stat[11]) + int(stat[12])) / os.sysconf("SC_CLK_TCK"), int(peak.split()[1]) * 1024


def measured(arguments: list[str], seconds: float, page: str = NOW) -> Taken:
    """Return the measurements of 20 clients for a page of a server, started with arguments of this program."""
    process = subprocess.Popen([sys.executable, __file__, *arguments], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    try:
        port, taken, lock = int(process.stdout.readline()), Taken(), threading.Lock()
        time.sleep(2.0)  # the first row
        with socket.create_connection(("127.0.0.1", port)) as hanging:
            hanging.sendall(f"GET {page} HTTP/1.1\r\nHost: 127.0.0.1\r\n".encode())  # and nothing more
            before, start = used(process.pid)[0], time.perf_counter()
            threads = [threading.Thread(target=client, args=(port, seconds, taken, lock, page)) for _ in range(CLIENTS)]
            for each in threads:
                each.start()
            for each in threads:
                each.join()
        after, taken.memory = used(process.pid)
        taken.cores = (after - before) / (time.perf_counter() - start)
        return taken
    finally:
        process.terminate()
        process.wait(30)


def verdict(within: bool) -> str:
    """Return a word."""
    return "within" if within else "outside"


def main(seconds: float) -> None:
    """Print processor time, memory and times of answers."""
    with tempfile.TemporaryDirectory() as folder:
        ours = measured(["--serve", folder], seconds)
    with tempfile.TemporaryDirectory() as folder:
        compensation = measured(["--serve", folder], seconds, COMPENSATE)
    bare = measured(["--bare", str(ours.length)], seconds)
    expected = CLIENTS * RATE * seconds
    print(f"{MODULES * CHANNELS} sensors, {SPAN / 3600:g} h, {CLIENTS} clients, {seconds:g} s")
    print(f"{'':12}{'requests':>10}{'median':>9}{'99 %':>9}{'longest':>9}{'cores':>7}{'memory':>10}")
    for name, found in (("Now", ours), ("Compensate", compensation), ("bare", bare)):
        times = found.values
        worst = statistics.quantiles(times, n=100)[98]
        figures = "".join(f"{1e3 * each:7.1f}ms" for each in (statistics.median(times), worst, max(times)))
        print(f"{name:12}{len(times) / expected:9.0%} {figures}{found.cores:7.2f}{found.memory / 2**20:7.0f}MiB")
    print(f"processor time of ours / bare: {ours.cores / bare.cores:.2f}")
    for name, found in (("Now", ours), ("Compensate", compensation)):
        worst = statistics.quantiles(found.values, n=100)[98]
        print(f"{name}: 99 % of the answers {verdict(worst < UPDATE)} {UPDATE:g} s", end="; ")
        print(f"{verdict(found.cores < CORES)} {CORES:g} core; {verdict(found.memory < MEMORY)} {MEMORY / 2**30:g} GiB")
        print(f"{name}: curves of {SPAN / 3600:g} h, {CLIENTS} clients at once: {max(found.curves):.2f} s the longest")
    kept = sum(each == PEAK for each in ours.highest)
    print(f"peaks of one row that the reduced curves show: {kept} of {len(ours.highest)}")


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["--serve", folder]:
            serve(Path(folder))
        case ["--bare", length]:
            serve_bare(int(length))
        case [seconds]:
            main(float(seconds))
        case _:
            main(20.0)
