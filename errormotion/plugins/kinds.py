"""Kinds of instrument: a Protocol for each, with the members that methods and campaigns use.

A contract has the members that every instrument of the kind must have. Its attribute ``capabilities`` lists further
Protocols: an instrument that has the first method of a capability (without methods: its first attribute) must have all
its members; methods test for it before they use it. The attribute ``plausible`` is the lowest and highest reading that
a conformance check accepts, in SI units, or None. The decorator ``changing`` marks the capabilities by which an
instrument moves or changes a machine.

A distribution can add a kind: it registers a contract in the entry-point group ``errormotion.kinds``, under the name
that its instruments state as ``info.kind``.
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
        Of the channel, for messages; set by the caller of `start`.
    reasons : tuple of str
        Reasons of missing values by the codes of `fill`; code 0 means a value.
    lost : tuple of int
        Codes of samples that were lost in transfer.
    """

    name: str
    reasons: tuple[str, ...]
    lost: tuple[int, ...]

    def fill(self, values: Array, reasons: NDArray[np.uint8]) -> None:
        """Fill both arrays (n,) with the next samples, m, and the codes of their reasons, uint8."""

    def start(self, block: int, sync: Literal["NONE", "MASTER", "SLAVE"] = "NONE") -> None:
        """Start sampling; a slave samples from the same instant on as its master."""

    @property
    def host_time(self) -> float:
        """``time.monotonic()`` at the arrival of the last samples of `fill`, s."""

    def drain(self) -> None:
        """Discard samples until `stop`, so that the sensor is not blocked."""

    def stop(self, timeout: float | None = None) -> None:
        """Stop sampling; idempotent."""


class StatesReason(Protocol):
    """A sensor that states the reason of a NaN."""

    no_value: str


class StatesOperatingTime(Protocol):
    """A sensor that states the time since it was switched on."""

    def on_for(self) -> float:
        """Return the time since it was switched on, s; 0 if unknown."""


class Packed(Protocol):
    """An instrument that transmits readings as integers."""

    @property
    def encoding(self) -> dict[str, Any]:
        """Encoding of a variable that stores them without loss; empty if there is none."""


@contract(plausible=(-0.05, 0.5), capabilities=(Streaming, Synchronised, StatesReason, StatesOperatingTime, Packed))
class PointLDS(Instrument, Protocol):
    """A sensor that measures a distance along a beam."""

    @property
    def measuring_range(self) -> tuple[float, float]:
        """Lowest and highest reading, m."""

    @property
    def mid_range(self) -> float:
        """Reading in the middle of the range, m, at which a tilt of the surface has no effect."""

    def read(self) -> float:
        """Return one reading, m along the beam, larger for a more distant surface; NaN without value."""


# ---------------------------------------------------------------------- line_profiler


class HoldsScans(Protocol):
    """A profiler whose scans were recorded earlier."""

    def scans(self) -> Iterator[Scan]:
        """Yield the height maps in their order."""


@contract(plausible=(-0.5, 0.5), capabilities=(HoldsScans,))
class LineProfiler(Instrument, Protocol):
    """A sensor that measures heights along a line."""

    def read(self) -> Array:
        """Return the heights of one profile, m, (point,); NaN without value."""

    def stream(self, block: int | None = None) -> Iterator[Profiles]:
        """Yield blocks of profiles, ``values`` (point, block), until the caller stops."""


# ---------------------------------------------------------------------- spindle_frame


@contract(plausible=(-0.05, 0.5))
class SpindleFrame(Instrument, Protocol):
    """Distance sensors with a common clock around a bar in the spindle (ISO 230-3)."""

    geometry: FrameGeometry

    @property
    def rate(self) -> float:
        """Samples per second of each channel."""

    @property
    def encoding(self) -> dict[str, Any]:
        """Encoding of a variable that stores the samples without loss; empty if there is none."""

    @property
    def warm(self) -> bool:
        """Whether all sensors have been switched on long enough to be stable; False if unknown."""

    def read(self) -> Array:
        """Return one distance of each channel, m, (channel,); NaN without value."""

    def stream(self, channels: Sequence[str] | None = None, *, block: int | None = None) -> Iterator[Samples]:
        """Yield blocks of samples, ``values`` (channel, block); a column is one instant."""


# ---------------------------------------------------------------------- laser_tracker


class MeasuresTargets(Protocol):
    """A tracker that measures one target at a time."""

    def measure(self, target: tuple[float, float, float] | None = None) -> Measurement:
        """Measure the reflector in the beam, or search for one at a position in the frame of the tracker, m."""


