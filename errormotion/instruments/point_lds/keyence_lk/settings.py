"""Settings of an LK-G or LK-H."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from errormotion.datasets.units import Frequency, Length, Time
from errormotion.errors import InstrumentError
from errormotion.instruments.point_lds.keyence_lk.codec import CONTROLLERS, DISPLAYS, HEADS, check_rate
from errormotion.plugins import PluginSettings

Head = Literal[
    "LK-H008", "LK-H020", "LK-H050", "LK-H080", "LK-H150", "LK-G10", "LK-G15", "LK-G30", "LK-G80", "LK-G150", "LK-G400"
]
Unit = Literal["0.01 mm", "0.001 mm", "0.0001 mm", "0.00001 mm", "0.1 um", "0.01 um", "0.001 um"]


class LKSettings(PluginSettings):
    """Settings of one sensor head."""

    head: Head = Field(default="LK-H050", description="sensor head; the controller does not report it")
    serial_number: str = Field(default="", description="serial number of the head; the controller does not report it")
    controller: Literal["LK-G5000", "LK-G3000"] = Field(default="LK-G5000", description="generation of the controller")
    output: int = Field(default=1, description="output (OUT) of the controller for the head", ge=1)
    display: Unit = Field(default="0.0001 mm", description="smallest displayed unit of the controller")
    positive: Literal["near", "far"] = Field(
        default="near", description="side of the middle of the range on which the controller's readings are positive"
    )
    set_up: Literal["check", "set", "trust"] = Field(
        default="check",
        description="check: compare display unit and offset of the controller; set: write them; trust: do neither",
    )
    rate: Frequency = Field(default=100.0, description="readings per second of a stream, requested one by one", gt=0)
    baudrate: int = Field(default=115200, description="baud rate of a serial line", gt=0)
    noise: Length = Field(default=0.1e-6, description="standard deviation of a single reading", ge=0)
    timeout: Time = Field(default=1.0, description="time limit for an answer", gt=0)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        controller, display = CONTROLLERS[self.controller], DISPLAYS[self.display]
        if self.output > controller.outputs:
            raise ValueError(f"the {self.controller} has the outputs 1 to {controller.outputs}; found {self.output}")
        if self.controller == "LK-G3000" and self.head.startswith("LK-H"):
            raise ValueError(f"the {self.controller} is for heads LK-G; found {self.head}")
        if (largest := max(map(abs, HEADS[self.head]))) > display.largest:
            raise ValueError(
                f"the display unit {self.display} shows up to {display.largest * 1e3:g} mm, but the {self.head} "
                f"measures to {largest * 1e3:g} mm; choose a coarser unit"
            )
        try:
            check_rate(self.rate, self.baudrate, controller)
        except InstrumentError as error:
            raise ValueError(str(error)) from None
        return self
