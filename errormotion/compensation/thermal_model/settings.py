"""Settings of the fit of a thermal model."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from errormotion.datasets.units import Time


class ThermalModelSettings(BaseModel):
    """Settings of the fit; those not given are selected by cross-validation over campaigns."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    variant: Literal["auto", "lagged", "dynamics"] = Field(
        default="auto",
        description="lagged: present and lagged temperatures; dynamics: first-order responses to temperatures and "
        "spindle speed; auto: the better of both",
    )
    sensors: tuple[str, ...] | None = Field(
        default=None, description="temperature sensors to use; default selected by cross-validation"
    )
    most_sensors: int = Field(default=5, description="largest number of selected sensors", ge=0)
    lags: tuple[Time, ...] | None = Field(default=None, description="lags of the temperatures in the lagged variant")
    time_constants: tuple[Time, ...] | None = Field(
        default=None, description="time constants of the first-order responses in the dynamics variant"
    )
    use_speed: bool = Field(default=True, description="whether the spindle speed is an input of the dynamics variant")
    use_feed: bool = Field(default=False, description="whether the feed is an input of the dynamics variant")
    least_gain: float = Field(
        default=0.03, description="smallest relative decrease of the cross-validated error by a further sensor", ge=0
    )
