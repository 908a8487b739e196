"""Continuous measurements: points by time, by distance or on a grid, until the requested number or a stop."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from itertools import count
from typing import Any

import numpy as np

from errormotion.instruments.simulators.laser_tracker.leica_emscon import packets
from errormotion.instruments.simulators.laser_tracker.leica_emscon.measures import RHR, Triple, to_system
from errormotion.instruments.simulators.laser_tracker.leica_emscon.packets import NUMBERS
from errormotion.instruments.simulators.laser_tracker.leica_emscon.server import Server
from errormotion.instruments.simulators.laser_tracker.leica_emscon.status import Event

POINTS_A_PACKET = 20
CLOCK = 1000
"""Time of the tracker's clock when a measurement starts, s."""
BY_TIME, BY_DISTANCE, GRID = 1, 2, 3
SAMPLING = 1
"""Sampling interval of the position for points by distance, ms."""
IDLE_WAIT = 0.005
"""Real time between two packets without points: the reflector has not moved far enough, or the beam is broken, s."""


class PointStream:
    """The points of continuous measurements, sent by a thread.

    Parameters
    ----------
    device : Server
    """

    def __init__(self, device: Server) -> None:
        self._device = device
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._mode = 0
        self._due = 0  # mode of the measurement that starts after the answer
        self._milliseconds = SAMPLING
        self._start_time = 0.0
        self._last: Any = None  # last sent position, for points by distance
        self.running = False

    def start_soon(self, mode: int) -> None:
        """Start after the answer."""
        self._due = mode

    def start_if_due(self) -> None:
        """Start a requested measurement."""
        mode, self._due = self._due, 0
        if not mode:
            return
        self.end()
        device = self._device
        self._mode, self._stop, self._last = mode, threading.Event(), None
        self._milliseconds = int(self._parameters()[0]) if mode == BY_TIME else SAMPLING
        self._start_time = device.world.time
        self.running = True
        self._thread = threading.Thread(target=self._run, name=f"sim-{device.name}-points", daemon=True)
        self._thread.start()

    def request_end(self) -> None:
        """Request the end of the thread."""
        self._stop.set()
        self.running = False

    def end(self) -> None:
        """End the thread; idempotent."""
        self._stop.set()
        thread, self._thread = self._thread, None
        if thread is not None and thread is not threading.current_thread():
            thread.join()
        self.running = False

    def report_delivered(self, samples: int) -> None:
        """Advance the world's clock with the reader of points by time, unless another device controls it."""
        world = self._device.world
        now = self._start_time + samples * self._milliseconds / 1000.0
        if self._mode == BY_TIME and not world.streaming and now > world.time:
            world.elapse(now - world.time)

    def _parameters(self) -> list[Any]:
        name = {
            BY_TIME: "SetContinuousTimeModeParams",
            BY_DISTANCE: "SetContinuousDistanceModeParams",
            GRID: "SetGridModeParams",
        }[self._mode]
        return self._device.blocks[NUMBERS[name]].values

    def _run(self) -> None:
        try:
            self._send_points()
        finally:
            if not self._stop.is_set():
                self.running = False

    def _send_points(self) -> None:
        device, started = self._device, time.monotonic()
        wanted = int(self._parameters()[1]) or math.inf
        sent = 0
        for first in count(0, POINTS_A_PACKET):
            if self._stop.is_set() or device.silent():
                return
            found = 0
            for packet, points in self._packets(first, wanted - sent):
                if not device.send(packet):
                    return
                found += points
            sent += found
            if sent >= wanted:
                self.running = False
                device.send(device.status_changes(Event.COUNT_REACHED, Event.READY))
                return
            if device.fault.kind == "disconnect" and first + POINTS_A_PACKET > device.fault.at:
                device.disconnect()
                return
            self._wait(started, first + POINTS_A_PACKET, idle=not found)

    def _wait(self, started: float, samples: int, *, idle: bool) -> None:
        pace = self._device.world.pace
        if pace:
            self._stop.wait(max(0.0, started + samples * self._milliseconds / 1000.0 / pace - time.monotonic()))
        elif idle:
            self._stop.wait(IDLE_WAIT)

    def _packets(self, first: int, most: float) -> Iterator[tuple[bytes, int]]:
        """Yield the packets for the next samples (points, status changes of the beam) and their number of points."""
        device, tracker = self._device, self._device.tracker
        times = self._start_time + (first + np.arange(POINTS_A_PACKET)) * self._milliseconds / 1000.0
        points: list[tuple[int, Triple]] = []
        taken = 0
        for k, row in enumerate(tracker.seen(times), first):
            if taken >= most:
                break
            if tracker.can_lock():
                yield device.locked(), 0
                row = tracker.seen(times[k - first : k - first + 1])[0]
            if changes := device.use_beam():
                yield from self._multi(points, float(times[0]))
                points = []
                yield changes, 0
            if tracker.broken or device.fault.hits("drop", k):
                continue
            spherical = (float(row[0]), float(row[1]), float(row[2]))
            if self._wanted(spherical):
                points.append((CLOCK * 1000 + k * self._milliseconds, spherical))
                taken += 1
        yield from self._multi(points, float(times[0]))

    def _wanted(self, spherical: Triple) -> bool:
        """Whether a position is a point: far enough from the last one, and in the region."""
        parameters = self._parameters()
        if parameters[2] and not self._inside(spherical, int(parameters[3])):
            return False
        if self._mode == BY_TIME:
            return True
        if self._mode == BY_DISTANCE:
            position = np.array(to_system(spherical, RHR))
            far = self._last is None or float(np.linalg.norm(position - self._last)) >= float(parameters[0])
        else:
            position = np.array(to_system(spherical, self._device.wire.system))
            steps = np.array(parameters[0])
            far = self._last is None or bool(np.any((steps > 0) & (np.abs(position - self._last) >= steps)))
        if far:
            self._last = position
        return far

    def _inside(self, spherical: Triple, region: int) -> bool:
        system, blocks = self._device.wire.system, self._device.blocks
        if region == 0:
            centre, radius = blocks[NUMBERS["SetSphereRegionParams"]].values
            apart = np.subtract(to_system(spherical, RHR), to_system(centre, RHR))
            return float(np.linalg.norm(apart)) <= float(radius)
        corners = [to_system(corner, system) for corner in blocks[NUMBERS["SetBoxRegionParams"]].values]
        position = to_system(spherical, system)
        return all(min(a, b) <= x <= max(a, b) for x, a, b in zip(position, *corners, strict=True))

    def _multi(self, points: list[tuple[int, Triple]], when: float) -> Iterator[tuple[bytes, int]]:
        if not points:
            return
        device = self._device
        extended = device.blocks[NUMBERS["SetStatisticMode"]].values[1]
        kind = packets.MULTI2 if extended else packets.MULTI
        rows = []
        for clock, spherical in points:
            row: list[Any] = [0, clock // 1000, clock % 1000 * 1000, spherical]
            rows.append(row + device.spread(spherical) if extended else row)
        values = [0, len(rows), self._mode, device.try_mode, *device.tracker.air(when)]
        yield device.wire.result(kind, values, rows), len(rows)
