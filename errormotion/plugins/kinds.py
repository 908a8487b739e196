"""Kinds of instrument: a Protocol for each, with the members that methods and campaigns use.

A contract has the members that every instrument of the kind must have. Its attribute ``capabilities`` lists further
Protocols: an instrument that has the first method of a capability (without methods: its first attribute) must have all
its members; methods look for it before they use it. Its attribute ``plausible`` holds the lowest and highest reading
that a conformance check accepts, in SI units, or None. The decorator ``changing`` marks the capabilities by which an
instrument moves or changes a machine.

Kinds are open: a distribution registers a contract in the entry-point group ``errormotion.kinds``, under the name that
its instruments give as ``info.kind``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, Protocol, TypedDict

import numpy as np
from numpy.typing import NDArray

from errormotion.arrays import Array
from errormotion.plugins.contracts import Contact, Instrument, Samples, Touch
from errormotion.plugins.kind_registry import changing, contract
from errormotion.plugins.readings import FrameGeometry, Measurement, Profiles, Scan

Position = Sequence[float]
"""X, Y, Z, m."""


# ---------------------------------------------------------------------- point_lds


class Streaming(Protocol):
    """A sensor that samples continuously."""

    def stream(self, block: int | None = None) -> Iterator[Samples]:
        """Yield blocks of samples, ``values`` (1, block), until the caller stops."""


class Synchronised(Protocol):
    """A sensor that samples in step with others of its driver: one is the master, the others are its slaves.

    Attributes
    ----------
    name : str
        Of the channel, for messages; set by whoever starts it.
    reasons : tuple of str
        Why a sample has no value, by the code that `fill` gives; code 0 stands for a value.
    lost : tuple of int
        Codes of samples that were lost on the way.
    """

    name: str
    reasons: tuple[str, ...]
    lost: tuple[int, ...]

    def fill(self, values: Array, reasons: NDArray[np.uint8]) -> None:
        """Fill both arrays (n,) with the next samples, m, and the codes of their reasons, uint8."""

    def start(self, block: int, sync: Literal["NONE", "MASTER", "SLAVE"] = "NONE") -> None:
        """Start sampling; a slave samples as soon as its master has started, and both from the same instant on."""

    @property
    def host_time(self) -> float:
        """``time.monotonic()`` at the arrival of the last samples that `fill` gave, s."""

    def drain(self) -> None:
        """Discard samples from now on, so that the sensor is not held back until `stop`."""

    def stop(self, timeout: float | None = None) -> None:
        """Stop sampling; idempotent."""


class StatesReason(Protocol):
    """A sensor that states why a reading is NaN."""

    no_value: str


class StatesOperatingTime(Protocol):
    """A sensor that states how long it has been switched on."""

    def on_for(self) -> float:
        """Return the time since it was switched on, s; 0 where unknown."""


class Packed(Protocol):
    """An instrument whose readings are integers on the wire."""

    @property
    def encoding(self) -> dict[str, Any]:
        """Encoding of a variable that stores them without loss; empty where there is none."""


@contract(plausible=(-0.05, 0.5), capabilities=(Streaming, Synchronised, StatesReason, StatesOperatingTime, Packed))
class PointLDS(Instrument, Protocol):
    """A sensor that measures a distance along a beam."""

    @property
    def measuring_range(self) -> tuple[float, float]:
        """Lowest and highest reading, m."""

    @property
    def mid_range(self) -> float:
        """Reading in the middle of the range, m: there a tilt of the surface has no effect."""

    def read(self) -> float:
        """Return one reading, m along the beam, larger for a more distant surface; NaN where there is none."""


# ---------------------------------------------------------------------- line_profiler


class HoldsScans(Protocol):
    """A profiler whose scans were recorded earlier."""

    def scans(self) -> Iterator[Scan]:
        """Yield the height maps in their order."""


@contract(plausible=(-0.5, 0.5), capabilities=(HoldsScans,))
class LineProfiler(Instrument, Protocol):
    """A sensor that measures heights along a line."""

    def read(self) -> Array:
        """Return the heights of one profile, m, (point,); NaN where there is none."""

    def stream(self, block: int | None = None) -> Iterator[Profiles]:
        """Yield blocks of profiles, ``values`` (point, block), until the caller stops."""


# ---------------------------------------------------------------------- spindle_frame


@contract(plausible=(-0.05, 0.5))
class SpindleFrame(Instrument, Protocol):
    """Distance sensors around a bar in the spindle (ISO 230-3), on one clock."""

    geometry: FrameGeometry

    @property
    def rate(self) -> float:
        """Samples per second of each channel."""

    @property
    def encoding(self) -> dict[str, Any]:
        """Encoding of a variable that stores the samples without loss; empty where there is none."""

    @property
    def warm(self) -> bool:
        """Whether all sensors have been switched on long enough to be stable; False where unknown."""

    def read(self) -> Array:
        """Return one distance of each channel, m, (channel,); NaN where there is none."""

    def stream(self, channels: Sequence[str] | None = None, *, block: int | None = None) -> Iterator[Samples]:
        """Yield blocks of samples, ``values`` (channel, block); a column is one instant."""


# ---------------------------------------------------------------------- laser_tracker


class MeasuresTargets(Protocol):
    """A tracker that measures one target at a time."""

    def measure(self, target: tuple[float, float, float] | None = None) -> Measurement:
        """Measure the reflector that the beam holds, or look for one at a position in the tracker's frame, m."""


