"""The profiler in the gantry's spindle: a profile wherever the encoder of the Y axis triggers one."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np

from errormotion.errors import BenchError, InstrumentError
from errormotion.instruments.simulators.line_profiler.keyence_ljx_wire import ProfileLayout
from errormotion.instruments.simulators.line_profiler.profile_sources import Clock, Lines
from errormotion.instruments.simulators.virtual_world.world import VirtualWorld
from errormotion.instruments.transports import Address
from errormotion.twin.paths import Path

EMPTY = 128  # profiles at once over nothing
PACED = 8  # profiles at once at a pace
REST = 0.1  # s without a profile in which the axis moves on nevertheless; longer, and it rests or goes back
DISTURBANCES = ("none", "white", "full")
_ROUNDING = 1e-6  # counts

Array = np.ndarray[Any, Any]


class GantryProfiles:
    """What the virtual gantry shows its profiler as the Y axis moves in the positive direction.

    Parameters of the address: ``artefacts`` (positions of the axis over them, m, joined by commas, or ``none``;
    default: one every 200 mm), ``pocket`` (position of the axis over a circular pocket that the machine has cut, m;
    default: no pocket), ``disturbances`` (``none``, ``white`` or ``full``), ``encoder_pitch`` (m for one count, 1e-6),
    ``encoder_step`` (counts from profile to profile, 70), ``encoder_start`` (count at Y = 0).

    A trigger by command takes one profile where the axis is, at the time of the last profile.

    At a pace the world's time goes on while a program that was started brings no profile, as that of a real machine;
    who gives up meanwhile and streams again later has missed nothing but the rest.

    Parameters
    ----------
    address : Address
    world : VirtualWorld
        Of the gantry.
    name : str
        For messages.

    Raises
    ------
    InstrumentError
        Another machine, a parameter that makes no sense, pieces that overlap.
    """

    def __init__(self, address: Address, world: VirtualWorld, name: str) -> None:
        from errormotion.twin.sensors.profiler import Profiler

        if world.name != "gantry":
            raise InstrumentError(f"'artefact=twin' in '{address.url}': only on sim://gantry is there a crossbeam")
        self.channel = name
        self._world = world
        self._disturbances = _disturbances(address)
        self._pitch = address.number("encoder_pitch", 1e-6)
        self._start = int(address.number("encoder_start", 0))
        self._step = int(address.number("encoder_step", 70))
        if not self._pitch > 0 or self._step < 1:
            raise InstrumentError(
                f"'encoder_pitch' and 'encoder_step' in '{address.url}': expected a length in m above 0 and a whole "
                f"number from 1 on; found {self._pitch:g} and {self._step}"
            )
        self._table = _table(address, world)
        self._began = 0.0
        self._times: list[float] = []  # of all profiles of the stream
        self._taken = 0
        self._rested = 0.0  # time up to which nothing came, at a pace
        self._triggers = threading.Semaphore(0)
        self._by_command = 0  # profiles that were triggered so
        trial = Profiler(8, 1e-4, disturbances=self._disturbances)  # compiled ahead of the first reading
        for target in self._table.targets[:1]:
            self._table.scan(target, trial, np.zeros(2), np.array([[0.0, 0.0, 0.0], [0.0, 1e-4, 0.0]]), (0,))

    @property
    def seen(self) -> float:
        """Time of the last profile that the reader has passed on, s, or up to which none came."""
        return max(self._times[self._taken - 1] if self._taken else self._began, self._rested)

    def count(self) -> int:
        """Return what the encoder shows now."""
        return self._counted(self._world.path.place(self._world.time))

    def _counted(self, place: Array) -> int:
        return int(np.floor(float(place[1]) / self._pitch + _ROUNDING)) + self._start

    def begin(self) -> None:
        """Follow the axes from now on."""
        self._times, self._taken = [], 0
        self._began = self._rested = self._world.time
        self._triggers = threading.Semaphore(0)
        self._world.start_triggered(self)

    def report_delivered(self, profiles: int) -> None:
        """Take note of how many profiles of the stream its reader has had."""
        self._taken = min(profiles, len(self._times))

    def end(self) -> None:
        """Let the world's clock stop where the reader is."""
        self._world.end_triggered(self)

    def trigger(self) -> None:
        """Have one profile taken where the axis is."""
        self._triggers.release()

    def lines(self, layout: ProfileLayout) -> Iterator[Lines | None]:
        """Yield the profiles of what the machine runs, and of what it will be commanded to run."""
        after = self._began
        path = None
        while True:
            yield from self._commanded(layout)
            if path is self._world.path:
                yield None
                continue
            path, clock = self._world.path, Clock(lambda: self._world.pace, self.seen)
            for lines in self._along(path, layout, after):
                for part in self._parts(lines):
                    yield from self._commanded(layout)
                    while (now := clock.now) < part.times[-1]:
                        if (end := float(part.times[0]) - REST) > self._last:
                            self._rested = max(self._rested, min(now, end))
                        yield None
                        yield from self._commanded(layout)
                    self._times += part.times.tolist()
                    yield part

    @property
    def _last(self) -> float:
        return self._times[-1] if self._times else self._began

    def _commanded(self, layout: ProfileLayout) -> Iterator[Lines]:
        """Yield a profile for each trigger by command that has come."""
        from errormotion.twin.sensors.profiler import Profiler

        while self._triggers.acquire(blocking=False):
            times = np.array([max(self._last, self._rested)])
            places = self._world.path.place(times)
            profiler, heights = Profiler(layout.points, layout.x_pitch, disturbances=self._disturbances), None
            self._by_command += 1
            for _, target in self._table.runs(places[:, 1]):
                if target is not None:
                    key = (self._world.seed, self._by_command)
                    heights = self._table.scan(target, profiler, self._world.warm_time(times), places, key)
            self._times += times.tolist()
            yield Lines(np.array([self._counted(places[0])]), heights, times)

    def _along(self, path: Path, layout: ProfileLayout, after: float) -> Iterator[Lines]:
        """Yield the profiles on a path after a time."""
        from errormotion.twin.sensors.profiler import Profiler
        from errormotion.twin.table import CHUNK

        profiler = Profiler(layout.points, layout.x_pitch, disturbances=self._disturbances)
        for piece in path.pieces_forwards(after):
            counts, times = path.crossings(piece, self._pitch, self._start, self._step)
            places = path.place(times)
            places[:, 1] = (counts - self._start) * self._pitch
            for run, target in self._table.runs(places[:, 1]):
                size = EMPTY if target is None else CHUNK
                for number, low in enumerate(range(run.start, run.stop, size)):
                    part = slice(low, min(low + size, run.stop))
                    new = times[part] > after
                    if not new.any():
                        continue
                    heights = None
                    if target is not None:
                        of_scan = (self._world.seed, round(path.begin * 1e6), piece)
                        key = (*of_scan, round(target.position * 1e9), number)
                        warm = self._world.warm_time(times[part])
                        heights = self._table.scan(target, profiler, warm, places[part], key)[new]
                    yield Lines(counts[part][new], heights, times[part][new])

    def _parts(self, lines: Lines) -> Iterator[Lines]:
        """Yield profiles in small blocks where there is a pace, else as they are."""
        n = lines.times.size
        size = n if self._world.pace is None else PACED
        for low in range(0, n, size):
            part = slice(low, min(low + size, n))
            heights = None if lines.heights is None else lines.heights[part]
            yield Lines(lines.encoder[part], heights, lines.times[part])


