"""Settings of a confocalDT controller."""

from __future__ import annotations

from pydantic import Field

from errormotion.datasets.units import Frequency, Length, Time
from errormotion.instruments.point_lds.confocaldt.codec import RATES
from errormotion.plugins import PluginSettings


class ConfocalSettings(PluginSettings):
    """Settings of one controller. Settings without a value are not changed in the controller."""

    measuring_range: Length | None = Field(
        default=None,
        description="measuring range of the sensor, compared with the one that the controller reports",
        gt=0,
    )
    rate: Frequency | None = Field(
        default=None,
        description="measuring rate, written to the controller in steps of 100 Hz; limited by the model",
        ge=RATES[0],
        le=RATES[1],
    )
    noise: Length = Field(default=0.0, description="standard deviation of a single reading; 0: unknown", ge=0)
    timeout: Time = Field(default=1.0, description="time limit for an answer", gt=0)
