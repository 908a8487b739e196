"""A monitor that watches a machine for a simulated day while something fails every minute, and what its log must state.

Two modules send the number of each reading as its temperature, so that a value that was never sent, is too old, comes
twice or comes late is recognised in the log. A simulated thermometer and a simulated controller are watched beside
them. The time of the monitor runs faster than that of the computer; timeouts and retries of the drivers are as much
shorter.
"""

import gc
import json
import os
import random
import threading
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from unittest import mock

import numpy as np
import xarray as xr
from disturbed_lines import FastClock, Line, Lines, Module

from errormotion import datasets
from errormotion.campaign.files import BenchPlan, parse_bench
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.monitor.log import read_log
from errormotion.campaign.monitor.watch import FLAGS, OLDEST_READING, Monitor
from errormotion.instruments import simulators
from errormotion.instruments.transports import load_simulator, parse_address
from errormotion.plugins import get

INTERVAL = 1.0
"""Rows of the log, s."""
TIMEOUT = 3.0
"""Of an answer, s; half of a retry's interval."""
LATENCY = 0.1
"""Of a loaded computer, s of its own time: a thread that waits for its turn."""
THREADS = 5
"""That wait by the clock of the monitor: its own, and one for each instrument."""
FAULT_INTERVAL = 60.0  # s
MAX_FAULT = 40.0  # s
MAX_RECOVERY = 30.0 + 2 * TIMEOUT
"""Of an instrument whose fault has ended: the longest interval between two attempts to open it, s."""
SUSPENSION = (10.0, 60.0)  # s
WALL_JUMPS = (3600.0, -3600.0, 86400.0, -86400.0, 50 * 365.25 * 86400.0, -50 * 365.25 * 86400.0)  # s
ON_A_LINE = ("silence", "garbage", "late", "refuse", "disconnect")
ON_A_MODULE = (*ON_A_LINE, "corrupt", "open")
OF_THE_COMPUTER = ("suspension", "wall clock")

BENCH = """\
schema = "errormotion.bench/1"
name = "Shop"
machine = "C-frame (virtual)"
"""
INSTRUMENT = """\
[instruments.{name}]
driver = "{driver}"
address = "{address}"
timeout = "{timeout} s"
"""


@dataclass
class Disturbance:
    """One fault: kind, instrument (empty: the computer), start and end, s of the monitor's time."""

    kind: str
    name: str
    start: float
    end: float


@dataclass
class Resources:
    """Of the process while all instruments answer."""

    time: float
    memory: int
    descriptors: int
    threads: int


@dataclass
class Day:
    """What happened, and what is wrong with it."""

    rows: int = 0
    duration: float = 0.0
    end: float = 0.0
    seconds: float = 0.0
    speed: float = 0.0
    faults: Counter[str] = field(default_factory=Counter)
    disturbances: list[Disturbance] = field(default_factory=list)
    resources: list[Resources] = field(default_factory=list)
    gap_rows: dict[str, int] = field(default_factory=dict)
    gaps: dict[str, int] = field(default_factory=dict)
    unplanned: int = 0
    missed: int = 0
    suspended: int = 0
    holes: int = 0
    oldest: float = 0.0
    repeated: int = 0
    errors: list[str] = field(default_factory=list)

    def growth(self) -> float:
        """Return the growth of the memory since the first sample of the resources, as a share."""
        return self.resources[-1].memory / self.resources[0].memory - 1


