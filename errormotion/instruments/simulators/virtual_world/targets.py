"""Targets of the point sensors of a virtual world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.errors import InstrumentError

if TYPE_CHECKING:
    from errormotion.instruments.simulators.virtual_world.streams import Stream
    from errormotion.twin import VirtualMachine
    from errormotion.twin.artefacts.planes import Target
    from errormotion.twin.paths import Path

Array = np.ndarray[Any, Any]


class TargetStand:
    """Holds one target, or none, and returns the readings of the machine's point sensor.

    Every point sensor in the world is then that one on the stage, whatever its name: one that counts from the middle
    of a range of its own, or one that counts from the start.

    Parameters
    ----------
    machine : VirtualMachine

    Attributes
    ----------
    target : Plane, CheckBar or None
    order : dict or None
        What was requested: ``kind``, and of a plane ``inclination`` and ``rotation``, rad.
    """

    def __init__(self, machine: VirtualMachine) -> None:
        self.target: Target | None = None
        self.order: dict[str, Any] | None = None
        self._machine = machine
        self._settings = 0  # each setting of the gauge has other deviations

    def put(self, kind: str | None, inclination: float | None = None, rotation: float | None = None) -> None:
        """Put ``"plane"`` (with its angles, rad) or ``"bar"`` before the sensors, or take away what is there (None).

        Raises
        ------
        InstrumentError
            No such target, or angles that are missing or do not belong to it.
        """
        plane = kind == "plane"
        if kind not in (None, "plane", "bar"):
            raise InstrumentError(f"Expected the target 'plane', 'bar' or None; found {kind!r}")
        if [angle is not None for angle in (inclination, rotation)] != [plane, plane]:
            raise InstrumentError(
                f"Expected inclination and rotation (rad) for a plane only; found {kind!r}, {inclination}, {rotation}"
            )
        if inclination is not None and rotation is not None:
            face = self._machine.sine_gauge.face(float(inclination), float(rotation), self._settings)
            self.target = face
            self.order = {"kind": kind, "inclination": float(inclination), "rotation": float(rotation)}
        else:
            self.target = self._machine.check_bar if kind == "bar" else None
            self.order = {"kind": kind} if kind else None
        self._settings += 1

    def read(self, name: str, times: Array, stage: Array, first: int, measuring_range: float | None = None) -> Array:
        """Return the readings of a sensor.

        Parameters
        ----------
        name : str
            Name of the sensor; determines its noise.
        times : (n,)
            s.
        stage : (n, 3) or (3,)
            Positions of the stage, m.
        first : int
            Number of the first reading.
        measuring_range : float, optional
            Of a sensor that counts from the start of its range, m; where not given, it counts from mid-range.

        Returns
        -------
        ndarray, (n,)
            m; minus or plus infinity before or behind the range, NaN where there is nothing.
        """
        if self.target is None:
            return np.full(len(times), np.nan)
        sensor = self._machine.point_sensor
        if measuring_range is not None:
            sensor = sensor.from_start(measuring_range)
        key = (self._settings, *name.encode())
        return self._machine.point_readings(times, stage, self.target, sensor=sensor, first=first, key=key, beyond=True)

    def samples(self, streams: Sequence[Stream], first: int, n: int, rate: float, path: Path) -> Array:
        """Return samples first .. first + n - 1 of streams on one clock, m, shape (stream, n), see `read`."""
        times = (first + np.arange(n)) / rate
        still = times[0] >= path.end or times[-1] <= path.begin
        stage = path.place(times[:1] if still else times)
        return np.array([self.read(each.channel, times, stage, first, each.measuring_range) for each in streams])
