"""What a plugin is: an instrument, a method, a kind of dataset; and the data that they exchange."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, Self, runtime_checkable

import numpy as np
import xarray as xr
from pydantic import BaseModel, ConfigDict

if TYPE_CHECKING:
    from errormotion.kinematics.description import MachineDescription

Status = Literal["hardware_verified", "replay_verified", "peer_verified", "simulated_only"]
"""How a plugin was verified, the strongest first.

``hardware_verified``: with the real device. ``replay_verified``: with a recorded session of the real device.
``peer_verified``: with an independent implementation of the protocol at the other end. ``simulated_only``: with the
project's own simulator.
"""

ERRORS_SCHEMA = "errormotion.errors/1"
"""Schema of every error dataset, whichever method it comes from."""


class PluginSettings(BaseModel):
    """Base of every plugin's settings: unknown keys are refused, values are fixed once made."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@dataclass(frozen=True)
class InstrumentInfo:
    """Description of an instrument.

    ``status`` states how it was verified; see `Status`.
    ``simulator`` names the wire simulator behind ``sim://`` as ``module:Class``; None where there is none.
    """

    id: str
    kind: str
    summary: str
    status: Status
    version: str = "1"
    simulator: str | None = None


@dataclass(frozen=True)
class MethodInfo:
    """Description of a method; ``cannot_see`` lists what it does not determine."""

    id: str
    summary: str
    status: Status
    version: str = "1"
    cannot_see: tuple[str, ...] = ()


@dataclass(frozen=True)
class DatasetInfo:
    """Description of a kind of dataset that is neither raw data of a method nor its errors: a log, a model.

    ``schemas`` are the values of the attribute ``schema`` that its datasets have. ``methods`` are the values of the
    attribute ``method`` of error datasets that it makes, such as the predictions of a model.
    """

    id: str
    summary: str
    schemas: tuple[str, ...]
    methods: tuple[str, ...] = ()
    version: str = "1"


@dataclass(frozen=True)
class FigureOfMerit:
    """One number of a result that a person looks at first: on the command line, in a summary, in a comparison.

    Attributes
    ----------
    name : str
        In the words of the standard that defines it, with its position or time where it has one.
    value, expanded_uncertainty : float
        SI; k = 2. NaN where unknown.
    unit : str
        SI unit of both: ``m``, ``rad``, ``1``, ``degC``.
    limit : float, optional
        Largest absolute value that is accepted, where one is known.
    influence : mapping of str to float, optional
        Effect of one standard uncertainty of each source of the dataset, by its name. Where it is left out, it is the
        change of the figure when the errors change; so a figure that is computed from other variables states it.
    """

    name: str
    value: float
    expanded_uncertainty: float
    unit: str
    limit: float | None = None
    influence: Mapping[str, float] | None = None


@dataclass(frozen=True)
class Calibration:
    """A calibration that a plugin makes from readings, for ``errormotion calibrate``.

    Attributes
    ----------
    Settings : type of pydantic.BaseModel
        How the calibration is made.
    make : function
        ``make(raw, settings)`` returns the calibration dataset.
    figures : function
        ``figures(calibration)`` returns its figures as a mapping, for ``--json``.
    text : function
        ``text(calibration)`` returns its figures as lines for the terminal.
    """

    Settings: type[BaseModel]
    make: Callable[[xr.Dataset, Any], xr.Dataset]
    figures: Callable[[xr.Dataset], Mapping[str, Any]]
    text: Callable[[xr.Dataset], Sequence[str]]


@dataclass(frozen=True)
class Needs:
    """What a method needs: instrument kinds to acquire, a raw schema to identify."""

    instruments: tuple[str, ...]
    raw_schema: str


@dataclass(frozen=True)
class Identity:
    """Identity of the device at an address; recorded in the provenance of everything that it measured."""

    manufacturer: str
    model: str
    serial_number: str
    firmware: str = ""
    simulated: bool = False
    details: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Samples:
    """A block of equally spaced samples of one or more channels, as delivered by an instrument.

    Attributes
    ----------
    values : ndarray, float64, (channel, n)
        SI units; NaN where the instrument gave no valid value.
    first : int
        Device counter of the first sample (samples since the start of the stream, lost ones included).
    rate : float
        Samples per second.
    host_time : float
        ``time.monotonic()`` when the block was received, s.
    dropped : int
        Samples that the device counter shows missing inside this block; they are NaN in ``values``.
    invalid : mapping of str to int
        Why values are NaN: reason to count.
    """

    values: np.ndarray
    first: int
    rate: float
    host_time: float
    dropped: int = 0
    invalid: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Touch:
    """One touch that a probe is to make: to the start, toward the target until it trips, and back to the start.

    Attributes
    ----------
    start, target : (3,) tuple of float
        Commanded positions of the tip, X Y Z, m: before the touch, and where the probe stops if it does not trip.
    item : int
        What is touched (the number of a ball), for messages and for the dataset.
    """

    start: tuple[float, float, float]
    target: tuple[float, float, float]
    item: int = 0


