"""What the kit examines: a plugin, and the little that the kit cannot find out by itself."""

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
from errormotion.plugins.lazy import load_object

#: How a variable of a raw dataset moves with the frame: see ``MethodSubject.raw_vectors``.
Vector = Literal["pose", "point", "direction", "x", "y", "z", "covariance"]


def with_query(address: str, query: str) -> str:
    """Return an address with a further ``key=value`` in its query."""
    parts = urlsplit(address)
    joined = "&".join(part for part in (parts.query, query) if part)
    return urlunsplit(parts._replace(query=joined))


LONGEST_WARM_UP = 240.0
"""For which the kit waits while a method compiles, s."""

_WARM: set[type] = set()


class _Simulated:
    """What subjects of instruments and of compensators share: whether they are simulated, and with which faults."""

    plugin: Any
    address: str
    faults: tuple[str, ...] | None

    @property
    def menu(self) -> tuple[str, ...]:
        """Names of the faults to try; a real device or machine is spared them."""
        if not self.simulated:
            return ()
        if self.faults is not None:
            return self.faults
        simulator = self.plugin.info.simulator
        return tuple(getattr(load_object(simulator), "faults", ())) if simulator else ()

    @property
    def simulated(self) -> bool:
        """Whether a simulator answers, and not a device or a machine."""
        return self.address.startswith("sim://")


@dataclass(frozen=True)
class InstrumentSubject(_Simulated):
    """An instrument plugin and an address at which its simulator answers.

    Attributes
    ----------
    plugin : type
        The driver class.
    address : str
        A ``sim://`` address without a fault; faults are added to its query as ``fault=NAME``.
    settings : mapping
        What the driver's ``Settings`` are made from.
    name : str
        Distinguishes several subjects of one plugin.
    make : callable, optional
        ``make(address, record)`` returns a driver, where ``plugin(address, Settings(**settings), record=record)``
        would not do (a driver of several addresses). ``record`` is a path or None.
    faults : tuple of str, optional
        Names of the faults to try; default: what the simulator's class offers in its ``faults``.
    harmless : tuple of str
        Faults that a driver must get over without loss.
    drop_fault, split_fault : str
        Fault that leaves samples out (requested with ``fault_at=10``, from the tenth on), and fault that cuts the
        frames into pieces.
    plausible : (float, float), optional
        Lowest and highest plausible reading in SI units; default: those of its kind. None: no bounds.
    blocks : int
        How many blocks of a stream the kit looks at.
    time_limit : float
        A fault must have become an error, or a counted loss, by then, s.
    dead_address : str
        An address at which nothing answers.
    repeats : bool
        Whether the device gives a reading that was lost once more: after a late answer, equal readings are right.
    vary : callable, optional
        ``vary(number)`` makes the next reading another one; it is called ahead of each reading whose order is examined.
        Default: time passes in the simulated world.
    mutants : int
        How many times a recorded session is replayed with a changed frame; 0: never. Up to 300 within 6 s; of more than
        300 all, however long it takes.
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
        """Return a new driver, not yet opened."""
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
    """A compensator plugin, and a simulated machine that takes its offsets.

    A simulated machine is what ``start(address)`` returns: it has ``driver_url`` (or ``url``), where the compensator
    finds it; ``driver_settings``, a mapping of the settings that it needs there (optional); ``close()``; and
    ``machine``, the machine's part: ``offset`` (X, Y, Z in effect, m), ``orders`` (how many it got), ``slew`` (m/s),
    ``watchdog`` (s), ``busy`` and ``fault`` (texts, to be set), and ``elapse(seconds)``, which lets time pass.
    `errormotion.instruments.simulators.compensator.machine.MachinePart` is one.

    Attributes
    ----------
    plugin : type
        The class.
    address : str
        Parameters of the simulated machine, as a ``sim://`` address; another address is that of a real machine, to
        which nothing is written.
    settings : mapping
        What the ``Settings`` are made from.
    name : str
        Distinguishes several subjects of one plugin.
    start : callable, optional
        ``start(address)`` starts the simulated machine; default: the simulator that ``info`` names.
    offset : (3,) tuple of float
        An offset that is written, m.
    limit : float
        The limit for which it is armed, m.
    resolution : float
        Largest difference of the offset in effect from the one written, m.
    states : tuple of str
        What the compensator can report of a machine: ``busy``, ``fault``.
    faults : tuple of str, optional
        Names of the faults to try; default: what the simulator's class offers in its ``faults``.
    harmless : tuple of str
        Faults that it must get over without an error.
    lost_fault : str
        Fault that breaks the connection.
    time_limit : float
        An error must have come by then, s.
    dead_address : str
        An address at which nothing answers.
    mutants : int
        As of `InstrumentSubject`, for a compensator whose class takes ``record``.
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
        """Return a new compensator, not yet opened; ``settings`` are those of a simulated machine."""
        return self.plugin(address, self.plugin.Settings(**{**(settings or {}), **self.settings}))