@contract(plausible=(-160.0, 160.0), capabilities=(MeasuresTargets,))
class LaserTracker(Instrument, Protocol):
    """An instrument that measures lengths to a reflector."""

    @property
    def distance_is_displacement(self) -> bool:
        """Whether lengths count from an unknown dead path (interferometer) instead of from the tracker."""

    def read(self) -> Any:
        """Return one length, m, or the array of all that a table holds; NaN where there is none."""


# ---------------------------------------------------------------------- interferometer


@contract(plausible=(-160.0, 160.0))
class Interferometer(Instrument, Protocol):
    """An instrument that counts displacements, or angles, of reflectors along its beams."""

    @property
    def channels(self) -> Mapping[str, str]:
        """Unit of each channel, ``m`` or ``rad``, by its name; known before the instrument is opened."""

    def read(self) -> Mapping[str, float]:
        """Return displacement (m) or angle (rad) of each channel since `zero`; NaN from a broken beam until `zero`."""

    def zero(self) -> None:
        """Count from the present position on; raises InstrumentError where a beam is broken."""


# ---------------------------------------------------------------------- touch_probe


@changing
class MovesMachine(Protocol):
    """A probe that commands the machine; others read what the machine's program prints."""

    @property
    def control(self) -> Any:
        """The controller that it uses."""


@contract(capabilities=(MovesMachine,))
class TouchProbe(Instrument, Protocol):
    """A touch probe in the spindle."""

    @property
    def tip_radius(self) -> float:
        """Effective radius of the tip, m."""

    @property
    def noise(self) -> float:
        """Standard deviation of a contact, m; NaN where unknown."""

    def configure(self, settings: Any) -> None:
        """Use other settings from now on."""

    def measure(self, touches: Sequence[Touch]) -> Iterator[Contact]:
        """Yield one contact for each touch, in their order."""


# ---------------------------------------------------------------------- thermometer


class StatesFlags(Protocol):
    """A thermometer that states why a temperature is unknown."""

    flags: dict[str, str]


class StatesPositions(Protocol):
    """A thermometer that states where its sensors are."""

    @property
    def places(self) -> Mapping[str, tuple[float, float, float] | None]:
        """Position of each sensor on the machine, m; None where unknown."""


