"""What a person may choose of a thermal model."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from errormotion.datasets.units import Time


class Settings(BaseModel):
    """Settings of the fit; all are left to cross-validation over campaigns where they are not given."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    variant: Literal["auto", "lagged", "dynamics"] = Field(
        default="auto",
        description="lagged: temperatures now and some time ago; dynamics: first-order answers to temperatures and "
        "spindle speed; auto: the one that predicts better",
    )
    sensors: tuple[str, ...] | None = Field(
        default=None, description="temperature sensors to use; chosen by cross-validation where not given"
    )
    most_sensors: int = Field(default=5, description="most sensors that are chosen", ge=0)
    lags: tuple[Time, ...] | None = Field(
        default=None, description="of the lagged variant: how long ago temperatures count as well"
    )
    time_constants: tuple[Time, ...] | None = Field(
        default=None, description="of the dynamics variant: time constants of the first-order answers"
    )
    use_speed: bool = Field(default=True, description="whether the spindle's speed is an input of the dynamics variant")
    use_feed: bool = Field(default=False, description="whether the feed is an input of the dynamics variant")
    least_gain: float = Field(
        default=0.03, description="share by which a further sensor has to make the cross-validated error smaller", ge=0
    )
