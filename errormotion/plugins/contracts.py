"""Contracts of plugins (instrument, method, kind of dataset, compensator), and the data that they exchange."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, Self, runtime_checkable

import numpy as np
import xarray as xr
from pydantic import BaseModel, ConfigDict

if TYPE_CHECKING:
    from errormotion.kinematics.description import MachineDescription

Status = Literal["hardware_verified", "replay_verified", "peer_verified", "simulated_only"]
"""Verification of a plugin, the strongest first.

``hardware_verified``: with the real device. ``replay_verified``: with a recorded session of the real device.
``peer_verified``: with an independent implementation of the protocol as the device. ``simulated_only``: with the
simulator of this project.
"""

ERRORS_SCHEMA = "errormotion.errors/1"
"""Schema of the error datasets of all methods."""


class PluginSettings(BaseModel):
    """Base of the settings of plugins: unknown keys are refused, instances are immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@dataclass(frozen=True)
class InstrumentInfo:
    """Description of an instrument.

    ``status`` states how it was verified; see `Status`.
    ``simulator`` is the wire simulator for ``sim://`` as ``module:Class``; None if there is none.
    """

    id: str
    kind: str
    summary: str
    status: Status
    version: str = "1"
    simulator: str | None = None


@dataclass(frozen=True)
class MethodInfo:
    """Description of a method; ``cannot_see`` lists what it does not determine.

    ``former`` are ids that the method once had. Where no plugin has such an id, campaigns and commands that state it,
    results with it and raw data ``errormotion.raw.FORMER/1`` belong to this method, with a warning.
    """

    id: str
    summary: str
    status: Status
    version: str = "1"
    cannot_see: tuple[str, ...] = ()
    former: tuple[str, ...] = ()


@dataclass(frozen=True)
class DatasetInfo:
    """Description of a kind of dataset that is neither raw data nor errors of a method: a log, a model.

    ``schemas`` are the values of the attribute ``schema`` of its datasets. ``methods`` are the values of the
    attribute ``method`` of error datasets that it computes, such as the predictions of a model.
    """

    id: str
    summary: str
    schemas: tuple[str, ...]
    methods: tuple[str, ...] = ()
    version: str = "1"


@dataclass(frozen=True)
class FigureOfMerit:
    """One of the main numbers of a result: on the command line, in a summary, in a comparison.

    Attributes
    ----------
    name : str
        As in the standard that defines it, with its position or time if it has one.
    value, expanded_uncertainty : float
        SI; k = 2. NaN if unknown.
    unit : str
        SI unit of both: ``m``, ``rad``, ``1``, ``degC``.
    limit : float, optional
        Largest accepted absolute value, if known.
    influence : mapping of str to float, optional
        Effect of one standard uncertainty of each source of the dataset, by the name of the source. By default it is
        computed from the change of the figure with the errors; required for a figure computed from other variables.
    """

    name: str
    value: float
    expanded_uncertainty: float
    unit: str
    limit: float | None = None
    influence: Mapping[str, float] | None = None


@dataclass(frozen=True)
class Calibration:
    """A calibration that a plugin computes from readings, for ``errormotion calibrate``.

    Attributes
    ----------
    Settings : type of pydantic.BaseModel
        Settings of the calibration.
    make : function
        ``make(raw, settings)`` returns the calibration dataset.
    figures : function
        ``figures(calibration)`` returns its figures as a mapping, for ``--json``.
    text : function
        ``text(calibration)`` returns its figures as lines of text.
    """

    Settings: type[BaseModel]
    make: Callable[[xr.Dataset, Any], xr.Dataset]
    figures: Callable[[xr.Dataset], Mapping[str, Any]]
    text: Callable[[xr.Dataset], Sequence[str]]


@dataclass(frozen=True)
class Needs:
    """Requirements of a method: kinds of instrument for ``acquire``, a raw schema for ``identify``."""

    instruments: tuple[str, ...]
    raw_schema: str


@dataclass(frozen=True)
class Identity:
    """Identity of the device at an address; part of the provenance of its data."""

    manufacturer: str
    model: str
    serial_number: str
    firmware: str = ""
    simulated: bool = False
    details: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Samples:
    """A block of equally spaced samples of one or more channels.

    Attributes
    ----------
    values : ndarray, float64, (channel, n)
        SI units; NaN without valid value.
    first : int
        Counter of the device at the first sample: samples since the start of the stream, including lost ones.
    rate : float
        Samples per second.
    host_time : float
        ``time.monotonic()`` when the block was received, s.
    dropped : int
        Number of samples missing in this block by the counter of the device; they are NaN in ``values``.
    invalid : mapping of str to int
        Number of NaN by their reason.
    """

    values: np.ndarray
    first: int
    rate: float
    host_time: float
    dropped: int = 0
    invalid: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Touch:
    """One touch of a probe: to the start, towards the target until it triggers, and back to the start.

    Attributes
    ----------
    start, target : (3,) tuple of float
        Commanded positions of the tip, X Y Z, m: before the touch, and the end of the motion without trigger.
    item : int
        Number of the touched item, such as a ball, for messages and the dataset.
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
        Position of the tip by the machine when the probe triggered, m; NaN if it did not.
    time : float
        Time of the trigger by the clock of the machine (its ``state()["time"]``), s.
    flag : str
        Empty for a valid touch, or the reason: ``no trip``, ``tripped at the start``, ``repeat differs``.
    """

    position: tuple[float, float, float]
    time: float
    flag: str = ""