@contract(plausible=(-160.0, 160.0), capabilities=(MeasuresTargets,))
class LaserTracker(Instrument, Protocol):
    """An instrument that measures lengths to a reflector."""

    @property
    def distance_is_displacement(self) -> bool:
        """Whether lengths include an unknown dead path (interferometer) and are not distances from the tracker."""

    def read(self) -> Any:
        """Return one length, m, or the array of all lengths of a table; NaN without value."""


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
        """Set the count to zero at the present position; raises InstrumentError if a beam is broken."""


# ---------------------------------------------------------------------- touch_probe


@changing
class MovesMachine(Protocol):
    """A probe that commands the machine; others read the output of an NC program."""

    @property
    def control(self) -> Any:
        """Its controller."""


@contract(capabilities=(MovesMachine,))
class TouchProbe(Instrument, Protocol):
    """A touch probe in the spindle."""

    @property
    def tip_radius(self) -> float:
        """Effective radius of the tip, m."""

    @property
    def noise(self) -> float:
        """Standard deviation of a contact, m; NaN if unknown."""

    def configure(self, settings: Any) -> None:
        """Replace the settings."""

    def measure(self, touches: Sequence[Touch]) -> Iterator[Contact]:
        """Yield one contact for each touch, in their order."""


# ---------------------------------------------------------------------- thermometer


class StatesFlags(Protocol):
    """A thermometer that states the reason of a missing temperature."""

    flags: dict[str, str]


class StatesPositions(Protocol):
    """A thermometer that states the positions of its sensors."""

    @property
    def places(self) -> Mapping[str, tuple[float, float, float] | None]:
        """Position of each sensor on the machine, m; None if unknown."""


@contract(plausible=(-60.0, 400.0), capabilities=(StatesFlags, StatesPositions))
class Thermometer(Instrument, Protocol):
    """Named temperature sensors."""

    @property
    def channels(self) -> Sequence[str]:
        """Names of the sensors, known before the thermometer is opened."""

    def read(self) -> Mapping[str, float]:
        """Return the temperatures, degC by channel; NaN if unknown."""


# ---------------------------------------------------------------------- controller


class State(TypedDict, total=False):
    """State of a machine. Values that a controller does not report are absent, None or NaN.

    ``time`` (s, on the machine's clock), ``position`` and ``commanded_position`` (X, Y, Z, m), ``spindle_speed``
    (1/min), ``spindle_load`` (1 = rated), ``feed`` (m/s), ``running`` (a program is ready or runs), ``homed``,
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
        """Move in a straight line to a position, m, with a feed, m/s; without one, in rapid."""

    def stop(self, *, spindle: bool = False) -> None:
        """Abort all motion, with ``spindle`` including the spindle; always allowed."""


@changing
class TurnsSpindle(Protocol):
    """A controller that turns the spindle."""

    def spindle(self, speed: float) -> None:
        """Turn the spindle at a speed, 1/min; 0 stops it."""


@changing
class RunsPrograms(Protocol):
    """A controller that executes NC programs."""

    def run_program(self, text: str) -> Mapping[str, Any]:
        """Start a program (ISO 6983); return ``duration`` and ``longest_lead_in``, s, if known."""


@changing
class Probes(Protocol):
    """A controller that moves until a touch probe triggers."""

    def probe(self, target: Position, feed: float) -> dict[str, Any]:
        """Move to a target, m, until the probe triggers; return ``tripped``, ``position`` (m or None), ``time`` (s)."""


@changing
class RunsSchedules(Protocol):
    """A controller that mounts artefacts and executes a schedule of spindle speeds."""

    def mount(self, tool: str) -> None:
        """Mount ``bar``, ``sphere`` or ``probe`` in the spindle."""

    def start(self, schedule: Sequence[Any]) -> None:
        """Start a schedule at time 0: events with ``time``, and optionally ``spindle_speed`` and ``compensation``."""


@changing
class StepsSphere(Protocol):
    """A controller that steps a mounted sphere along a line."""

    def run_steps(self, start: Position, direction: Position, step: float, count: int, dwell: float = 1.0) -> Any:
        """Start a step program: first position, m, direction, step, m, number of steps, and dwell at each, s."""


@contract(
    capabilities=(
        MovesAxes,
        TurnsSpindle,
        RunsPrograms,
        Probes,
        RunsSchedules,
        StepsSphere,
    )
)
class Controller(Instrument, Protocol):
    """The control of a machine."""

    def state(self) -> Mapping[str, Any]:
        """Return the present state; see `State`."""