def resources(at: float) -> Resources:
    """Return those of this process."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return Resources(at, pages * os.sysconf("SC_PAGE_SIZE"), len(os.listdir("/proc/self/fd")), threading.active_count())


class _Choice:
    """Starts a fault a minute on one of the lines, or on the computer."""

    def __init__(self, lines: list[Line], clock: FastClock, seed: int) -> None:
        self._lines, self._clock, self._random = lines, clock, random.Random(seed)
        self._time, self.wall = time.time, 0.0
        self.made: list[Disturbance] = []

    def wall_clock(self) -> float:
        """Return the time of the wall clock, s."""
        return self._time() + self.wall

    def __call__(self, start: float) -> None:
        """Start one, for a log whose time 0 is a time of the clock, s."""
        chance, now = self._random, self._clock.now() - start
        line = chance.choice(self._lines)
        kinds = ON_A_MODULE if isinstance(line.device, Module) else ON_A_LINE
        kind = chance.choice([*kinds, *OF_THE_COMPUTER])
        seconds = chance.uniform(5.0, MAX_FAULT)
        if kind == "suspension":
            seconds = chance.uniform(*SUSPENSION)
            self._clock.leap(seconds)
        elif kind == "wall clock":
            self.wall, seconds = chance.choice(WALL_JUMPS), 0.0
        else:
            line.disturb(kind, seconds)
        end = now if kind == "disconnect" else now + seconds
        self.made.append(Disturbance(kind, "" if kind in OF_THE_COMPUTER else line.name, now, end))


def watch(runs: Path, hours: float, speed: float, seed: int = 1) -> tuple[RunFolder, Day]:
    """Monitor for some hours at a multiple of the computer's time; return the run folder and what was found."""
    clock = FastClock(speed, THREADS)
    day = Day(speed=speed)
    began = time.monotonic()
    with ExitStack() as stack:
        stack.callback(simulators.reset)
        devices = {"front": Module(), "column": Module()} | {
            name: _simulated(driver, url, stack)
            for name, driver, url in (
                ("far", "modbus_temperature", "sim://cframe/far?seed=5"),
                ("control", "virtual_controller", "sim://cframe/control?seed=5&clock=60"),
            )
        }
        lines = [Line(name, clock, device, seed) for name, device in devices.items()]
        stack.enter_context(Lines(lines))
        choice = _Choice(lines, clock, seed)
        stack.enter_context(mock.patch("time.time", choice.wall_clock))
        with Monitor(_bench(lines, speed), runs, INTERVAL, clock) as monitor:
            often = min(3600.0 * hours / 8, 3600.0)
            start, due, sample = np.inf, FAULT_INTERVAL, often
            for last in monitor.watch(3600.0 * hours):
                start = min(start, clock.now() - last.time)
                if last.time >= sample and not last.silent:
                    day.resources.append(resources(last.time))
                    sample = (last.time // often + 1) * often
                if last.time >= due:
                    choice(start)
                    due = last.time + FAULT_INTERVAL
            day.end = clock.now() - start
        day.duration, day.seconds = last.time, time.monotonic() - began
        day.disturbances = choice.made
        day.faults = Counter(each.kind for each in choice.made)
        sent = {name: device.sent - start for name, device in devices.items() if isinstance(device, Module)}
    folder = RunFolder.open(monitor.folder.path)
    with datasets.load(folder.raw) as log:
        datasets.validate(log)
        _examine(day, log.load(), folder, sent)
    return folder, day


def _simulated(driver: str, url: str, stack: ExitStack) -> str:
    """Start a simulated device, and return its address."""
    device = load_simulator(get("instruments", driver).info.simulator, url)(parse_address(url))
    stack.callback(device.close)
    return str(device.url)


def _bench(lines: list[Line], speed: float) -> BenchPlan:
    drivers = {"front": "dcon_temperature", "column": "dcon_temperature", "far": "modbus_temperature"}
    text = BENCH
    for line in lines:
        driver = drivers.get(line.name, "virtual_controller")
        address = f"modbus+tcp://127.0.0.1:{line.port}?unit=1" if line.name == "far" else f"tcp://127.0.0.1:{line.port}"
        text += INSTRUMENT.format(name=line.name, driver=driver, address=address, timeout=TIMEOUT / speed)
        if driver != "virtual_controller":
            text += f'retry = "{TIMEOUT / 2 / speed} s"\n'
        if isinstance(line.device, Module):
            text += f'checksum = true\nchannels = ["{line.name} a", "{line.name} b"]\n'
    return parse_bench(text, Path("bench.toml"))


def _examine(day: Day, log: xr.Dataset, folder: RunFolder, sent: dict[str, np.ndarray]) -> None:
    """Compare a log with what was sent and when."""
    at, gap = log["time"].values, log["gap"].values.astype(bool)
    sources = [str(name) for name in log["source"].values]
    slack = TIMEOUT + LATENCY * day.speed
    day.rows = at.size
    step = np.diff(at)
    if not (step > 0).all():
        day.errors.append(f"{np.sum(step <= 0)} rows are not later than the row before")
    # A row is late where the computer is; the next one is on the grid again. Missed intervals give no rows.
    number = np.floor(at / INTERVAL + 1e-6).astype(int)
    if not (np.diff(number) > 0).all():
        day.errors.append(f"{np.sum(np.diff(number) <= 0)} rows stand in an interval that has a row")
    day.missed = int(number[-1] + 1 - at.size)
    reduced = read_log(log)
    day.holes = len(reduced.missing)
    for each in day.disturbances:
        if each.kind == "suspension" and each.start < at[-1]:
            k = int(np.searchsorted(at, each.start, side="right"))
            day.suspended += int(number[k] - number[k - 1] - 1)
            if at[k] - at[k - 1] < each.end - each.start:
                day.errors.append(
                    f"suspended at {each.start:.0f} s for {each.end - each.start:.0f} s: not in the times"
                )
    counts = folder.data["samples"]["invalid"]
    for k, name in enumerate(sources):
        day.gap_rows[name] = int(gap[:, k].sum())
        day.gaps[name] = len(reduced.gaps[name])
        if counts.get(f"no answer of {name}", 0) != day.gap_rows[name]:
            day.errors.append(f"{name}: run.json counts {counts}, the log {day.gap_rows[name]} rows without an answer")
        if sum(each.rows for each in reduced.gaps[name]) != day.gap_rows[name]:
            day.errors.append(f"{name}: the gaps listed in the report are not those of the log")
        _examine_gaps(day, name, at, gap[:, k], slack)
    if folder.data["samples"]["count"] != at.size:
        day.errors.append(f"run.json counts {folder.data['samples']['count']} rows; the log has {at.size}")
    sensors = [str(name) for name in log["sensor"].values]
    values, flags = log["temperature"].values, log["temperature_flag"].values.astype(int)
    if not (np.isnan(values) == (flags > 0)).all():
        day.errors.append("an unknown temperature has no reason, or a known one has one")
    meanings = json.loads(log.attrs["flag_meanings"])
    if meanings != list(FLAGS):
        day.errors.append(f"the log states the reasons {meanings}")
    for name, times in sent.items():
        columns = [sensors.index(f"{name} {end}") for end in "ab"]
        silent = gap[:, sources.index(name)]
        if not (silent[:, None] == (flags[:, columns] == meanings.index("no answer"))).all():
            day.errors.append(f"{name}: a row without an answer is not marked, or marked with one")
        _examine_values(day, name, at, values[:, columns], times, slack)
        opened = np.isin(flags[:, columns[0]], [meanings.index("open")])
        planned = [each for each in day.disturbances if each.kind == "open" and each.name == name]
        if opened.any() and not planned:
            day.errors.append(f"{name}: an open sensor is logged; there was none")
    position = log["position"].values
    if not (np.isnan(position).all(axis=1) == gap[:, sources.index("control")]).all():
        day.errors.append("control: a row without an answer has a position, or one with an answer has none")


def _examine_gaps(day: Day, name: str, at: np.ndarray, gap: np.ndarray, slack: float) -> None:
    """Check that outages are gaps throughout; count rows in gaps that no fault explains."""
    explained = np.zeros(at.size, dtype=bool)
    for each in day.disturbances:
        if each.name in ("", name):
            explained |= (at >= each.start) & (at <= each.end + MAX_RECOVERY + slack)
        if each.name == name and each.kind in ("silence", "late", "refuse"):
            certain = (at > each.start + OLDEST_READING * INTERVAL + slack) & (at < each.end - slack)
            if not gap[certain].all():
                day.errors.append(f"{name}: {each.kind} from {each.start:.0f} to {each.end:.0f} s is not marked")
    day.unplanned += int((gap & ~explained).sum())


def _examine_values(day: Day, name: str, at: np.ndarray, values: np.ndarray, sent: np.ndarray, slack: float) -> None:
    """Check that each value was sent, shortly before its row, and that no value comes back."""
    known = np.isfinite(values).all(axis=1)
    if not (known == np.isfinite(values).any(axis=1)).all() or (values[known, 0] != values[known, 1]).any():
        day.errors.append(f"{name}: a row holds two readings")
    numbers = np.rint(100 * values[known, 0]).astype(int)
    age = at[known] - sent[numbers]
    if not np.isfinite(age).all():
        day.errors.append(f"{name}: {np.sum(~np.isfinite(age))} values were never sent")
    age = age[np.isfinite(age)]
    day.oldest = max(day.oldest, float(age.max(initial=0.0)))
    if (age > OLDEST_READING * INTERVAL + slack).any() or (age < -LATENCY * day.speed).any():
        day.errors.append(f"{name}: ages of logged readings from {age.min():.1f} to {age.max():.1f} s")
    steps = np.diff(numbers)
    if (steps < 0).any():
        day.errors.append(f"{name}: {np.sum(steps < 0)} readings come after a later one")
    day.repeated += int((steps == 0).sum())
    most = max(Counter(numbers.tolist()).values(), default=0)
    if most > np.ceil(OLDEST_READING) + 1:
        day.errors.append(f"{name}: one reading stands in {most} rows")