@dataclass(frozen=True)
class MethodSubject:
    """A method plugin and a source of raw data whose truth is known.

    Attributes
    ----------
    plugin : type
        The method class.
    make : callable
        ``make(seed)`` returns ``(raw, truth)``: a raw dataset and the true errors in the error schema, relative to the
        same reference state. ``truth`` is interpolated along its numeric coordinate to the places of the result.
    raw_vectors : mapping of str to str
        How the variables of the raw dataset move with the frame: ``point`` and ``direction`` (last dimension x y z),
        ``covariance`` (last two dimensions: point, then direction), ``pose`` (a matrix (4, 4) from a part's own frame
        into one along the axes of this; its origin is a direction), ``x`` ``y`` ``z`` (that coordinate of a point;
        ``motion`` must then keep this axis). All others are taken as numbers that no frame changes. Empty where the
        raw data hold no vectors.
    settings : mapping
        What the method's ``Settings`` are made from.
    setting_vectors : mapping of str to str
        Which of these settings are points and directions in the frame of the raw data.
    name : str
        Distinguishes several subjects of one plugin.
    optional : tuple of str
        Variables of the raw dataset that the method can do without.
    measured : tuple of str
        What the sensors read; may be stored as float32.
    motion : (tuple, tuple)
        Rotation vector (rad) and shift (m) of the frame for the check of frame invariance.
    seeds : int, optional
        How many seeds the checks of coverage take; default: 60, or as many as it takes to see a covariance that is
        30 % off.
    compiles : bool
        Whether the method compiles parts of itself at first use: that is done before the first check.
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

    def __hash__(self) -> int:
        return id(self)

    def effective_settings(self) -> Any:
        """Return the method's settings."""
        return self.plugin.Settings(**self.settings)

    def identify(self, raw: xr.Dataset) -> xr.Dataset:
        """Return what a new object of the method makes of a raw dataset."""
        errors: xr.Dataset = self.plugin().identify(raw, self.effective_settings())
        return errors

    def warm_up(self) -> None:
        """Let the plugin compile what it compiles at first use: that is no part of a check's time. Once a process."""
        if not self.compiles or self.plugin in _WARM:
            return
        _WARM.add(self.plugin)

        def work() -> None:
            with suppress(Exception):  # the checks report what is wrong
                self.identify(self.make(0)[0])

        worker = threading.Thread(target=work, name="warm-up", daemon=True)
        worker.start()
        worker.join(LONGEST_WARM_UP)

    @lru_cache(maxsize=1024)  # noqa: B019 - subjects live as long as the tests that share their results
    def outcome(self, seed: int) -> tuple[xr.Dataset, xr.Dataset]:
        """Return the result and the truth of one seed."""
        raw, truth = self.make(seed)
        return self.identify(raw), truth