@dataclass(frozen=True)
class Contact:
    """Result of one touch.

    Attributes
    ----------
    position : (3,) tuple of float
        Position of the tip by the machine when the probe tripped, m; NaN where it did not trip.
    time : float
        When it tripped, s on the clock of the machine (its ``state()["time"]``).
    flag : str
        Empty for a good touch; else why there is none: ``no trip``, ``tripped at the start``, ``repeat differs``.
    """

    position: tuple[float, float, float]
    time: float
    flag: str = ""


@dataclass(frozen=True)
class Step:
    """One step of what a machine is to do: for its limits, and for a dry run.

    Attributes
    ----------
    what : str
        ``move``, ``touch`` or ``rest``.
    place : (3,) tuple of float or None
        Where it ends, X Y Z, m; NaN for an axis that stays; None where the machine stays.
    feed : float
        m/s; NaN at rest, and for a rapid move, which the driver holds to the limit of the bench.
    seconds : float
        How long it takes; NaN where unknown, as for a rapid move.
    spindle_speed : float
        1/min.
    """

    what: str
    place: tuple[float, float, float] | None
    feed: float
    seconds: float
    spindle_speed: float = 0.0


@dataclass(frozen=True)
class MachineLimits:
    """Limits of every order to a machine; what is not stated is not limited.

    Attributes
    ----------
    spans : mapping of str to (float, float)
        Lowest and highest position of X, Y, Z, m.
    feed : float, optional
        Highest feed, m/s.
    spindle_speed : float, optional
        Highest, 1/min.
    forbidden : str
        Why no order at all is allowed; empty where orders are allowed.
    """

    spans: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    feed: float | None = None
    spindle_speed: float | None = None
    forbidden: str = ""

    def __str__(self) -> str:
        """Return the limits as a text."""
        if self.forbidden:
            return f"nothing may move: {self.forbidden}"
        texts = [f"{axis} {1e3 * low:.6g} to {1e3 * high:.6g} mm" for axis, (low, high) in self.spans.items()]
        texts += [] if self.feed is None else [f"feed up to {6e4 * self.feed:.6g} mm/min"]
        texts += [] if self.spindle_speed is None else [f"spindle up to {self.spindle_speed:.6g} /min"]
        return ", ".join(texts) or "no limits are stated"


@runtime_checkable
class Instrument(Protocol):
    """A driver: one plain class. No communication before ``__enter__`` (or ``open``)."""

    info: ClassVar[InstrumentInfo]
    Settings: ClassVar[type[PluginSettings]]
    address: str
    settings: Any

    def open(self) -> None:
        """Open the connection; idempotent."""

    def close(self) -> None:
        """Close the connection and end every thread; idempotent."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def identify(self) -> Identity:
        """Ask the device for its identity."""

    def read(self) -> Any:
        """Return one reading now."""


@runtime_checkable
class Bench(Protocol):
    """A bench as a method sees it: opened instruments by kind, and the machine.

    ``machine`` is the name of the machine tool; ``description`` is its chain, travel, spindle axis and rotary axes,
    None where the bench file gives the name only.
    """

    machine: str
    description: MachineDescription | None

    def of_kind(self, kind: str) -> Any:
        """Return the one instrument of this kind; BenchError names what is missing."""

    def all_of_kind(self, kind: str) -> Mapping[str, Any]:
        """Return every instrument of this kind by its name on the bench; none where there is none."""

    def has_kind(self, kind: str) -> bool:
        """Whether the bench offers an instrument of this kind."""

    def ask(self, message: str) -> None:
        """Request an action of the operator and wait for it; returns immediately on a virtual machine."""


@dataclass(frozen=True)
class Applied:
    """State of the offsets in a machine.

    Attributes
    ----------
    offset : tuple of float
        Offset of X, Y, Z in effect, m; NaN where unknown.
    busy : str
        Why the offset must not change now, such as a probing cycle or a thread; empty: it may.
    fault : str
        Why the machine takes no offsets, such as an emergency stop; empty: it does.
    """

    offset: tuple[float, float, float]
    busy: str = ""
    fault: str = ""


@runtime_checkable
class Compensator(Protocol):
    """Writes offsets into a machine for ``errormotion compensate run``; group ``errormotion.compensators``.

    The machine's side keeps a slew limit of its own, and ramps to zero when `write` is not called for the time that
    its watchdog allows. ``open`` and `read` change nothing. After a lost connection ``open`` connects again.

    ``conformance()`` (optional) returns the `CompensatorSubject` that the conformance kit examines.
    """

    info: ClassVar[InstrumentInfo]
    Settings: ClassVar[type[PluginSettings]]
    address: str
    settings: Any

    def open(self) -> None:
        """Connect; idempotent. InstrumentError where nothing answers."""

    def close(self) -> None:
        """Disconnect and disarm; idempotent. Offsets that were written ramp to zero by the machine's watchdog."""

    def identify(self) -> Identity:
        """Return what answers at the address."""

    def arm(self, limit: float) -> None:
        """Let `write` pass offsets up to a limit of each axis, m, until `close`; nothing is sent.

        InstrumentError where the machine cannot be given such offsets.
        """

    def read(self) -> Applied:
        """Return the offsets in effect, and whether they may change."""

    def write(self, offset: Sequence[float]) -> None:
        """Write the offset of X, Y, Z, m, and with it the sign of life that the machine's watchdog expects.

        InstrumentError, and nothing is sent, where it is not armed, or unless there are three finite numbers within
        the limit.
        """