@contract(plausible=(-60.0, 400.0), capabilities=(StatesFlags, StatesPositions))
class Thermometer(Instrument, Protocol):
    """Named temperature sensors."""

    @property
    def channels(self) -> Sequence[str]:
        """Names of the sensors, known before the thermometer is opened."""

    def read(self) -> Mapping[str, float]:
        """Return the temperatures, degC by channel; NaN where unknown."""


# ---------------------------------------------------------------------- controller


class State(TypedDict, total=False):
    """State of a machine. What a controller does not report is absent, None or NaN.

    ``time`` (s, on the machine's clock), ``position`` and ``commanded_position`` (X, Y, Z, m), ``spindle_speed``
    (1/min), ``spindle_load`` (1 = rated), ``feed`` (m/s), ``running`` (a program waits or runs), ``homed``,
    ``enabled``, ``estop``, ``alarms`` (texts).
    """

    time: float
    position: Sequence[float] | None
    commanded_position: Sequence[float] | None
    spindle_speed: float | None
    spindle_load: float | None
    feed: float | None
    running: bool
    homed: bool | None
    enabled: bool
    estop: bool
    alarms: Sequence[str]


@changing
class MovesAxes(Protocol):
    """A controller that moves the axes."""

    def move_to(self, position: Position, feed: float | None = None) -> Any:
        """Move in a straight line to a position, m, with a feed, m/s; in rapid without one."""

    def stop(self, *, spindle: bool = False) -> None:
        """Abort all motion, with ``spindle`` that of the spindle as well; always allowed."""


@changing
class TurnsSpindle(Protocol):
    """A controller that turns the spindle."""

    def spindle(self, speed: float) -> None:
        """Turn the spindle at a speed, 1/min; 0 stops it."""


@changing
class RunsPrograms(Protocol):
    """A controller that takes NC programs."""

    def run_program(self, text: str) -> Mapping[str, Any]:
        """Start a program (ISO 6983); return ``duration`` and ``longest_lead_in``, s, where known."""


@changing
class Probes(Protocol):
    """A controller that moves until a touch probe trips."""

    def probe(self, target: Position, feed: float) -> dict[str, Any]:
        """Move to a target, m, until the probe trips; return ``tripped``, ``position`` (m or None), ``time`` (s)."""


class PassesTime(Protocol):
    """A controller with a clock of its own."""

    def elapse(self, seconds: float) -> None:
        """Let time pass on the machine's clock, s."""


@changing
class RunsSchedules(Protocol):
    """A controller that mounts artefacts and turns the spindle by a schedule."""

    def mount(self, tool: str) -> None:
        """Put ``bar``, ``sphere`` or ``probe`` into the spindle."""

    def start(self, schedule: Sequence[Any]) -> None:
        """Start a schedule at time 0: events with ``time``, and optionally ``spindle_speed`` and ``compensation``."""


@changing
class StepsSphere(Protocol):
    """A controller that steps a mounted sphere along a line."""

    def run_steps(self, start: Position, direction: Position, step: float, count: int, dwell: float = 1.0) -> Any:
        """Start a step program: first position, m, direction, step, m, their count, and the rest at each, s."""


@changing
class SetsTarget(Protocol):
    """A controller that turns a gauge in front of a point sensor."""

    def set_target(self, kind: str | None, inclination: float | None = None, rotation: float | None = None) -> None:
        """Set a plane, a bar or nothing, with the inclination and rotation of a plane, rad."""


@changing
class CarriesTracker(Protocol):
    """A controller that carries the laser tracker to a station."""

    def set_station(self, position: Position) -> None:
        """Carry the tracker to a position in machine coordinates, m."""


@contract(
    capabilities=(
        MovesAxes,
        TurnsSpindle,
        RunsPrograms,
        Probes,
        PassesTime,
        RunsSchedules,
        StepsSphere,
        SetsTarget,
        CarriesTracker,
    )
)
class Controller(Instrument, Protocol):
    """The control of a machine."""

    def state(self) -> Mapping[str, Any]:
        """Return the state now; see `State`."""
