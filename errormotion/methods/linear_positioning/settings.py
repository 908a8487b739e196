"""Settings of the method, for a campaign file or ``--set``."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from errormotion.datasets.units import Angle, Length, Quantity, Temperature, Time, Velocity
from errormotion.plugins import PluginSettings

Coefficient = Annotated[float, Quantity("a coefficient of expansion", "1/K", "11.5 um/m/K")]
TemperatureStep = Annotated[float, Quantity("a difference of temperatures", "K", "0.2 K")]
Ratio = Annotated[float, Quantity("a ratio", "1", "0.5 um/m")]
Point = tuple[Length, Length, Length]
Span = tuple[Length, Length]

Freedom = Literal["EX", "EY", "EZ", "EA", "EB", "EC"]
FREEDOMS: tuple[Freedom, ...] = ("EX", "EY", "EZ", "EA", "EB", "EC")
MINUTE = 60.0
BODY_DIAGONALS = ("PPP", "NPP", "PNP", "NNP")
"""The four body diagonals of a volume, with increasing Z."""
LIMITS = {"A": "accuracy_limit", "R": "repeatability_limit", "B": "reversal_limit"}
"""Figures of positioning that may have a limit, and its setting."""


class Side(PluginSettings):
    """One side of the nominal differential expansion, where the data do not state it."""

    expansion: Coefficient | None = Field(default=None, ge=0, description="coefficient of expansion")
    expansion_uncertainty: Coefficient = Field(
        default=0.6e-6, ge=0, description="standard uncertainty of the coefficient; 2 um/m/K in full width"
    )
    temperature: Temperature | None = Field(default=None, description="during the test")
    sensors: tuple[str, ...] = Field(default=(), description="names of the temperature sensors on this side")


ASSUMED_LENGTH, ASSUMED_ALIGNMENT = 0.5e-6, 0.2e-3
"""Standard uncertainties of lengths (relative) and of the alignment (rad) where nothing states them."""


class Budget(PluginSettings):
    """Standard uncertainties by source, where the data do not state them (ISO/TR 230-9)."""

    length: Ratio | None = Field(
        default=None,
        ge=0,
        description="relative, of the lengths of the instrument: wavelength, air, calibration; default 0.5 um/m, "
        "assumed",
    )
    alignment: Angle | None = Field(
        default=None,
        ge=0,
        le=0.1,
        description="of the angle between the measured line and the axis, in each of two directions. If it is stated, "
        "further figures are corrected for its mean cosine error; default 0.2 mrad, assumed, for the uncertainty only",
    )
    temperature: TemperatureStep = Field(default=0.2, ge=0, description="of the temperature of one side")
    drift: Length | None = Field(
        default=None,
        ge=0,
        description="range of the readings at rest during one run (environmental test): lower bound of the drift from "
        "run to run; required with fewer than four runs",
    )
    scatter: Length | None = Field(
        default=None,
        gt=0,
        description="standard deviation of a reading: lower bound of its estimate; required with a single run",
    )

    @property
    def length_or_assumed(self) -> float:
        """Relative standard uncertainty of lengths, stated or assumed."""
        return ASSUMED_LENGTH if self.length is None else self.length

    @property
    def alignment_or_assumed(self) -> float:
        """Standard uncertainty of the alignment, stated or assumed, rad."""
        return ASSUMED_ALIGNMENT if self.alignment is None else self.alignment


class Moving(PluginSettings):
    """Thermal distortion by a moving axis (ISO 230-3), read at both ends of the stroke during warm-up and cooling."""

    cold: int = Field(default=5, ge=1, le=1000, description="readings of both ends before the axis starts to move")
    duration: Time = Field(default=240 * MINUTE, gt=0, description="time for which the axis moves")
    cooling: Time = Field(default=60 * MINUTE, ge=0, description="time for which the axis is read at rest afterwards")
    interval: Time = Field(default=5 * MINUTE, gt=0, description="from reading to reading")
    feed: Velocity = Field(default=10.0 / MINUTE, gt=0, description="feed of the moves between the readings")


class Diagonals(PluginSettings):
    """Displacements along diagonals of a volume (ISO 230-6)."""

    names: tuple[str, ...] = Field(
        default=BODY_DIAGONALS,
        min_length=1,
        description="one letter each for X, Y, Z: P the axis moves in positive direction, N in negative direction, 0 "
        "it is at rest; PPP and NPP are body diagonals, PP0 and NP0 those of a face parallel to XY",
    )
    volume: tuple[Span, Span, Span] = Field(
        default=((0.0, 0.5), (0.0, 0.4), (0.0, 0.3)),
        description="lowest and highest position of X, Y and Z; an axis at rest is at its position in start",
    )
    channels: dict[str, str] = Field(
        default_factory=dict,
        description="channel of the interferometer for each diagonal, with a leading '-' if it counts down; default "
        "its only channel",
    )

    @model_validator(mode="after")
    def _fits(self) -> Diagonals:
        for axis, (low, high) in zip("XYZ", self.volume, strict=True):
            if not low < high:
                raise ValueError(f"volume: expected the lower end of {axis} first; found {low:g} m and {high:g} m")
        lines = []
        for name in self.names:
            if len(name) != 3 or set(name) - set("PN0") or name.count("0") > 1:
                raise ValueError(
                    f"names: expected three letters P, N or 0, at most one 0, such as PPP or NP0; found '{name}'"
                )
            lines.append(name if name.strip("0")[0] == "P" else name.translate(str.maketrans("PN", "NP")))
        if len(set(lines)) < len(lines):
            raise ValueError(f"names: expected each diagonal once, in one direction; found {', '.join(self.names)}")
        if unknown := set(self.channels) - set(self.names):
            raise ValueError(f"channels: expected diagonals among {', '.join(self.names)}; found {sorted(unknown)[0]}")
        return self


class LinearPositioningSettings(PluginSettings):
    """Settings of ``linear_positioning``: the test, its evaluation, and its sources of uncertainty."""

    # The test
    axis: Literal["X", "Y", "Z"] = Field(default="X", description="axis that moves")
    freedoms: tuple[Freedom, ...] = Field(
        default=("EX",), min_length=1, description="freedoms that are measured, such as EX for positioning along X"
    )
    travel: tuple[Length, Length] = Field(
        default=(0.0, 0.5),
        description="first and last position of the targets; default: the travel of the machine, if it is known",
    )
    limits: tuple[Length, Length] | None = Field(
        default=None, description="lowest and highest position of the axis, overrun included; default none"
    )
    targets: tuple[Length, ...] = Field(
        default=(), description="target positions; by default over the travel, with a random part (ISO 230-2)"
    )
    count: int = Field(
        default=0, ge=0, le=1000, description="number of targets; 0: as ISO 230-2 requires for the travel, at least 11"
    )
    random_part: Length | None = Field(
        default=None,
        ge=0,
        description="largest random part of a target position; default 30 % of the interval, so that periodic errors "
        "are sampled",
    )
    seed: int = Field(default=1, ge=0, description="seed of the random parts")
    runs: int = Field(default=5, ge=1, le=100, description="approaches to each target in each direction")
    cycle: Literal["linear", "pendulum"] = Field(
        default="linear",
        description="linear: all targets forward, then all backward, for each run; pendulum: all runs at one target "
        "from both directions, then the next target",
    )
    moving: Moving | None = Field(
        default=None,
        description="measure the thermal distortion by the moving axis at both ends of the travel instead of targets",
    )
    diagonals: Diagonals | None = Field(
        default=None, description="measure displacements along diagonals of a volume instead of one axis"
    )
    start: Point = Field(default=(0.0, 0.0, 0.0), description="positions of the axes that do not move")
    overrun: Length = Field(default=2e-3, gt=0, description="distance beyond a target at which the axis reverses")
    feed: Velocity = Field(default=1.0 / MINUTE, gt=0, description="feed of the approaches")
    dwell: Time = Field(default=4.0, ge=0, description="dwell at a target, in which it is read")
    settle: Time = Field(default=2.0, ge=0, description="part of the dwell before the reading")
    channels: dict[Freedom, str] = Field(
        default_factory=dict,
        description="channel of the interferometer for each freedom, with a leading '-' if it counts down; default its "
        "only channel",
    )
    average: int = Field(default=10, ge=1, le=10_000, description="readings averaged at each target")
    arrival: Length = Field(
        default=0.1e-3, gt=0, description="distance from a target at which the axis has arrived, by the control"
    )
    timeout: Time = Field(default=120.0, gt=0, description="time limit of a move")
    functional_point: Point | None = Field(
        default=None,
        description="point whose displacement is measured, with the axis at zero; used if the data do not state it",
    )
    straightness_reference: Literal["table", "tool"] | None = Field(
        default=None,
        description="whether the point at which a straightness is read is fixed to the table or to the tool; used if "
        "the data do not state it; default unknown",
    )

    # Evaluation
    scatter: Literal["auto", "pooled", "target"] = Field(
        default="auto",
        description="variance of the readings of each approach: one for all targets (pooled), each target its own "
        "(target), or pooled unless the variances differ significantly (auto)",
    )
    trials: int = Field(
        default=2000, ge=200, le=100_000, description="simulated repetitions for bias and uncertainty of the figures"
    )
    reference_temperature: Temperature = Field(default=20.0, description="temperature for which the errors are stated")
    machine: Side = Field(default_factory=Side, description="positioning system of the axis")
    workpiece: Side = Field(
        default_factory=lambda: Side(expansion=0.0, expansion_uncertainty=0.0),
        description="artefact that embodies the lengths; the default, no expansion, is that of an interferometer",
    )
    uncertainty: Budget = Field(default_factory=Budget, description="sources that the data do not state")

    # Limits of the figures
    accuracy_limit: Length | None = Field(default=None, gt=0, description="limit of A of positioning; default none")
    repeatability_limit: Length | None = Field(
        default=None, gt=0, description="limit of R of positioning; default none"
    )
    reversal_limit: Length | None = Field(default=None, gt=0, description="limit of B of positioning; default none")

    @model_validator(mode="after")
    def _fits(self) -> LinearPositioningSettings:
        low, high = self.travel
        if not low < high:
            raise ValueError(f"travel: expected the lower end first; found {low:g} m and {high:g} m")
        if self.limits is not None and not self.limits[0] < self.limits[1]:
            low, high = self.limits
            raise ValueError(f"limits: expected the lower end first; found {low:g} m and {high:g} m")
        if len(set(self.freedoms)) < len(self.freedoms):
            raise ValueError(f"freedoms: expected each once; found {', '.join(self.freedoms)}")
        if self.targets and (len(self.targets) < 3 or np.unique(self.targets).size < len(self.targets)):
            raise ValueError("targets: expected three or more different positions")
        if 0 < self.count < 3:
            raise ValueError(f"count: expected 3 targets or more; found {self.count}")
        if self.moving is not None and self.diagonals is not None:
            raise ValueError("diagonals: expected either diagonals or a moving axis; found both")
        if self.settle > self.dwell:
            raise ValueError(f"settle: expected at most the dwell, {self.dwell:g} s; found {self.settle:g} s")
        return self
