"""A monitor logs the instruments that answer, marks the others, and continues."""

import json
import math
import socket
import socketserver
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from errormotion import datasets
from errormotion.campaign import runner
from errormotion.campaign.files import BenchPlan, parse_bench
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.monitor.watch import FLAGS, Monitor
from errormotion.errors import BenchError, RunError
from errormotion.instruments.thermometer import sensors

HEAD = 'schema = "errormotion.bench/1"\nname = "Shop"\nmachine = "Mill 5"\n'
TICK = 0.05
CALM = 0.25  # s, of a test in which no reading may be late on a computer with other work


def bench(*tables: str) -> BenchPlan:
    return parse_bench(HEAD + "".join(tables), Path("bench.toml"))


def dcon(name: str, address: str, channels: str = '["spindle", "column"]', more: str = "") -> str:
    return (
        f'[instruments.{name}]\ndriver = "dcon_temperature"\naddress = "{address}"\nchannels = {channels}\n'
        f'timeout = "0.2 s"\n{more}'
    )


CONTROL = (
    '[instruments.control]\ndriver = "virtual_controller"\narm = true\naddress = "sim://cframe/controller?seed=11"\n'
)


class Module(socketserver.StreamRequestHandler):
    """A DCON module; ``server.values`` is what it measures."""

    def handle(self) -> None:
        self.server.connections.append(self.connection)  # type: ignore[attr-defined]
        request = b""
        while byte := self._byte():
            request += byte
            if byte == b"\r":
                values = "".join(f"{value:+07.2f}" for value in self.server.values)  # type: ignore[attr-defined]
                answers = {
                    b"$01M\r": "!014018",
                    b"$01F\r": "!01A1.0",
                    b"$012\r": "!01100600",
                    b"#01\r": ">" + values,
                }
                self.wfile.write(answers[request].encode() + b"\r")
                request = b""

    def _byte(self) -> bytes:
        try:
            return self.rfile.read(1)
        except OSError:
            return b""


class Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True
    values = (21.5, 22.25)

    def __init__(self, port: int = 0) -> None:
        self.connections: list[socket.socket] = []
        super().__init__(("127.0.0.1", port), Module)


@contextmanager
def module(port: int = 0) -> Iterator[Server]:
    """A module that can be disconnected."""
    with Server(port) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()
            for connection in server.connections:
                with suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)


def until(snapshots: Iterator, condition: Callable, limit: float = 20.0) -> object:
    end = time.monotonic() + limit
    for snapshot in snapshots:
        if condition(snapshot):
            return snapshot
        assert time.monotonic() < end, snapshot
    raise AssertionError("the monitor ended")


def test_temperatures_and_parameters_are_logged_on_one_clock(tmp_path: Path) -> None:
    plan = bench(dcon("modules", "sim://cframe/t?seed=11&sensors=spindle_front,column"), CONTROL)
    with Monitor(plan, tmp_path, CALM) as monitor:
        snapshots = list(islice(monitor.watch(), 12))
    folder = RunFolder.open(monitor.folder.path)
    assert folder.finished
    assert [entry["name"] for entry in folder.data["instruments"]] == ["modules", "control"]
    assert folder.data["samples"]["count"] == 12
    with datasets.load(folder.raw) as log:
        datasets.validate(log)
        assert log.sizes["time"] == 12
        assert list(log.sensor.values) == ["spindle", "column"]
        np.testing.assert_allclose(log.time, [snapshot.time for snapshot in snapshots])
        np.testing.assert_allclose(np.diff(log.time), CALM, atol=CALM)
        np.testing.assert_allclose(log.temperature[-1], list(snapshots[-1].temperatures.values()))
        assert not log.gap.any()
        assert not log.temperature_flag.any()
        np.testing.assert_allclose(log.position, 0.0)
        np.testing.assert_allclose(log.spindle_speed, 0.0)
        assert log.attrs["machine"] == "Mill 5"
        assert [each["identity"]["simulated"] for each in json.loads(log.attrs["instruments"])] == [True, True]


def test_a_thermometer_that_is_disconnected_and_reconnected_leaves_a_marked_gap(tmp_path: Path) -> None:
    with module() as server:
        port = server.server_address[1]
        plan = bench(dcon("far", f"tcp://127.0.0.1:{port}"), CONTROL)
        monitor = Monitor(plan, tmp_path, TICK)
        monitor.__enter__()
        watched = monitor.watch()
        until(watched, lambda s: s.temperatures["spindle"] == 21.5)
    try:
        gone = until(watched, lambda s: "far" in s.silent)
        assert math.isnan(gone.temperatures["spindle"])
        assert gone.flags == {"spindle": "no answer", "column": "no answer"}
        assert gone.state  # the controller is still heard
        with module(port) as server:
            server.values = (30.0, 31.0)
            until(watched, lambda s: s.temperatures["column"] == 31.0)
    finally:
        monitor.__exit__(None, None, None)
    with datasets.load(monitor.folder.raw) as log:
        gap = log.gap.sel(source="far").values
        assert gap[0] == gap[-1] == 0
        assert gap.sum() > 0
        assert np.isnan(log.temperature.values[gap == 1]).all()
        assert (log.temperature_flag.values[gap == 1] == FLAGS.index("no answer")).all()
        assert np.isfinite(log.temperature.values[gap == 0]).all()
        assert not log.gap.sel(source="control").any()
    assert monitor.folder.data["samples"]["invalid"] == {"no answer of far": int(gap.sum())}


