"""The profiler in the gantry's spindle; profiles are triggered by the encoder of the Y axis."""

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

EMPTY = 128  # profiles in a block without an artefact below
PACED = 8  # profiles in a block at a pace
REST = 0.1  # longest time without a profile while the axis moves forward, s; longer: it rests or returns
DISTURBANCES = ("none", "white", "full")
_ROUNDING = 1e-6  # counts

Array = np.ndarray[Any, Any]


class GantryProfiles:
    """Profiles of the virtual gantry as the Y axis moves in the positive direction.

    Parameters of the address: ``artefacts`` (positions of the axis over them, m, separated by commas, or ``none``;
    default: one every 200 mm), ``pocket`` (position of the axis over a circular pocket machined by the gantry, m;
    default: no pocket), ``disturbances`` (``none``, ``white`` or ``full``), ``encoder_pitch`` (m per count, 1e-6),
    ``encoder_step`` (counts between profiles, 70), ``encoder_start`` (count at Y = 0).

    A trigger by command takes one profile at the present position, with the time of the last profile.

    With a pace, the time of the world continues while a started program triggers no profile, as on a real machine. A
    client that reaches its time limit and streams again later misses no profile, only the time at rest.

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
        Another machine, an invalid parameter, or overlapping artefacts.
    """

    def __init__(self, address: Address, world: VirtualWorld, name: str) -> None:
        from errormotion.twin.sensors.profiler import Profiler

        if world.name != "gantry":
            raise InstrumentError(
                f"'artefact=twin' in '{address.url}': only sim://gantry has a crossbeam", code="simulator.setting"
            )
        self.channel = name
        self._world = world
        self._disturbances = _disturbances(address)
        self._pitch = address.number("encoder_pitch", 1e-6)
        self._start = int(address.number("encoder_start", 0))
        self._step = int(address.number("encoder_step", 70))
        if not self._pitch > 0 or self._step < 1:
            raise InstrumentError(
                f"'encoder_pitch' and 'encoder_step' in '{address.url}': expected a length in m above 0 and an integer "
                f"of at least 1; found {self._pitch:g} and {self._step}",
                code="simulator.setting",
            )
        self._table = _table(address, world)
        self._began = 0.0
        self._times: list[float] = []  # of all profiles of the stream
        self._taken = 0
        self._rested = 0.0  # time until which there was no profile, at a pace
        self._triggers = threading.Semaphore(0)
        self._by_command = 0  # number of profiles triggered by command
        trial = Profiler(8, 1e-4, disturbances=self._disturbances)  # compiles before the first reading
        for target in self._table.targets[:1]:
            self._table.scan(target, trial, np.zeros(2), np.array([[0.0, 0.0, 0.0], [0.0, 1e-4, 0.0]]), (0,))

    @property
    def seen(self) -> float:
        """Time of the last profile that the reader has processed, s, or until which there was none."""
        return max(self._times[self._taken - 1] if self._taken else self._began, self._rested)

    def count(self) -> int:
        """Return the present count of the encoder."""
        return self._counted(self._world.path.place(self._world.time))

    def _counted(self, position: Array) -> int:
        return int(np.floor(float(position[1]) / self._pitch + _ROUNDING)) + self._start

    def begin(self) -> None:
        """Start to follow the axes."""
        self._times, self._taken = [], 0
        self._began = self._rested = self._world.time
        self._triggers = threading.Semaphore(0)
        self._world.start_triggered(self)

    def report_delivered(self, profiles: int) -> None:
        """Set the number of profiles of the stream that its reader has processed."""
        self._taken = min(profiles, len(self._times))

    def end(self) -> None:
        """Stop the clock of the world at the position of the reader."""
        self._world.end_triggered(self)

    def trigger(self) -> None:
        """Take one profile at the present position."""
        self._triggers.release()

    def lines(self, layout: ProfileLayout) -> Iterator[Lines | None]:
        """Yield the profiles of the present path and of all paths that follow."""
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
        """Yield one profile for each pending trigger by command."""
        from errormotion.twin.sensors.profiler import Profiler

        while self._triggers.acquire(blocking=False):
            times = np.array([max(self._last, self._rested)])
            positions = self._world.path.place(times)
            profiler, heights = Profiler(layout.points, layout.x_pitch, disturbances=self._disturbances), None
            self._by_command += 1
            for _, target in self._table.runs(positions[:, 1]):
                if target is not None:
                    key = (self._world.seed, self._by_command)
                    heights = self._table.scan(target, profiler, self._world.warm_time(times), positions, key)
            self._times += times.tolist()
            yield Lines(np.array([self._counted(positions[0])]), heights, times)

    def _along(self, path: Path, layout: ProfileLayout, after: float) -> Iterator[Lines]:
        """Yield the profiles on a path after a time."""
        from errormotion.twin.sensors.profiler import Profiler
        from errormotion.twin.table import CHUNK

        profiler = Profiler(layout.points, layout.x_pitch, disturbances=self._disturbances)
        for piece in path.pieces_forwards(after):
            counts, times = path.crossings(piece, self._pitch, self._start, self._step)
            positions = path.place(times)
            positions[:, 1] = (counts - self._start) * self._pitch
            for run, target in self._table.runs(positions[:, 1]):
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
                        heights = self._table.scan(target, profiler, warm, positions[part], key)[new]
                    yield Lines(counts[part][new], heights, times[part][new])

    def _parts(self, lines: Lines) -> Iterator[Lines]:
        """Yield profiles in small blocks at a pace, otherwise unchanged."""
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
        raise InstrumentError(
            f"'disturbances={name}' in '{address.url}': expected one of {', '.join(DISTURBANCES)}",
            code="simulator.setting",
        )
    return {"none": Disturbances.none, "white": Disturbances.white, "full": Disturbances}[name]()


def _table(address: Address, world: VirtualWorld) -> Any:
    from errormotion.twin.table import default_positions, set_table

    crossbeam = world.machine.crossbeam
    text = address.params.get("artefacts")
    try:
        given = [] if text is None or text == "none" else [float(y) for y in text.split(",")]
    except ValueError:
        raise InstrumentError(
            f"'artefacts={text}' in '{address.url}': expected positions in m, separated by commas",
            code="simulator.setting",
        ) from None
    positions = default_positions(crossbeam.travel) if text is None else given
    pocket = address.number("pocket", 0.0) if "pocket" in address.params else None
    low, high = crossbeam.travel
    if outside := [y for y in [*positions, *([] if pocket is None else [pocket])] if not low <= y <= high]:
        raise InstrumentError(
            f"Y travels from {low:g} to {high:g} m; found {outside[0]:g} m in '{address.url}'", code="simulator.setting"
        )
    try:
        return set_table(crossbeam, world.seed, positions, pocket)
    except BenchError as error:
        raise InstrumentError(f"'{address.url}': {error}", code="simulator.setting") from None
