"""Settings of the method: the test to plan or to simulate, and the evaluation."""

from __future__ import annotations

import math
from typing import Literal

from pydantic import Field

from errormotion.datasets.units import Angle, Length, Velocity
from errormotion.plugins import PluginSettings

DEGREE = math.pi / 180


class CircularTestSettings(PluginSettings):
    """The test to plan or to simulate, the evaluation, and the limits of the figures."""

    # The test
    plane: Literal["XY", "YZ", "ZX"] = Field(
        default="XY", description="axes of the circle; angles count from the first one"
    )
    centre: tuple[Length, Length, Length] = Field(
        default=(0.0, 0.0, 0.0), description="programmed centre of the circle, machine coordinates"
    )
    nominal_radius: Length = Field(default=0.15, gt=0.01, lt=5.0, description="programmed radius of the circle")
    feed: Velocity = Field(default=1.0 / 60, gt=0, description="programmed feed along the circle")
    runs: int = Field(default=2, ge=1, description="circles in each direction of travel")
    samples: int = Field(default=1080, ge=36, description="readings on each circle")
    length_noise: Length = Field(default=0.2e-6, gt=0, description="standard deviation of one reading, for planning")
    length_uncertainty: Length = Field(
        default=0.5e-6, ge=0, description="standard uncertainty of the calibrated length of the bar, for planning"
    )

    # Evaluation
    places: int = Field(
        default=180,
        ge=36,
        multiple_of=4,
        description="sectors of the circle over which readings are averaged; a multiple of 4, so that axes reverse "
        "between sectors",
    )
    largest_gap: Angle = Field(
        default=6 * DEGREE, gt=0, lt=0.5, description="largest arc without a reading; only full circles can be centred"
    )
    spike_decay: Angle = Field(
        default=3 * DEGREE,
        gt=0,
        lt=0.8,
        description="arc over which a spike at the reversal of an axis decays to 1/e in the model of the path",
    )
    noise: Literal["auto", "stated"] = Field(
        default="auto", description="the stated noise of a reading, increased if the readings scatter more (auto)"
    )
    drift: Literal["auto", "none"] = Field(
        default="auto",
        description="remove a linear drift of the bar, if times and repeated circles determine it (auto)",
    )

    # Limits of the figures
    circular_deviation_limit: Length | None = Field(
        default=None, gt=0, description="limit of G(CW), G(CCW) and G(b); default none"
    )
    hysteresis_limit: Length | None = Field(default=None, gt=0, description="limit of H; default none")