def _disturbances(address: Address) -> Any:
    from errormotion.twin.sensors.profiler import Disturbances

    name = address.params.get("disturbances", "full")
    if name not in DISTURBANCES:
        raise InstrumentError(f"'disturbances={name}' in '{address.url}': expected one of {', '.join(DISTURBANCES)}")
    return {"none": Disturbances.none, "white": Disturbances.white, "full": Disturbances}[name]()


def _table(address: Address, world: VirtualWorld) -> Any:
    from errormotion.twin.table import default_positions, set_table

    crossbeam = world.machine.crossbeam
    text = address.params.get("artefacts")
    try:
        given = [] if text is None or text == "none" else [float(y) for y in text.split(",")]
    except ValueError:
        raise InstrumentError(
            f"'artefacts={text}' in '{address.url}': expected positions in m, joined by commas"
        ) from None
    positions = default_positions(crossbeam.travel) if text is None else given
    pocket = address.number("pocket", 0.0) if "pocket" in address.params else None
    low, high = crossbeam.travel
    if outside := [y for y in [*positions, *([] if pocket is None else [pocket])] if not low <= y <= high]:
        raise InstrumentError(f"Y travels from {low:g} to {high:g} m; found {outside[0]:g} m in '{address.url}'")
    try:
        return set_table(crossbeam, world.seed, positions, pocket)
    except BenchError as error:
        raise InstrumentError(f"'{address.url}': {error}") from None