def test_a_silent_instrument_does_not_delay_the_others(tmp_path: Path) -> None:
    quiet = dcon("quiet", "sim://cframe/a?seed=11&fault=silence&fault_at=3", more="")
    good = dcon("good", "sim://cframe/b?seed=11", '["front", "rear"]')
    with Monitor(bench(quiet, good), tmp_path, TICK) as monitor:
        seen = list(islice(monitor.watch(), 20))
    ticks = np.diff([snapshot.time for snapshot in seen])
    assert ticks.max() < 4 * TICK  # and not the time limit of the silent one, 0.2 s each
    assert not math.isnan(seen[-1].temperatures["front"])
    assert "quiet" in seen[-1].silent


def test_an_open_sensor_is_unknown_and_flagged(tmp_path: Path) -> None:
    plan = bench(dcon("modules", "sim://cframe/t?seed=11&sensors=spindle_front,column&open=1"))
    with Monitor(plan, tmp_path, TICK) as monitor:
        seen = list(islice(monitor.watch(), 3))[-1]
    assert math.isnan(seen.temperatures["column"])
    assert seen.flags["column"]
    assert not seen.flags["spindle"]
    assert not seen.silent
    with datasets.load(monitor.folder.raw) as log:
        meanings = json.loads(log.attrs["flag_meanings"])
        assert meanings[int(log.temperature_flag.sel(sensor="column")[-1])] == seen.flags["column"]


def test_a_faulty_sensor_is_logged_as_faulty(tmp_path: Path) -> None:
    node = (
        '[instruments.node]\ndriver = "can_temperature"\naddress = "sim://cframe/node?seed=11&open=0"\n'
        'channels = ["spindle", "column"]\n'
    )
    with Monitor(bench(node), tmp_path, TICK) as monitor:
        seen = list(islice(monitor.watch(), 3))[-1]
    assert seen.flags["spindle"] == "faulty"  # the device does not distinguish an open sensor from a shorted one
    with datasets.load(monitor.folder.raw) as log:
        meanings = json.loads(log.attrs["flag_meanings"])
        assert meanings[int(log.temperature_flag.sel(sensor="spindle")[-1])] == "faulty"


def test_every_reason_of_a_thermometer_has_a_number_in_the_log() -> None:
    assert set(sensors.FLAGS) - {sensors.GOOD, sensors.NOT_READ} <= set(FLAGS)


def test_sensors_of_the_same_name_keep_the_names_of_their_instruments(tmp_path: Path) -> None:
    plan = bench(dcon("a", "sim://cframe/a?seed=11"), dcon("b", "sim://cframe/b?seed=11", '["column", "bed"]'))
    monitor = Monitor(plan, tmp_path)
    assert monitor.sensors == ("spindle", "a.column", "b.column", "bed")


def test_a_bench_without_instruments_is_an_error(tmp_path: Path) -> None:
    sensor = '[instruments.x1]\ndriver = "optoncdt"\naddress = "sim://cframe/X1"\n'
    with pytest.raises(BenchError, match=r"bench\.toml: expected thermometers, a controller, or both; found point_lds"):
        Monitor(bench(sensor), tmp_path)
    with pytest.raises(BenchError, match="expected one controller at most; found control, second"):
        Monitor(bench(CONTROL, CONTROL.replace("control]", "second]")), tmp_path)


def test_the_log_of_a_monitor_is_no_campaign_to_resume(tmp_path: Path) -> None:
    with Monitor(bench(CONTROL), tmp_path, TICK) as monitor:
        next(monitor.watch())
    with pytest.raises(RunError, match="Nothing to resume"):
        runner.resume(runs=tmp_path)


@pytest.mark.slow
def test_the_memory_of_a_long_log_is_constant(tmp_path: Path) -> None:
    """Three hundred rows instead of one hundred: memory that grows with the rows would be three times as large."""
    with Monitor(bench(CONTROL), tmp_path, 1e-3) as monitor:
        watched = monitor.watch()
        tracemalloc.start()
        try:
            next(islice(watched, 100, None))
            early = tracemalloc.get_traced_memory()[0]
            next(islice(watched, 200, None))
            late = tracemalloc.get_traced_memory()[0]
        finally:
            tracemalloc.stop()
    assert late - early < 300_000  # bytes; rows kept as they are handed over would be 1 MB, at 5 kB each


def test_ticks_that_were_missed_are_not_counted_as_rows(tmp_path):
    with module() as server:
        monitor = Monitor(bench(dcon("front", f"tcp://127.0.0.1:{server.server_address[1]}")), tmp_path, TICK)
        with monitor:
            for last in islice(monitor.watch(), 3):
                logged = last.logged
                time.sleep(2.5 * TICK)
    assert logged == 3 == RunFolder.open(monitor.folder.path).data["samples"]["count"]