@runtime_checkable
class Method(Protocol):
    """What is measured and how it becomes an error dataset.

    Optional attributes. Where one is heavy to import, `lazy` loads it when it is first used.

    ``raw_schemas`` : tuple of `errormotion.datasets.schemas.RawSchema`
        The tables that validation, CSV reading, import and the reference pages follow.
    ``texts(language)`` : mapping of str to str
        Catalogue of the texts of its chapters, English to this language (``de``).
    ``chapters(source)`` : list of `errormotion.report.document.Part`
        The report of one of its error datasets; without it, the generic chapter.
    ``figures(errors)`` : list of `FigureOfMerit`
        The numbers that the command line and summaries show.
    ``simulate(settings, seed)`` : (raw, truth)
        Raw data with a known truth: a raw dataset, and an error dataset relative to the same reference.
    ``truth(machine, errors, clock)`` : Dataset
        The true errors of a `VirtualMachine` where an error dataset states errors; its time 0 was at ``clock`` (s) of
        the machine.
    ``conformance()`` : tuple of `MethodSubject`
        What the conformance kit examines.
    ``follow(settings)`` : function
        Takes each acquired dataset and returns a line of text for the operator.
    ``programs(settings, instruments)`` : mapping of str to str
        The NC programs of the test, file name to text.
    ``motions(settings, instruments)`` : list of `Step`
        Every step of the machine; checked against the limits of the bench before anything moves. A method that moves a
        machine, by a controller or by programs, must have it: without it nothing moves during its tests. Where a search
        decides, the steps go to the ends of the search. MethodError where the settings do not determine them.
    ``planning_settings(settings, instruments)`` : settings
        What ``plan`` gets for a test of a campaign: the settings, with what the instruments of the bench state where
        the settings leave it to them, such as their noise.
    ``check(settings)`` : mapping of str to str
        What is wrong, by setting, as far as it can be seen before a measurement; used when a campaign is read.

    ``machine_defaults(machine)`` : mapping of str to value
        Settings that follow from the machine of the bench (a `MachineDescription`), for a campaign that does not state
        them.
    ``check_machine(settings, machine)`` : mapping of str to str
        What contradicts the machine, by setting (an empty text for the whole), with what was expected and what was
        found; used when a campaign is read.
    ``redrawing(raw, settings, errors)`` : `Redrawing`
        Every source of uncertainty of raw data, to be drawn anew, for ``identify --monte-carlo``; ``errors`` is what
        ``identify`` made of them.
    ``doctor`` : mapping of str to function
        Checks of this computer for ``errormotion doctor``; each returns a text or raises an error. Instruments too.

    ``calibrations`` : mapping of str to `Calibration`
        Raw schema of readings to the calibration that ``errormotion calibrate`` makes from them.
    ``log_readers`` : mapping of str to function
        Formats of maps for ``errormotion import`` that are the method's own: value of the key ``schema`` of the map to
        a function ``(log, map)`` of two paths that returns the raw dataset. A map whose key ``schema`` is a raw schema
        needs no function.

    ``programs``, ``motions`` and ``planning_settings`` get the settings of the bench's instruments by kind.
    """

    info: ClassVar[MethodInfo]
    needs: ClassVar[Needs]
    Settings: ClassVar[type[PluginSettings]]

    def acquire(
        self,
        bench: Bench,
        settings: Any,
        *,
        inputs: Mapping[str, xr.Dataset],
        done: xr.Dataset | None = None,
    ) -> Iterator[xr.Dataset]:
        """Measure; yield raw datasets to be joined along ``append_dim(settings)``.

        ``inputs`` are results of earlier tests by the name the campaign gives them. ``done`` is what an interrupted
        run has already: continue after it.
        """

    def append_dim(self, settings: Any) -> str:
        """Return the dimension along which the yielded datasets are joined."""

    def progress(self, settings: Any) -> float:
        """Return the expected total for the progress bar: seconds, where chunks state a ``sample_rate``; else items."""

    def identify(self, raw: xr.Dataset, settings: Any) -> xr.Dataset:
        """Turn a raw dataset into an error dataset; leaves ``raw`` as it is."""

    def plan(self, settings: Any) -> xr.Dataset:
        """Return an error dataset of zeros whose covariance is the one to expect."""