@dataclass(frozen=True)
class Step:
    """One step of the motions of a machine, for the check of its limits and for a dry run.

    Attributes
    ----------
    what : str
        ``move``, ``touch`` or ``rest``.
    place : (3,) tuple of float or None
        End of the step, X Y Z, m; NaN for an axis that does not move; None if the machine does not move.
    feed : float
        m/s; NaN at rest, and for a rapid move, which the driver limits to the feed limit of the bench.
    seconds : float
        Its duration; NaN if unknown, as for a rapid move.
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
    """Limits of all commands to a machine; quantities that are not stated are not limited.

    Attributes
    ----------
    spans : mapping of str to (float, float)
        Lowest and highest position of X, Y, Z, m.
    feed : float, optional
        Highest feed, m/s.
    spindle_speed : float, optional
        Highest, 1/min.
    forbidden : str
        Reason why no command is allowed; empty if commands are allowed.
    """

    spans: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    feed: float | None = None
    spindle_speed: float | None = None
    forbidden: str = ""

    def __str__(self) -> str:
        """Return the limits as a text."""
        if self.forbidden:
            return f"no motion is allowed: {self.forbidden}"
        texts = [f"{axis} {1e3 * low:.6g} to {1e3 * high:.6g} mm" for axis, (low, high) in self.spans.items()]
        texts += [] if self.feed is None else [f"feed up to {6e4 * self.feed:.6g} mm/min"]
        texts += [] if self.spindle_speed is None else [f"spindle up to {self.spindle_speed:.6g} /min"]
        return ", ".join(texts) or "no limits are stated"


@runtime_checkable
class Instrument(Protocol):
    """A driver. It does not communicate before ``__enter__`` (or ``open``)."""

    info: ClassVar[InstrumentInfo]
    Settings: ClassVar[type[PluginSettings]]
    address: str
    settings: Any

    def open(self) -> None:
        """Open the connection; idempotent."""

    def close(self) -> None:
        """Close the connection and end all threads; idempotent."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def identify(self) -> Identity:
        """Return the identity of the device."""

    def read(self) -> Any:
        """Return one reading."""


@runtime_checkable
class Bench(Protocol):
    """A bench for a method: opened instruments by kind, and the machine.

    ``machine`` is the name of the machine tool; ``description`` is its chain, travel, spindle axis and rotary axes,
    None if the bench file states only the name.
    """

    machine: str
    description: MachineDescription | None

    def of_kind(self, kind: str) -> Any:
        """Return the only instrument of this kind; raises BenchError if there is none or there are several."""

    def all_of_kind(self, kind: str) -> Mapping[str, Any]:
        """Return the instruments of this kind by their names on the bench; may be empty."""

    def has_kind(self, kind: str) -> bool:
        """Whether the bench has an instrument of this kind."""

    def ask(self, message: str, action: str = "", **values: Any) -> None:
        """Request an action of the operator and wait for it; returns at once on a virtual machine.

        ``action`` and its values are for a virtual machine that can do it: ``set_station`` with the ``position`` of the
        laser tracker, m, or ``set_target`` with the ``kind`` of the target of a point sensor (``plane``, ``bar``) and,
        for a plane, ``inclination`` and ``rotation``, rad.
        """


@dataclass(frozen=True)
class Applied:
    """State of the offsets in a machine.

    Attributes
    ----------
    offset : tuple of float
        Active offset of X, Y, Z, m; NaN if unknown.
    busy : str
        Reason why the offset must not change now, such as a probing cycle or a thread; empty if it may.
    fault : str
        Reason why the machine accepts no offsets, such as an emergency stop; empty if it does.
    """

    offset: tuple[float, float, float]
    busy: str = ""
    fault: str = ""


@runtime_checkable
class Compensator(Protocol):
    """Writes offsets into a machine for ``errormotion compensate run``; group ``errormotion.compensators``.

    The machine limits the slew rate itself, and ramps to zero if `write` is not called within the time of its
    watchdog. ``open`` and `read` change nothing. After a lost connection ``open`` connects again. ``conformance()``
    (optional) returns the `CompensatorSubject` for the conformance kit. ``note`` (optional, a text) states what the
    machine does not guarantee, such as that it has only one writer.
    """

    info: ClassVar[InstrumentInfo]
    Settings: ClassVar[type[PluginSettings]]
    address: str
    settings: Any

    def open(self) -> None:
        """Connect; idempotent. Raises InstrumentError if there is no answer."""

    def close(self) -> None:
        """Disconnect and disarm; idempotent. The watchdog of the machine ramps written offsets to zero."""

    def identify(self) -> Identity:
        """Return the identity of the machine at the address."""

    def arm(self, limit: float) -> None:
        """Allow `write` to send offsets up to a limit of each axis, m, until `close`; no offset is sent.

        Raises InstrumentError if the machine cannot accept such offsets.
        """

    def read(self) -> Applied:
        """Return the offsets in effect, and whether they may change."""

    def write(self, offset: Sequence[float]) -> None:
        """Write the offset of X, Y, Z, m, and reset the watchdog of the machine.

        Raises InstrumentError, and sends nothing, if it is not armed or the values are not three finite numbers
        within the limit.
        """
