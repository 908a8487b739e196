"""The virtual machine: one seeded individual, its truth, and what the sensors read on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.errors import BenchError
from errormotion.twin import bar as bars
from errormotion.twin import frame as frames
from errormotion.twin import kernels
from errormotion.twin.kinds import machine_kind
from errormotion.twin.schedule import Event, Schedule, StepProgram
from errormotion.twin.state import ThermalState, seeded_state

Array = NDArray[np.float64]

#: grid of the slow motion, s, and its nodes per chunk
GRID = 0.5
CHUNK = 64
#: the spindle reaches full speed in this time, s
SPIN_UP_TIME = 0.75
#: how well the machine finds a position again, m (one sigma, each axis)
REPEATABILITY = 0.3e-6
#: what the speckle does to a reading on the sphere at rest, m (one sigma)
SPECKLE = 0.5e-6
#: sensors count as warm when they have been on for this time, s
WARM_AFTER = 4 * 3600.0

_PART = {name: number for number, name in enumerate(("heat", "frame", "bar", "geometry", "noise", "steps"))}


@dataclass(frozen=True)
class _Nodes:
    """The slow motion over one chunk of time, ready for the kernel."""

    times: Array
    slow: Array
    turns: Array
    pattern: Array


class VirtualMachine:
    """A machine tool that knows its own errors.

    The seed makes an individual: thermal amplitudes, beams, bar, geometric errors, noise. The same seed and the same
    schedule give the same numbers, whatever is asked for in which order.

    Parameters
    ----------
    kind : str
        "cframe" (610 x 510 x 460 mm) or "gantry" (4 x 1.8 x 1 m).
    seed : int
        Which individual.
    warm : bool
        Whether the sensors were switched on long before time 0; otherwise they are switched on then.

    Attributes
    ----------
    name : str
        For people.
    travel : mapping
        Axis to (lowest, highest) position, m.
    chain : str
        Bodies from workpiece to tool.
    frame : FrameGeometry
        The five sensors.
    bar : Bar
        The bar as it truly is; ``bar_radius`` is what its certificate says, m.
    sphere_radius : float
        m.
    state : ThermalState
        Temperatures and thermal errors under the present schedule.
    """

    def __init__(self, kind: str = "cframe", seed: int = 0, *, warm: bool = True) -> None:
        tables = machine_kind(kind)
        self.kind = kind
        self.seed = int(seed)
        self.name = tables.name
        self.travel = dict(tables.travel)
        self.chain = tables.chain
        self.top_speed = tables.top_speed
        self.bar_radius = bars.RADIUS
        self.sphere_radius = 5e-3
        self.sensors_on_for = WARM_AFTER if warm else 0.0
        self.frame = frames.seeded_frame(self._rng("frame"), self.bar_radius)
        self.bar = bars.seeded_bar(self._rng("bar"), len(self.frame.channels))
        self.state: ThermalState = seeded_state(tables, self._rng("heat"), self._schedule(()))
        self._chunks: dict[int, _Nodes] = {}

    def __repr__(self) -> str:
        return f"VirtualMachine({self.kind!r}, seed={self.seed})"

    def _rng(self, part: str) -> np.random.Generator:
        return np.random.default_rng([abs(self.seed), int(self.seed < 0), _PART[part]])

    def _schedule(self, events: Sequence[Event]) -> Schedule:
        return Schedule(tuple(events), self.top_speed / 60 / SPIN_UP_TIME, self.top_speed)

    # ------------------------------------------------------------------ what it does

    def start(self, schedule: Sequence[Event] = ()) -> None:
        """Begin anew at time 0, cold and at rest, with what is commanded from then on.

        Raises
        ------
        BenchError
            Events out of order, a speed that the spindle does not have, an unknown axis.
        """
        self.state = replace(self.state, schedule=self._schedule(schedule))
        self._chunks = {}

    def spindle_speed(self, t: ArrayLike) -> Array:
        """Return the speed of the spindle at times t, 1/min, shape (n,)."""
        return self.state.schedule.speed(np.atleast_1d(np.asarray(t, dtype=float)))

    # ------------------------------------------------------------------ truth

    @property
    def temperature_sensors(self) -> tuple[str, ...]:
        """Names of the places whose temperature is known."""
        return self.state.sensors

    @property
    def spindle_functional_point(self) -> Array:
        """Where the cold axis of rotation meets the end of the bar, m, shape (3,)."""
        return self.bar.point.copy()

    def temperatures(self, t: ArrayLike) -> Array:
        """Return the true temperatures at times t, degC, shape (n, sensor)."""
        return self.state.temperatures(_times(t))

    def spindle_twist(self, t: ArrayLike) -> Array:
        """Return the thermal error of the spindle at ``spindle_functional_point``, m and rad, shape (n, 6).

        Tool side relative to workpiece side, relative to the cold state at time 0.
        """
        return self.state.twist(_times(t))

    def spindle_axis(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return a point on the axis of rotation, m, and its unit direction at times t, each (n, 3).

        The point is the material point at the end of the bar.
        """
        twist = self.spindle_twist(t)
        axis = self.bar.axis + np.cross(twist[:, 3:], self.bar.axis)
        return self.bar.point + twist[:, :3], axis / np.linalg.norm(axis, axis=1, keepdims=True)

    # ------------------------------------------------------------------ readings

    def still_readings(self, t: ArrayLike, *, expansion: bool = True, warm_up: bool = True) -> Array:
        """Return the readings at times t without noise, runout and texture, m, shape (channel, n).

        Parameters
        ----------
        t : (n,)
            Times, s.
        expansion, warm_up : bool
            Whether the frame expands with its temperature, and the sensors warm up.
        """
        t = _times(t)
        origin = self.frame.origins(self.state.warming("frame", t) if expansion else np.zeros(t.size))
        readings = self.bar.still_readings(origin, self.frame.true_direction, *self.spindle_axis(t))
        if warm_up:
            readings = readings + self.frame.warm_up_offset(t + self.sensors_on_for)
        return readings

    def distances(
        self,
        first: int,
        n: int,
        rate: float,
        channels: Sequence[str] | None = None,
        tool: str = "bar",
        motion: StepProgram | None = None,
    ) -> Array:
        """Return what the sensors read: samples first .. first + n - 1 of their streams.

        Parameters
        ----------
        first, n : int
            Counter of the first sample, and how many; sample i is taken at i / rate seconds.
        rate : float
            Samples per second.
        channels : sequence of str, optional
            Which sensors; all where not given.
        tool : {"bar", "sphere"}
            What is in the spindle.
        motion : StepProgram, optional
            How the sphere moves; needed for the sphere.

        Returns
        -------
        ndarray, (channel, n)
            m; NaN out of the measuring range and where a beam misses.
        """
        if first < 0 or n < 0 or not rate > 0:
            raise BenchError(f"Samples need first >= 0, n >= 0, rate > 0; found {first}, {n}, {rate} Hz.")
        chosen = self._chosen(channels)
        out = np.full((chosen.size, n), np.nan)
        if tool == "bar":
            self._read_bar(out, first, float(rate), chosen)
        elif tool == "sphere" and motion is not None:
            self._read_sphere(out, first, float(rate), chosen, motion)
        else:
            raise BenchError(
                f"The spindle holds a 'bar', or a 'sphere' with a StepProgram; found {tool!r}, {motion!r}."
            )
        return out

    def _chosen(self, channels: Sequence[str] | None) -> NDArray[np.int64]:
        names = self.frame.channels if channels is None else tuple(channels)
        unknown = [name for name in names if name not in self.frame.channels]
        if unknown:
            raise BenchError(f"The channels are {', '.join(self.frame.channels)}; found {', '.join(unknown)}.")
        return np.array([self.frame.channels.index(name) for name in names], dtype=np.int64)

    def _read_bar(self, out: Array, first: int, rate: float, chosen: NDArray[np.int64]) -> None:
        keys = np.array([kernels.stream_key(self.seed, _PART["noise"], channel) for channel in chosen])
        span = GRID * CHUNK
        for chunk in range(int(first / rate / span), int((first + out.shape[1]) / rate / span) + 1):
            nodes = self._nodes(chunk)
            kernels.rotating_bar(
                out,
                first,
                rate,
                nodes.times,
                nodes.slow[chosen],
                nodes.turns,
                nodes.pattern[chosen],
                self.frame.noise[chosen],
                keys,
                self.frame.range,
            )

    def _nodes(self, chunk: int) -> _Nodes:
        """Return the slow motion of one chunk of time; always the same numbers, whoever asks."""
        if chunk not in self._chunks:
            grid = (chunk * CHUNK + np.arange(CHUNK + 1)) * GRID
            kinks = self.state.schedule.kinks
            times = np.union1d(grid, kinks[(kinks > grid[0]) & (kinks < grid[-1])])
            middle = np.array([grid[CHUNK // 2]])
            point, axis = self.spindle_axis(middle)
            origin = self.frame.origins(self.state.warming("frame", middle))[:, 0]
            nodes = _Nodes(
                times,
                self.still_readings(times),
                self.state.schedule.turning(times),
                self.bar.pattern(origin, self.frame.true_direction, point[0], axis[0]),
            )
            if len(self._chunks) >= 64:
                self._chunks = {}
            self._chunks[chunk] = nodes
            return nodes
        return self._chunks[chunk]

    def _read_sphere(self, out: Array, first: int, rate: float, chosen: NDArray[np.int64], motion: StepProgram) -> None:
        begins, ends = motion.arrivals, motion.departures
        at = np.clip(begins, motion.begin, None)
        places = motion.places + self.spindle_twist(at)[:, :3] + REPEATABILITY * self._draws(motion, 3).T
        speckle = SPECKLE * self._draws(motion, 3 + len(self.frame.channels))[3:]
        offset = speckle + self.frame.warm_up_offset(at + self.sensors_on_for)
        origin = self.frame.origins(self.state.warming("frame", at[:1]))[:, 0]
        keys = [kernels.stream_key(self.seed, _PART["noise"], len(self.frame.channels) + channel) for channel in chosen]
        kernels.stepped_sphere(
            out,
            first,
            rate,
            begins,
            ends,
            places,
            self.sphere_radius,
            origin[chosen],
            self.frame.true_direction[chosen],
            offset[chosen],
            self.frame.noise[chosen],
            np.array(keys),
            self.frame.range,
        )

    def _draws(self, motion: StepProgram, streams: int) -> Array:
        """Return standard normal numbers (stream, place) that belong to this program on this machine."""
        bits = np.array([motion.begin, *motion.places[1], *motion.places[-2]]).view(np.int64)
        key = [self.seed, _PART["steps"], *(int(b) for b in bits)]
        return np.array([kernels.normals(kernels.stream_key(*key, s), 0, len(motion.places)) for s in range(streams)])


def _times(t: ArrayLike) -> Array:
    return np.atleast_1d(np.asarray(t, dtype=float))
