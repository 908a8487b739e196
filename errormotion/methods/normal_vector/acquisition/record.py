"""Raw dataset of a cycle: contacts, temperatures and history."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.errors import InstrumentError
from errormotion.methods.normal_vector.acquisition import cycle, touching
from errormotion.methods.normal_vector.schema import SCHEMA, TOUCH_FLAGS
from errormotion.plugins import Bench, Contact

if TYPE_CHECKING:
    from errormotion.methods.normal_vector.settings import NormalVectorSettings

log = logging.getLogger(__name__)

NOT_MADE = TOUCH_FLAGS.index("not made")
MIN_TOUCHES = 3
"""Smallest number of good touches of each ball in the cold cycle."""
RUN_ATTRIBUTES = ("start", "cold_cycle_seconds", "clock_origin")
"""Attributes common to all cycles: UTC and machine clock at the start of the cold cycle, and its duration."""

_M, _S = {"units": "m"}, {"units": "s"}


class Record:
    """Builds the raw datasets of the cycles.

    Parameters
    ----------
    bench : Bench
        Its thermometers are read at the start of each cycle; missing readings are NaN.
    settings : NormalVectorSettings
    probe : touch probe
    done : Dataset, optional
        Cycles of an interrupted run.

    Attributes
    ----------
    first : int
        Number of the first cycle to be measured.
    touches : list of Touch
        Of every cycle, in order.
    """

    def __init__(self, bench: Bench, settings: NormalVectorSettings, probe: Any, done: xr.Dataset | None) -> None:
        self.settings = settings
        self.first = 0 if done is None else cycle.following(settings, float(done["time"].values[-1]))
        self.tip_radius = float(settings.tip_radius or probe.tip_radius)
        stated = settings.touch_noise or float(probe.noise)
        self.noise = float(stated) if math.isfinite(stated) else None
        self.touches, self._order = cycle.cycle_touches(settings, self.tip_radius)
        self._machine = bench.machine
        self._thermometers = bench.all_of_kind("thermometer")
        self._columns = _columns(self._thermometers)
        self._temperature = np.full(len(self._columns), np.nan)
        self._invalid: Counter[str] = Counter()
        self._timed: bool | None = None if done is None else "touch_time" in done
        self._latest = -math.inf  # contact, on the machine's clock, s
        self._start = ""
        self._attrs = None if done is None else {name: done.attrs[name] for name in RUN_ATTRIBUTES}

    def start_cycle(self) -> None:
        """Start a cycle: read all thermometers; missing temperatures are NaN and counted."""
        self._start = self._start or datetime.now(UTC).isoformat(timespec="milliseconds")
        self._temperature[:] = np.nan
        for name, thermometer in self._thermometers.items():
            try:
                reading: Mapping[str, float] = thermometer.read()
            except InstrumentError as error:
                log.warning("no temperatures of %s: %s", name, error)
                self._invalid[f"no answer of {name}"] += len(thermometer.channels)
                continue
            for channel, value in reading.items():
                self._temperature[self._columns.index((name, channel))] = value
                if math.isnan(value):
                    self._invalid[f"{channel} unknown"] += 1

    def in_time(self, contacts: Iterable[Contact]) -> Iterator[Contact]:
        """Yield printed contacts.

        Raises
        ------
        InstrumentError
            A contact is not later than the previous cycle: its line was delayed or repeated.
        """
        previous = self._latest
        for contact in contacts:
            if contact.time <= previous:
                raise InstrumentError(
                    f"Expected contacts of this cycle; the machine printed one at {contact.time:.3f} s, and the "
                    f"previous cycle ended at {previous:.3f} s on its clock. Check for repeated lines and the clock.",
                    code="probing.contact.early",
                )
            self._latest = contact.time if math.isfinite(contact.time) else self._latest
            yield contact

    def refuse_unknown_balls(self, contacts: Sequence[Contact]) -> None:
        """Check that the cold cycle has enough good touches of every ball.

        Raises
        ------
        InstrumentError
            A ball has too few; the message lists the flags of its touches.
        """
        flags: dict[int, Counter[str]] = {ball: Counter() for ball in range(len(self.settings.balls))}
        for (ball, _), contact in zip(self._order, contacts, strict=True):
            flags[ball][contact.flag or "good"] += 1
        insufficient = [
            f"{name} ({', '.join(f'{count} {flag}' for flag, count in flags[ball].items())})"
            for ball, name in enumerate(touching.names(self.settings))
            if flags[ball]["good"] < MIN_TOUCHES
        ]
        if insufficient:
            raise InstrumentError(
                f"The cold cycle has too few good touches of {'; '.join(insufficient)}; expected {MIN_TOUCHES} or "
                "more of each, since it is the reference of all others. Check the positions of the balls (settings).",
                code="probing.cold.touches_too_few",
            )

    def dataset(
        self, contacts: Sequence[Contact], start: float, end: float, origin: float, history: tuple[float, float]
    ) -> xr.Dataset:
        """Return the raw dataset of one cycle.

        Parameters
        ----------
        contacts : sequence of Contact
            In the order of ``touches``; those missing in an interrupted cycle are ``not made``.
        start, end : float
            Of the cycle, s since the start of the cold cycle. The end is used for the cold cycle only.
        origin : float
            Clock of the machine at the start of the cold cycle, s.
        history : (float, float)
            Mean spindle speed (1/min) and mean feed (m/s) since the previous cycle.
        """
        b, m = len(self.settings.balls), self.settings.touches
        position, time = np.full((1, b, m, 3), np.nan), np.full((1, b, m), np.nan)
        flag = np.full((1, b, m), NOT_MADE, dtype=np.int8)
        for (ball, touch), contact in zip(self._order, contacts, strict=False):
            position[0, ball, touch], time[0, ball, touch] = contact.position, contact.time - origin
            flag[0, ball, touch] = TOUCH_FLAGS.index(contact.flag) if contact.flag in TOUCH_FLAGS else NOT_MADE
            self._invalid.update([contact.flag] if contact.flag else [])
        self._invalid.update({"not made": len(self._order) - len(contacts)} if len(contacts) < len(self._order) else {})
        if self._timed is None:
            self._timed = bool(np.isfinite(time).any())
        if self._attrs is None:
            self._attrs = dict(zip(RUN_ATTRIBUTES, (self._start, float(end), float(origin)), strict=True))
        variables: dict[str, Any] = {
            "touch": (("time", "ball", "touch", "direction"), position, _M),
            "touch_flag": (("time", "ball", "touch"), flag, {"units": "1"}),
            "approach": (("ball", "touch", "direction"), -touching.normals(self.settings), {"units": "1"}),
            "tip_radius": ((), self.tip_radius, _M),
            "ball_radius": ("ball", np.array([ball.radius for ball in self.settings.balls]), _M),
            "ball_nominal": (("ball", "direction"), np.array([ball.centre for ball in self.settings.balls]), _M),
            "spindle_speed": ("time", np.array([history[0]]), {"units": "1/min"}),
            "feed": ("time", np.array([history[1]]), {"units": "m/s"}),
        }
        if self._timed:
            variables["touch_time"] = (("time", "ball", "touch"), time, _S)
        if self.noise is not None:
            variables["touch_noise"] = ((), self.noise, _M)
        coords: dict[str, Any] = {
            "time": ("time", np.array([start]), _S),
            "ball": touching.names(self.settings),
            "direction": list("xyz"),
        }
        if self._columns:
            coords["sensor"] = _names(self._columns)
            variables["temperature"] = (("time", "sensor"), self._temperature[None].copy(), {"units": "degC"})
        invalid, self._invalid = dict(self._invalid), Counter()
        attrs = {
            "schema": SCHEMA,
            "machine": self._machine,
            "frame": "machine",
            "tool_axes": self.settings.tool_axes,
            "dropped": 0,
            "invalid": invalid,
            **self._attrs,
        }
        return xr.Dataset(variables, coords, attrs)


def _columns(thermometers: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(name, channel) for name, each in thermometers.items() for channel in each.channels]


def _names(columns: Sequence[tuple[str, str]]) -> list[str]:
    """Return the names of the sensors, preceded by the thermometer where names are equal."""
    count = Counter(channel for _, channel in columns)
    return [channel if count[channel] == 1 else f"{name}.{channel}" for name, channel in columns]
