"""``[timeline]`` of a campaign: one clock and one warm-up of a virtual machine for all tests.

Without it, the virtual machine is restarted for each method that needs a cold machine, and records state the time of
the computer. With it, all tests measure one machine: the schedule heats it from time 0 on, each test starts at its
``at``, or else at the end of the previous test, and records state their start on this clock.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from errormotion.datasets.timing import later
from errormotion.datasets.units import Speed, Time
from errormotion.errors import BenchError, DatasetError

MAX_EVENTS = 10_000
"""Largest number of events of a schedule."""


class Event(BaseModel):
    """A change of the spindle speed, or switching of a thermal compensation."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    at: Time = Field(ge=0, description="time since the start of the timeline")
    spindle_speed: Speed | None = Field(default=None, ge=0, description="spindle speed from this time on, 1/min")
    compensation: dict[Literal["X", "Y", "Z"], bool] | None = Field(
        default=None, description="thermal compensation of the control by axis, on (true) or off (false)"
    )


class Timeline(BaseModel):
    """``[timeline]``: date of time 0, and the schedule that heats the machine."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    start: str = Field(description="date of time 0 with its offset from UTC, such as 2026-03-02T07:00:00+00:00")
    schedule: tuple[Event, ...] = Field(
        default=(), max_length=MAX_EVENTS, description="spindle speeds and compensation over time"
    )

    @field_validator("start")
    @classmethod
    def _instant(cls, value: str) -> str:
        try:
            return later(value, 0.0)
        except DatasetError as error:
            raise ValueError(str(error)) from None

    @model_validator(mode="after")
    def _rises(self) -> Timeline:
        times = [event.at for event in self.schedule]
        if times != sorted(times):
            raise ValueError(f"schedule: expected times in ascending order; found {times} s")
        return self

    def events(self) -> list[dict[str, Any]]:
        """Return the schedule in the form for a controller."""
        return [
            {"time": each.at, "spindle_speed": each.spindle_speed, "compensation": each.compensation}
            for each in self.schedule
        ]


def follower(instruments: Any) -> Any:
    """Return the driver, or driver class, whose clock can be set; BenchError if there is none."""
    for each in instruments:
        if hasattr(each, "follow"):
            return each
    raise BenchError(
        "[timeline]: expected a controller of a virtual machine on the bench, whose clock can be set",
        code="bench.timeline.no_clock",
    )
