"""What an instrument and a method are, and the registry that finds them.

A plugin is a plain class, named in the entry-point group ``errormotion.instruments`` or ``errormotion.methods`` of any
distribution. The built-in ones come through the same door. The registry reads the entry points once, loads a plugin
only when it is asked for, and keeps a broken one in its list together with its error.
"""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cache
from importlib.metadata import Distribution, EntryPoint, distributions
from types import TracebackType
from typing import Any, ClassVar, Literal, Protocol, Self, runtime_checkable

import numpy as np
import xarray as xr
from pydantic import BaseModel, ConfigDict

from errormotion.errors import PluginError

Status = Literal["hardware_verified", "replay_verified", "simulated_only"]
Group = Literal["instruments", "methods"]
GROUPS: tuple[Group, ...] = ("instruments", "methods")


class PluginSettings(BaseModel):
    """Base of every plugin's settings: unknown keys are refused, values are fixed once made."""

    model_config = ConfigDict(extra="forbid", frozen=True)


@dataclass(frozen=True)
class InstrumentInfo:
    """What an instrument says of itself.

    ``status`` is honest about what it has met: ``hardware_verified``, ``replay_verified`` or ``simulated_only``.
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
    """What a method says of itself; ``cannot_see`` lists in words what it is blind to."""

    id: str
    summary: str
    status: Status
    version: str = "1"
    cannot_see: tuple[str, ...] = ()


@dataclass(frozen=True)
class Needs:
    """What a method needs: instrument kinds to acquire, a raw schema to identify."""

    instruments: tuple[str, ...]
    raw_schema: str
    optional_instruments: tuple[str, ...] = ()


@dataclass(frozen=True)
class Identity:
    """Who answered at an address: goes into the provenance of everything that it measured."""

    manufacturer: str
    model: str
    serial_number: str
    firmware: str = ""
    simulated: bool = False
    details: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Samples:
    """A block of equally spaced samples of one or more channels, as an instrument hands them over.

    Attributes
    ----------
    values : ndarray, float64, (channel, n)
        SI units; NaN where the instrument gave no valid value.
    first : int
        Device counter of the first sample (samples since the start of the stream, lost ones included).
    rate : float
        Samples per second.
    host_time : float
        ``time.monotonic()`` when the block had come off the wire, s.
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
        Commanded places of the tip, X Y Z, m: before the touch, and where the probe stops if nothing trips it.
    item : int
        What is touched (the number of a ball), for messages and for the dataset.
    """

    start: tuple[float, float, float]
    target: tuple[float, float, float]
    item: int = 0


@dataclass(frozen=True)
class Contact:
    """What came of one touch.

    Attributes
    ----------
    position : (3,) tuple of float
        Where the machine says that the tip was when the probe tripped, m; NaN where the touch gave none.
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
        Where it ends, X Y Z, m; None where the machine stays.
    feed : float
        m/s; NaN at rest.
    seconds : float
        How long it takes.
    spindle_speed : float
        1/min.
    """

    what: str
    place: tuple[float, float, float] | None
    feed: float
    seconds: float
    spindle_speed: float = 0.0


@runtime_checkable
class Instrument(Protocol):
    """A driver: one plain class. Nothing touches the wire before ``__enter__`` (or ``open``)."""

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
        """Ask the device who it is."""

    def read(self) -> Any:
        """Return one reading now."""


@runtime_checkable
class Bench(Protocol):
    """What a method sees of a bench: opened instruments by kind, and where and what the machine is."""

    machine: str

    def of_kind(self, kind: str) -> Any:
        """Return the one instrument of this kind; BenchError names what is missing."""

    def all_of_kind(self, kind: str) -> Mapping[str, Any]:
        """Return every instrument of this kind by its name on the bench; none where there is none."""

    def has_kind(self, kind: str) -> bool:
        """Whether the bench offers an instrument of this kind."""

    def ask(self, message: str) -> None:
        """Ask the operator to do something and wait for it; passes at once on a virtual machine."""


@runtime_checkable
class Method(Protocol):
    """What is measured and how it becomes an error dataset.

    A method may also have ``follow(settings)``: it returns a function that takes each acquired dataset and returns a
    line of text for the person at the machine. It may have ``programs(settings, instruments)``: the NC programs with
    which a machine makes the test, the name of each file to its text. And ``motions(settings, instruments)``: every
    `Step` that the machine will make; they are held against the limits of the bench before anything moves. Both get
    the settings of the bench's instruments by kind. And ``check(settings)``: what is wrong with files that settings
    name, by setting, told when a campaign is read.
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
        run already holds: go on behind it.
        """

    def append_dim(self, settings: Any) -> str:
        """Return the dimension along which the yielded datasets are joined."""

    def progress(self, settings: Any) -> float:
        """Return the expected total for the progress bar: seconds, where chunks state a ``sample_rate``; else items."""

    def identify(self, raw: xr.Dataset, settings: Any) -> xr.Dataset:
        """Turn a raw dataset into an error dataset; leaves ``raw`` as it is."""

    def plan(self, settings: Any) -> xr.Dataset:
        """Return an error dataset of zeros whose covariance is the one to expect."""


@dataclass(frozen=True)
class Plugin:
    """One entry of the registry: the class, or why it could not be loaded."""

    id: str
    group: Group
    entry_point: EntryPoint
    cls: Any = None
    error: str = ""
    traceback: str = ""

    @property
    def distribution(self) -> str:
        """Name and version of the distribution that brought the plugin."""
        return _name_and_version(self.entry_point.dist)


#: What the registry asks of a class before it hands it out; the conformance kit asks for the rest.
_REQUIRED: Mapping[Group, tuple[type[InstrumentInfo] | type[MethodInfo], tuple[str, ...]]] = {
    "instruments": (InstrumentInfo, ("Settings", "open", "close", "identify", "read")),
    "methods": (MethodInfo, ("Settings", "needs", "acquire", "append_dim", "progress", "identify", "plan")),
}


def _name_and_version(dist: Distribution | None) -> str:
    try:
        return f"{dist.name} {dist.version}" if dist is not None else "unknown"
    except (AttributeError, KeyError, OSError, TypeError):  # a distribution without readable metadata
        return "unknown"


@cache
def _found() -> Mapping[Group, tuple[EntryPoint, ...]]:
    """Read the entry points of every distribution.

    Where a distribution's list cannot be read, an entry point without a value stands for it.
    """
    found: dict[Group, list[EntryPoint]] = {group: [] for group in GROUPS}
    seen: set[str] = set()
    for dist in distributions():
        name = _name_and_version(dist).partition(" ")[0]
        if name in seen:  # an older copy further down the path
            continue
        if name != "unknown":
            seen.add(name)
        try:
            points = tuple(dist.entry_points)
        except Exception:  # noqa: BLE001 - a list of whatever form harms nobody else
            text = dist.read_text("entry_points.txt") or ""
            points = tuple(EntryPoint(name, "", f"errormotion.{group}") for group in GROUPS if group in text)
        for group in GROUPS:
            found[group].extend(point for point in points if point.group == f"errormotion.{group}")
    return {group: tuple(points) for group, points in found.items()}


@cache
def _loaded(group: Group, point: EntryPoint) -> Plugin:
    kind, required = _REQUIRED[group]
    try:
        if not point.value:
            raise PluginError("entry_points.txt cannot be read; expected sections with lines 'id = module:Class'")
        cls = point.load()
        info = getattr(cls, "info", None)
        if not isinstance(info, kind):
            raise PluginError(f"{point.value}: expected a class with an `info` of type {kind.__name__}, found {info!r}")
        if missing := [name for name in required if not hasattr(cls, name)]:
            raise PluginError(f"class {cls.__name__} lacks {', '.join(missing)}")
        if info.id != point.name:
            raise PluginError(f"the entry point is called '{point.name}' but the class calls itself '{info.id}'")
    except (Exception, SystemExit) as error:  # noqa: BLE001 - a broken plugin of whatever kind harms nobody else
        return Plugin(
            point.name,
            group,
            point,
            error=f"{type(error).__name__}: {error}",
            traceback=traceback.format_exc(),
        )
    return Plugin(point.name, group, point, cls)


def available(group: Group) -> list[Plugin]:
    """Return every plugin of a group, broken ones and rival claims to one id included, sorted by id."""
    points = sorted(_found()[group], key=lambda point: point.name)
    claims = Counter(point.name for point in points)
    return [
        _loaded(group, point)
        if claims[point.name] == 1
        else Plugin(point.name, group, point, error=_rivals(group, point.name))
        for point in points
    ]


def _rivals(group: Group, plugin_id: str) -> str:
    sources = ", ".join(_name_and_version(point.dist) for point in _found()[group] if point.name == plugin_id)
    return f"Several distributions claim the {group.rstrip('s')} '{plugin_id}': {sources}. Remove all but one."


def get(group: Group, plugin_id: str) -> Any:
    """Return a plugin's class.

    Raises
    ------
    PluginError
        Unknown id (the nearest known ones are named), two distributions claiming one id, or a plugin that does not
        load.
    """
    points = [point for point in _found()[group] if point.name == plugin_id]
    what = group.rstrip("s")
    if not points:
        names = sorted({point.name for point in _found()[group]})
        near = get_close_matches(plugin_id, names, n=1)
        hint = f" Did you mean '{near[0]}'?" if near else ""
        raise PluginError(f"No {what} plugin '{plugin_id}'; there are: {', '.join(names) or 'none'}.{hint}")
    if len(points) > 1:
        raise PluginError(_rivals(group, plugin_id))
    plugin = _loaded(group, points[0])
    if plugin.error:
        raise PluginError(f"The {what} plugin '{plugin_id}' ({plugin.distribution}) does not load: {plugin.error}")
    return plugin.cls


def refresh() -> None:
    """Forget what was found: entry points are read again at the next call."""
    _found.cache_clear()
    _loaded.cache_clear()


__all__: Sequence[str] = [
    "GROUPS",
    "Bench",
    "Identity",
    "Instrument",
    "InstrumentInfo",
    "Method",
    "MethodInfo",
    "Needs",
    "Plugin",
    "PluginSettings",
    "Samples",
    "available",
    "get",
    "refresh",
]
