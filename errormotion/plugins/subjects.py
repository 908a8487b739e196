"""Subjects of the conformance kit: a plugin, and data that the kit cannot derive from it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal
from urllib.parse import urlsplit, urlunsplit

import xarray as xr

from errormotion.plugins import kind_registry
from errormotion.plugins.base import adapted
from errormotion.plugins.lazy import load_object

#: Transformation of a variable of a raw dataset with the frame: see ``MethodSubject.raw_vectors``.
Vector = Literal["pose", "point", "direction", "x", "y", "z", "covariance"]


def with_query(address: str, query: str) -> str:
    """Return an address with a further ``key=value`` in its query."""
    parts = urlsplit(address)
    joined = "&".join(part for part in (parts.query, query) if part)
    return urlunsplit(parts._replace(query=joined))


MAX_WARM_UP = 240.0
"""Time limit for the compilation of a method, s."""

_WARM: set[type] = set()


class _Simulated:
    """Base of the subjects of instruments and compensators: simulation and faults."""

    plugin: Any
    address: str
    faults: tuple[str, ...] | None

    @property
    def menu(self) -> tuple[str, ...]:
        """Names of the tested faults; none for a real device or machine."""
        if not self.simulated:
            return ()
        if self.faults is not None:
            return self.faults
        simulator = self.plugin.info.simulator
        return tuple(getattr(load_object(simulator), "faults", ())) if simulator else ()

    @property
    def simulated(self) -> bool:
        """Whether it is a simulator, not a device or a machine."""
        return self.address.startswith("sim://")


@dataclass(frozen=True)
class InstrumentSubject(_Simulated):
    """An instrument plugin and the address of its simulator.

    Attributes
    ----------
    plugin : type
        The driver class.
    address : str
        A ``sim://`` address without a fault; faults are added to its query as ``fault=NAME``.
    settings : mapping
        Contents of the ``Settings`` of the driver.
    name : str
        Distinguishes several subjects of one plugin.
    make : callable, optional
        ``make(address, record)`` returns a driver, instead of ``plugin(address, Settings(**settings), record=record)``
        (for a driver with several addresses). ``record`` is a path or None.
    faults : tuple of str, optional
        Names of the tested faults; default: ``faults`` of the class of the simulator.
    harmless : tuple of str
        Faults that a driver must handle without loss.
    drop_fault, split_fault : str
        Fault that omits samples (requested with ``fault_at=10``, from the tenth on), and fault that splits the frames.
    plausible : (float, float), optional
        Lowest and highest plausible reading in SI units; default: those of its kind. None: no bounds.
    blocks : int
        Number of examined blocks of a stream.
    time_limit : float
        Time within which a fault must cause an error or a counted loss, s.
    dead_address : str
        An address without a device.
    repeats : bool
        Whether the device repeats a lost reading: equal readings after a late answer are then correct.
    vary : callable, optional
        ``vary(number)`` changes the next reading; called before each reading whose order is examined. Default: the
        time of the simulation is advanced.
    mutants : int
        Number of replays of a recorded session with a changed frame; 0: none. Up to 300 are limited to 6 s; more than
        300 are not limited in time.
    """

    plugin: Any
    address: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""
    make: Callable[[str, Path | None], Any] | None = None
    faults: tuple[str, ...] | None = None
    harmless: tuple[str, ...] = ("split",)
    drop_fault: str = "drop"
    split_fault: str = "split"
    plausible: tuple[float, float] | None = None
    blocks: int = 3
    time_limit: float = 10.0
    dead_address: str = "tcp://127.0.0.1:9"
    repeats: bool = False
    vary: Callable[[int], None] | None = None
    mutants: int = 300

    def build(self, *, address: str = "", fault: str = "", record: Path | None = None) -> Any:
        """Return a new driver, not open."""
        where = address or self.address
        if fault:
            where = with_query(where, f"fault={fault}")
        if self.make is not None:
            return self.make(where, record)
        return self.plugin(where, self.plugin.Settings(**self.settings), record=record)

    @property
    def bounds(self) -> tuple[float, float] | None:
        """Lowest and highest plausible reading."""
        return self.plausible or kind_registry.plausible(self.plugin.info.kind)

    @property
    def streams(self) -> bool:
        """Whether the driver has a ``stream()``."""
        return hasattr(self.plugin, "stream")


@dataclass(frozen=True)
class CompensatorSubject(_Simulated):
    """A compensator plugin, and a simulated machine for its offsets.

    ``start(address)`` returns a simulated machine with ``driver_url`` (or ``url``), the address for the compensator;
    ``driver_settings``, a mapping of required settings (optional); ``close()``; and ``machine``, the part of the
    machine: ``offset`` (active X, Y, Z, m), ``orders`` (number of received offsets), ``slew`` (m/s), ``watchdog`` (s),
    ``busy`` and ``fault`` (texts, to be set), and ``elapse(seconds)``, which advances the time. An example is
    `errormotion.instruments.simulators.compensator.machine.MachinePart`.

    Attributes
    ----------
    plugin : type
        The class.
    address : str
        Parameters of the simulated machine as a ``sim://`` address; other addresses are those of real machines, to
        which nothing is written.
    settings : mapping
        Contents of the ``Settings``.
    name : str
        Distinguishes several subjects of one plugin.
    start : callable, optional
        ``start(address)`` starts the simulated machine; default: the simulator in ``info``.
    offset : (3,) tuple of float
        The written offset, m.
    limit : float
        The limit of ``arm``, m.
    resolution : float
        Largest difference of the offset in effect from the written one, m.
    states : tuple of str
        States that the compensator can report: ``busy``, ``fault``.
    faults : tuple of str, optional
        Names of the tested faults; default: ``faults`` of the class of the simulator.
    harmless : tuple of str
        Faults that it must handle without an error.
    lost_fault : str
        Fault that breaks the connection.
    time_limit : float
        Time within which an error must be raised, s.
    dead_address : str
        An address without a device.
    mutants : int
        As in `InstrumentSubject`, for a compensator whose class has an argument ``record``.
    """

    plugin: Any
    address: str = "sim://cframe?clock=0&watchdog=2&slew=2e-6&limit=50e-6"
    settings: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""
    start: Callable[[str], Any] | None = None
    offset: tuple[float, float, float] = (6e-6, -4e-6, 2e-6)
    limit: float = 20e-6
    resolution: float = 10e-9
    states: tuple[str, ...] = ("busy", "fault")
    faults: tuple[str, ...] | None = None
    harmless: tuple[str, ...] = ("split",)
    lost_fault: str = "disconnect"
    time_limit: float = 10.0
    dead_address: str = "tcp://127.0.0.1:9"
    mutants: int = 100

    def build(self, address: str, settings: Mapping[str, Any] | None = None) -> Any:
        """Return a new compensator, not open; ``settings`` are those of a simulated machine."""
        return self.plugin(address, self.plugin.Settings(**{**(settings or {}), **self.settings}))


@dataclass(frozen=True)
class MethodSubject:
    """A method plugin and a source of raw data with known truth.

    Attributes
    ----------
    plugin : type
        The method class.
    make : callable
        ``make(seed)`` returns ``(raw, truth)``: a raw dataset and the true errors in the error schema, relative to the
        same reference state. ``truth`` is interpolated along its numeric coordinate to the points of the result.
    raw_vectors : mapping of str to str
        Transformation of the variables of the raw dataset with the frame: ``point`` and ``direction`` (last dimension
        x y z), ``covariance`` (last two dimensions: point, then direction), ``pose`` (a matrix (4, 4) from the frame of
        a part into one along the axes of this frame; its origin is a direction), ``x`` ``y`` ``z`` (that coordinate of
        a point; ``motion`` must then not change this axis). All other variables are independent of the frame. Empty
        without vectors in the raw data.
    settings : mapping
        Contents of the ``Settings`` of the method.
    setting_vectors : mapping of str to str
        Settings that are points or directions in the frame of the raw data.
    name : str
        Distinguishes several subjects of one plugin.
    optional : tuple of str
        Variables of the raw dataset that the method does not require.
    measured : tuple of str
        Readings of the sensors; may be stored as float32.
    motion : (tuple, tuple)
        Rotation vector (rad) and displacement (m) of the frame for the check of frame invariance.
    seeds : int, optional
        Number of seeds of the coverage checks; default: 60, or the number that detects a covariance 30 % too large or
        too small.
    compiles : bool
        Whether the method compiles functions at first use: this is done before the first check.
    """

    plugin: Any
    make: Callable[[int], tuple[xr.Dataset, xr.Dataset]]
    raw_vectors: Mapping[str, Vector]
    settings: Mapping[str, Any] = field(default_factory=dict)
    setting_vectors: Mapping[str, Literal["point", "direction"]] = field(default_factory=dict)
    name: str = ""
    optional: tuple[str, ...] = ()
    measured: tuple[str, ...] = ()
    motion: tuple[tuple[float, float, float], tuple[float, float, float]] = ((0.3, -0.2, 0.5), (0.1, -0.2, 0.05))
    seeds: int | None = None
    compiles: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "plugin", adapted(self.plugin, "methods"))

    def __hash__(self) -> int:
        return id(self)

    def effective_settings(self) -> Any:
        """Return the settings of the method."""
        return self.plugin.Settings(**self.settings)

    def identify(self, raw: xr.Dataset) -> xr.Dataset:
        """Return the result of a new instance of the method."""
        errors: xr.Dataset = self.plugin().identify(raw, self.effective_settings())
        return errors

    def warm_up(self) -> None:
        """Compile the functions of the plugin, so that the time is not counted in a check; once for each process."""
        if not self.compiles or self.plugin in _WARM:
            return
        _WARM.add(self.plugin)

        def work() -> None:
            with suppress(Exception):  # errors are reported by the checks
                self.identify(self.make(0)[0])

        worker = threading.Thread(target=work, name="warm-up", daemon=True)
        worker.start()
        worker.join(MAX_WARM_UP)

    @lru_cache(maxsize=1024)  # noqa: B019 - subjects live as long as the tests that share their results
    def outcome(self, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
        """Return the result and the truth of one seed."""
        raw, truth = self.make(seed)
        return self.identify(raw), truth
