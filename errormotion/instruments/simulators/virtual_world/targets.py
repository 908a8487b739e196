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
    """A stand with one target or none, and the readings of the machine's point sensor.

    With a target, every point sensor in the world is the one on the stage, independent of its name; its readings are
    relative to the middle of its range, or to the start of a given range.

    Parameters
    ----------
    machine : VirtualMachine

    Attributes
    ----------
    target : Plane, CheckBar or None
    requested : dict or None
        The request: ``kind``, and for a plane ``inclination`` and ``rotation``, rad.
    """

    def __init__(self, machine: VirtualMachine) -> None:
        self.target: Target | None = None
        self.requested: dict[str, Any] | None = None
        self._machine = machine
        self.settings = 0  # each setting of the gauge has other deviations

    def put(self, kind: str | None, inclination: float | None = None, rotation: float | None = None) -> None:
        """Place ``"plane"`` (with its angles, rad) or ``"bar"`` in front of the sensors, or remove the target (None).

        Raises
        ------
        InstrumentError
            The target is unknown, or its angles are missing or not expected.
        """
        plane = kind == "plane"
        if kind not in (None, "plane", "bar"):
            raise InstrumentError(
                f"Expected the target 'plane', 'bar' or None; found {kind!r}", code="simulator.target.unknown"
            )
        if [angle is not None for angle in (inclination, rotation)] != [plane, plane]:
            raise InstrumentError(
                f"Expected inclination and rotation (rad) only with a plane; found {kind!r}, {inclination}, {rotation}",
                code="simulator.target.angles",
            )
        if inclination is not None and rotation is not None:
            face = self._machine.sine_gauge.face(float(inclination), float(rotation), self.settings)
            self.target = face
            self.requested = {"kind": kind, "inclination": float(inclination), "rotation": float(rotation)}
        else:
            self.target = self._machine.check_bar if kind == "bar" else None
            self.requested = {"kind": kind} if kind else None
        self.settings += 1

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
            Range of a sensor whose readings are relative to the start of its range, m; default: relative to mid-range.

        Returns
        -------
        ndarray, (n,)
            m; minus or plus infinity before or behind the range, NaN without a target in the beam.
        """
        if self.target is None:
            return np.full(len(times), np.nan)
        sensor = self._machine.point_sensor
        if measuring_range is not None:
            sensor = sensor.from_start(measuring_range)
        key = (self.settings, *name.encode())
        return self._machine.point_readings(times, stage, self.target, sensor=sensor, first=first, key=key, beyond=True)

    def samples(self, streams: Sequence[Stream], first: int, n: int, rate: float, path: Path) -> Array:
        """Return samples first .. first + n - 1 of streams on one clock, m, shape (stream, n), see `read`."""
        times = (first + np.arange(n)) / rate
        still = times[0] >= path.end or times[-1] <= path.begin
        stage = path.place(times[:1] if still else times)
        return np.array([self.read(each.channel, times, stage, first, each.measuring_range) for each in streams])
