"""Instruments that read the axis: an interferometer with a channel for each freedom, or a laser tracker in line.

A tracker measures the displacement of its reflector since zero, by distance and angles. Along a line that points to the
tracker, the angles have an effect of second order only.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.kinematics.iso import DOF, direction_of

if TYPE_CHECKING:
    from errormotion.methods.linear_positioning.settings import LinearPositioningSettings
    from errormotion.plugins import Bench

UNITS = ("m", "m", "m", "rad", "rad", "rad")
SIGN_DISTANCE = 0.01
"""Distance from the zero below which the sign of a tracker's displacement cannot be determined from its readings, m."""


class Reader(Protocol):
    """Reads all freedoms of a test.

    ``lost`` states whether there is no zero, as at the start and after a broken beam: call `zero` before `read`.
    """

    id: str
    lost: bool

    def zero(self) -> None:
        """Take the present position as zero."""

    def read(self, distance: float) -> Array:
        """Return the readings (freedom,), m and rad; ``distance`` (m) is the commanded one from the zero."""


def axis_reader(bench: Bench, settings: LinearPositioningSettings) -> Reader:
    """Return the reader of the freedoms of an axis.

    Raises
    ------
    MethodError
        No instrument on the bench can read these freedoms.
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
                f"freedoms: a laser tracker in line with {settings.axis} reads only {along}; found "
                f"{', '.join(settings.freedoms)}.",
                code="position.freedoms.not_read",
            )
        if hasattr(tracker, "measure"):
            return TrackerReader(tracker, settings.average)
    raise _missing()


def diagonal_reader(bench: Bench, settings: LinearPositioningSettings, channel: str, name: str) -> Reader:
    """Return the reader of displacements along a diagonal; ``channel`` is that of an interferometer.

    Raises
    ------
    MethodError
        No instrument on the bench can read them.
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
        "bench has none. Run the NC program, write the readings to a table, and use 'errormotion identify FILE'.",
        code="position.instrument.missing",
    )


class InterferometerReader:
    """Reads the channels of an interferometer."""

    def __init__(self, instrument: Any, wanted: Mapping[str, tuple[str, str]], average: int) -> None:
        """Select channels of an instrument; ``wanted`` maps the key of each setting to channel and unit."""
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
                    f"{key}: expected a channel in {unit} of the interferometer, which has {known}; found '{text}'.",
                    code="position.channel.unknown",
                )
            self._names.append(name)
            self._signs.append(-1.0 if text.startswith("-") else 1.0)

    def zero(self) -> None:
        """Set the interferometer to zero."""
        self._instrument.zero()
        self.lost = False

    def read(self, distance: float) -> Array:  # noqa: ARG002 - needed by a tracker only
        """Return means of several readings, NaN where a beam was broken."""
        readings = [self._instrument.read() for _ in range(self._average)]
        values = np.array([[float(reading[name]) for name in self._names] for reading in readings])
        mean = np.asarray(values.mean(axis=0) * np.array(self._signs))
        self.lost = bool(np.isnan(mean).any())
        return mean


class TrackerReader:
    """Reads the displacement of a tracker's reflector since zero."""

    def __init__(self, tracker: Any, average: int) -> None:
        self._tracker, self._average = tracker, average
        self.id = str(type(tracker).info.id)
        self.lost = True
        self._zero: Array | None = None
        self._path = 0
        self._outward = 1.0  # 1: the distance increases with the axis, -1: it decreases; updated far from the zero

    def zero(self) -> None:
        """Take the present position of the reflector as zero.

        Raises
        ------
        MethodError
            The tracker measures no distance.
        """
        measured = self._measured()
        if measured is None:
            raise MethodError(
                "The tracker measures no distance at the first target. Check that it has acquired its reflector.",
                code="position.tracker.no_distance",
            )
        self._zero, self._path = measured
        self.lost = False

    def read(self, distance: float) -> Array:
        """Return the displacement since zero, with the sign of ``distance``; NaN after the beam was broken."""
        measured = self._measured()
        if measured is None or self._zero is None or measured[1] != self._path:
            self.lost = True
            return np.full(1, np.nan)
        position, start = measured[0], self._zero
        change = float(np.linalg.norm(position) - np.linalg.norm(start))
        if abs(distance) < SIGN_DISTANCE:
            return np.array([self._outward * change])
        self._outward = float(np.sign(change * distance))
        return np.array([np.sign(distance) * np.linalg.norm(position - start)])

    def _measured(self) -> tuple[Array, int] | None:
        """Return the mean position of the reflector in the tracker's frame, m, and its dead path; None if invalid."""
        readings = [self._tracker.measure() for _ in range(self._average)]
        paths = {int(reading.dead_path) for reading in readings}
        if not all(reading.valid for reading in readings) or len(paths) > 1:
            return None
        return np.array([reading.position for reading in readings], np.float64).mean(axis=0), paths.pop()
