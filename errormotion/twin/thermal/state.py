"""Temperatures of the machine, and the thermal error of its spindle."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from errormotion.arrays import Array
from errormotion.twin.kinds import MachineKind
from errormotion.twin.schedule import Schedule
from errormotion.twin.thermal.network import Ambient, LagResponse, ThermalNetwork

_DOF = ("EX", "EY", "EZ", "EA", "EB", "EC")


@dataclass(frozen=True)
class ThermalState:
    """One machine under one schedule: temperatures and the thermal error of its spindle at any time.

    Attributes
    ----------
    kind : MachineKind
        The tables.
    network : ThermalNetwork
        Bodies.
    ambient : Ambient
        Air.
    growth : ndarray, (6, body)
        Twist of the spindle at the end of the bar per kelvin of each body, m/K and rad/K.
    correction : ndarray, (3,)
        Steady correction of X, Y, Z by the control at top speed, m.
    schedule : Schedule
        The commands.
    offset : (times, offsets), optional
        Offsets that a compensation adds to the commands: times (n,), s, and X, Y, Z, (n, 3), m; linear between,
        constant before and after.
    """

    kind: MachineKind
    network: ThermalNetwork
    ambient: Ambient
    growth: Array
    correction: Array
    schedule: Schedule
    offset: tuple[Array, Array] | None = None
    _cold: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_cold", self.bodies(np.zeros(1))[0])

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the temperatures: of the bodies, the middle of the column, and the air."""
        return (*self.network.names, "column", "ambient")

    def power(self, speed: ArrayLike) -> Array:
        """Return the spindle's heat at a speed in 1/min, W."""
        n = np.asarray(speed, dtype=float)
        return self.kind.heat_linear * n + self.kind.heat_square * n**2

    def bodies(self, t: ArrayLike) -> Array:
        """Return the bodies' temperatures at times t, degC, shape (n, body)."""
        air = self.network.air_response(t, self.ambient, self._transfer)
        return air + self.network.heating(t, self._heated)

    @cached_property
    def _transfer(self) -> NDArray[np.complex128]:
        """Response of the network to the air."""
        return self.network.transfer(self.ambient)

    @cached_property
    def _heated(self) -> LagResponse:
        """Response of the network to the spindle."""
        return self.network.heated(self.schedule.speed_times, self.power(self.schedule.speeds))

    def temperatures(self, t: ArrayLike) -> Array:
        """Return the temperatures at times t, degC, shape (n, sensor)."""
        bodies = self.bodies(t)
        front, rear = (self.network.names.index(f"column_{side}") for side in ("front", "rear"))
        column = (bodies[:, front] + bodies[:, rear]) / 2
        return np.column_stack([bodies, column, self.ambient(t)])

    def warming(self, body: str, t: ArrayLike) -> Array:
        """Return the temperature rise of a body since the cold state, K, shape (n,)."""
        index = self.network.names.index(body)
        return np.asarray(self.bodies(t)[:, index] - self._cold[index])

    def correction_at(self, t: ArrayLike) -> Array:
        """Return the full correction of X, Y, Z by the control's model, m, shape (n, 3)."""
        return np.asarray(self._loaded(t) * self._loaded.rates * self.correction)

    @cached_property
    def _loaded(self) -> LagResponse:
        """Response of the control's model of X, Y, Z to the share of the heat at top speed."""
        load = self.power(self.schedule.speeds) / self.power(self.kind.top_speed)
        rates = np.array([1 / self.kind.compensation[axis][1] for axis in "XYZ"])
        return LagResponse(rates, self.schedule.speed_times, load)

    @cached_property
    def _before_the_spindle(self) -> list[int]:
        """Numbers of the bodies that rotate the frame of the axes."""
        return [body for body, name in enumerate(self.network.names) if name not in self.kind.behind]

    def twist(self, t: ArrayLike) -> Array:
        """Return the spindle's thermal error at the end of the bar, m and rad, shape (n, 6); 0 in the cold state."""
        return self.twist_and_turn(t)[0]

    def twist_and_turn(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return `twist`, and the part of its rotation that rotates the frame of the axes, rad, shape (n, 3)."""
        warming = self.bodies(t) - self._cold
        grown = np.multiply(warming.T[:, :, None], self.growth.T[:, None], order="C")  # body, time, freedom
        twist = grown.sum(axis=0)
        turn = grown[self._before_the_spindle, :, 3:].sum(axis=0)
        twist[:, :3] -= self.correction_at(t) * self.schedule.compensation(t)
        if self.offset is not None:
            times, offsets = self.offset
            twist[:, :3] += np.column_stack(
                [np.interp(np.asarray(t, dtype=float), times, column) for column in offsets.T]
            )
        return twist, turn


def seeded_ambient(rng: np.random.Generator) -> Ambient:
    """Return the air of a good workshop: a daily wave of 0.1 K and faster ones of hundredths of a kelvin."""
    period = np.array([86400.0, *(rng.uniform(*span) for span in ((9000, 15000), (4000, 7000), (1500, 3000)))])
    amplitude = np.array([0.1, 0.03, 0.02, 0.01]) * rng.uniform(0.8, 1.2, 4)
    return Ambient(20.0 + rng.uniform(-0.5, 0.5), amplitude, 2 * np.pi / period, rng.uniform(0, 2 * np.pi, 4))


def seeded_state(kind: MachineKind, rng: np.random.Generator, schedule: Schedule) -> ThermalState:
    """Return the thermal state of one machine: the tables, with amplitudes varied by up to 1.5 percent."""
    network = ThermalNetwork.of(kind.capacity, kind.links, kind.to_air, kind.heat_share)
    growth = np.array([[kind.growth[dof].get(body, 0.0) * 1e-6 for body in network.names] for dof in _DOF])
    growth *= rng.uniform(0.985, 1.015, (6, 1))
    correction = np.array([kind.compensation[axis][0] for axis in "XYZ"]) * rng.uniform(0.99, 1.01, 3)
    return ThermalState(kind, network, seeded_ambient(rng), growth, correction, schedule)
