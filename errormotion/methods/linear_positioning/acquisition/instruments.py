"""What reads the axis: an interferometer with a channel for each freedom, or a laser tracker in line with the axis.

A tracker gives the distance of the reflector from where it was at zero, by distance and angles. Along a line that
points to the tracker the angles have an effect of second order only.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF, direction_of

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import Settings
    from errormotion.plugins import Bench

UNITS = ("m", "m", "m", "rad", "rad", "rad")
NEAR = 0.01
"""Distance from the zero below which the side of the reflector is unknown, m."""


class Reader(Protocol):
    """Reads all freedoms of a test.

    ``lost`` states whether the zero was lost: readings are NaN until `zero`.
    """

    id: str
    lost: bool

    def zero(self) -> None:
        """Take the present position as zero."""

    def read(self, way: float) -> Array:
        """Return the readings (freedom,), m and rad; ``way`` (m) is the commanded distance from the zero."""


def reader(bench: Bench, settings: Settings) -> Reader:
    """Return the reader of a bench.

    Raises
    ------
    MethodError
        No instrument that can read these freedoms.
    """
    if bench.has_kind("interferometer"):
        wanted = {
            f"channels.{name}": (settings.channels.get(name, ""), UNITS[DOF.index(name)]) for name in settings.freedoms
        }
        return InterferometerReader(bench.of_kind("interferometer"), wanted, settings.average)
    along = DOF[direction_of(settings.axis)]
    if bench.has_kind("laser_tracker"):
        tracker = bench.of_kind("laser_tracker")
        if settings.freedoms != (along,):
            raise MethodError(
                f"freedoms: a laser tracker in line with {settings.axis} reads {along} alone; found "
                f"{', '.join(settings.freedoms)}."
            )
        if hasattr(tracker, "measure"):
            return TrackerReader(tracker, settings.average)
    raise _missing()


def along_line(bench: Bench, settings: Settings, channel: str, name: str) -> Reader:
    """Return the reader of displacements along a diagonal; ``channel`` is that of an interferometer.

    Raises
    ------
    MethodError
        No instrument that can read them.
    """
    if bench.has_kind("interferometer"):
        wanted = {f"diagonals.channels.{name}": (channel, "m")}
        return InterferometerReader(bench.of_kind("interferometer"), wanted, settings.average)
    if bench.has_kind("laser_tracker") and hasattr(tracker := bench.of_kind("laser_tracker"), "measure"):
        return TrackerReader(tracker, settings.average)
    raise _missing()


def _missing() -> MethodError:
    return MethodError(
        "Expected an instrument of kind 'interferometer', or a 'laser_tracker' that measures one target at a time; the "
        "bench has none. Run the NC program, write the readings to a table, and use 'errormotion identify FILE'."
    )


class InterferometerReader:
    """Reads the channels of an interferometer."""

    def __init__(self, instrument: Any, wanted: Mapping[str, tuple[str, str]], average: int) -> None:
        """Take the channels of an instrument: ``wanted`` holds channel and unit by the key of the setting."""
        self._instrument, self._average = instrument, average
        self.id = str(type(instrument).info.id)
        self.lost = True
        channels = dict(instrument.channels)
        only = next(iter(channels)) if len(wanted) == len(channels) == 1 else ""
        self._signs, self._names = [], []
        for key, (stated, unit) in wanted.items():
            text = stated or only
            name = text.removeprefix("-")
            if channels.get(name) != unit:
                known = ", ".join(f"{each} ({kind})" for each, kind in channels.items())
                raise MethodError(
                    f"{key}: expected a channel in {unit} of the interferometer, which has {known}; found '{text}'."
                )
            self._names.append(name)
            self._signs.append(-1.0 if text.startswith("-") else 1.0)

    def zero(self) -> None:
        """Set the interferometer to zero."""
        self._instrument.zero()
        self.lost = False

    def read(self, way: float) -> Array:  # noqa: ARG002 - as of a tracker
        """Return means of several readings, NaN where a beam was broken."""
        values = np.array([[float(found[name]) for name in self._names] for found in self._readings()])
        mean = np.asarray(values.mean(axis=0) * np.array(self._signs))
        self.lost = bool(np.isnan(mean).any())
        return mean

    def _readings(self) -> list[Any]:
        return [self._instrument.read() for _ in range(self._average)]


class TrackerReader:
    """Reads the distance of a tracker's reflector from its zero."""

    def __init__(self, tracker: Any, average: int) -> None:
        self._tracker, self._average = tracker, average
        self.id = str(type(tracker).info.id)
        self.lost = True
        self._zero: Array | None = None
        self._path = 0
        self._outward = 1.0  # 1 where the distance increases with the axis, -1 where it decreases; known from far ways

    def zero(self) -> None:
        """Take the present position of the reflector as zero.

        Raises
        ------
        MethodError
            The tracker has no distance.
        """
        found = self._position()
        if found is None:
            raise MethodError("The tracker has no distance at the first target. Let it acquire its reflector.")
        self._zero, self._path = found
        self.lost = False

    def read(self, way: float) -> Array:
        """Return the distance from the zero, with the sign of the way; NaN after the count was lost."""
        found = self._position()
        if found is None or self._zero is None or found[1] != self._path:
            self.lost = True
            return np.full(1, np.nan)
        place, start = found[0], self._zero
        change = float(np.linalg.norm(place) - np.linalg.norm(start))
        if abs(way) < NEAR:
            return np.array([self._outward * change])
        self._outward = float(np.sign(change * way))
        return np.array([np.sign(way) * np.linalg.norm(place - start)])

    def _position(self) -> tuple[Array, int] | None:
        """Return the mean position of the reflector in the tracker's frame, m, and its dead path; None without."""
        found = [self._tracker.measure() for _ in range(self._average)]
        paths = {int(each.dead_path) for each in found}
        if not all(each.valid for each in found) or len(paths) > 1:
            return None
        return np.array([each.position for each in found], np.float64).mean(axis=0), paths.pop()
