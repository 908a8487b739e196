"""Settings of the method: what a campaign file or ``--set`` may say."""

from __future__ import annotations

import math
from itertools import combinations, pairwise
from typing import Literal

from pydantic import Field, model_validator

from errormotion.datasets.units import Angle, Length, Speed, Time, Velocity
from errormotion.plugins import PluginSettings

MINUTE = 60.0

Axes = Literal["XYZ", "XY", "XZ", "YZ", "X", "Y", "Z", ""]
"""Linear axes that carry the tool; the others carry the workpiece."""


class Ball(PluginSettings):
    """A ball on the table."""

    centre: tuple[Length, Length, Length] = Field(description="rough place of its centre, machine coordinates")
    radius: Length = Field(default=12.5e-3, gt=0, description="radius of the ball")
    name: str = Field(default="", description="name of the ball; default its number, from 1")


class Event(PluginSettings):
    """A spindle speed from a stated time on."""

    at: Time = Field(ge=0, description="time since the warm-up began, which is when the cold cycle is over")
    spindle_speed: Speed = Field(ge=0, description="spindle speed from here on, 1/min")


class Settings(PluginSettings):
    """Settings of ``normal_vector``."""

    # What is touched
    balls: tuple[Ball, ...] = Field(default=(), description="the balls on the table, three or more")
    touches: int = Field(default=5, ge=4, description="touches of each ball: one on top, the others around")
    elevation: Angle = Field(
        default=0.0, ge=0, lt=1.4, description="how far above the equator the touches around the ball lie"
    )
    order: Literal["there and back", "forward"] = Field(
        default="there and back",
        description="one half of the touches from the first ball to the last, the other half on the way back, so that "
        "every ball has the same mean time; or ball after ball",
    )
    tip_radius: Length | None = Field(
        default=None, gt=0, description="radius of the tip; default what the probe states"
    )
    touch_noise: Length | None = Field(
        default=None,
        gt=0,
        description="standard deviation of one touch along its normal; default what the probe states",
    )

    # How the machine goes about it
    approach: Length = Field(default=4e-3, gt=0, description="way from the start of a touch to where contact is due")
    overtravel: Length = Field(
        default=3e-3, gt=0, description="how far behind the due contact a touch that finds nothing ends"
    )
    clearance: Length = Field(
        default=15e-3,
        gt=0,
        description="how high above the starts of touches the tip passes; where the probe states one, that holds",
    )
    probing_feed: Velocity = Field(
        default=0.3 / MINUTE, gt=0, description="feed of the touches, where the probe states none"
    )
    positioning_feed: Velocity = Field(
        default=5.0 / MINUTE, gt=0, description="feed of all other moves of a cycle, where the probe states none"
    )
    # Warm-up
    duration: Time = Field(default=180 * MINUTE, gt=0, description="length of the warm-up behind the cold cycle")
    interval: Time = Field(
        default=10 * MINUTE, gt=0, description="time from the begin of one probing cycle to the next"
    )
    schedule: tuple[Event, ...] = Field(default=(), description="spindle speeds over time")
    moves: tuple[tuple[Length, Length, Length], ...] = Field(
        default=(),
        description="places that the machine goes to in turn between the cycles, to warm its axes; on straight ways "
        "that no ball may stand in",
    )
    moves_feed: Velocity = Field(default=10.0 / MINUTE, gt=0, description="feed of these moves")
    settle: Time = Field(default=2.0, ge=0, description="rest after the spindle was stopped, before the first touch")
    to_probe: tuple[str, ...] = Field(
        default=(), description="lines of a program that put the probe into the spindle, such as 'T9 M6'"
    )
    to_warm_up: tuple[str, ...] = Field(
        default=(), description="lines of a program that put the tool of the warm-up into the spindle"
    )
    dwell: Literal["P s", "P ms", "X s"] = Field(
        default="P s", description="how programs write a rest: G4 with P in s, P in ms, or X in s"
    )

    # Identification
    tool_axes: Axes = Field(
        default="XYZ",
        description="linear axes that carry the tool (a gantry XYZ, a C-frame with a cross table Z); a raw dataset "
        "with the attribute tool_axes knows better",
    )
    functional_point: tuple[Length, Length, Length] | None = Field(
        default=None, description="where the errors are stated; default the mean of the balls' centres, to 0.1 mm"
    )
    procedure: Literal["rigid", "normals"] = Field(
        default="rigid",
        description="all touches of all balls at once, most likely; or the normals of two planes through four balls, "
        "as published",
    )
    normals_balls: tuple[str, str, str, str] | None = Field(
        default=None, description="balls P1 P2 P3 P4 of the two planes; default the first four"
    )
    reference: Literal["cold", "first"] = Field(
        default="cold", description="the cold cycle at time 0; or the first cycle that there is, whenever it was"
    )
    interpolate: bool = Field(
        default=True, description="between the cycles the error drifts smoothly, also while a cycle is probed"
    )
    robust: bool = Field(default=True, description="leave out wrong touches and balls that moved, and name them")
    smallest_move: Length = Field(default=1e-6, gt=0, description="a ball that is off by less has not moved")
    noise: Literal["auto", "stated"] = Field(
        default="auto", description="the stated noise of a touch, raised where the touches scatter more (auto)"
    )
    ball_tolerance: Length = Field(
        default=5e-3, gt=0, description="how far a ball may lie off its rough place, and its radius off its nominal one"
    )

    @model_validator(mode="after")
    def _fits(self) -> Settings:
        names = [ball.name or str(i + 1) for i, ball in enumerate(self.balls)]
        if len(set(names)) < len(names):
            raise ValueError(f"balls: expected names that differ; found {', '.join(names)}")
        times = [event.at for event in self.schedule]
        if any(second <= first for first, second in pairwise(times)):
            raise ValueError(f"schedule: expected times that rise; found {times} s")
        if self.normals_balls is not None and len(set(self.normals_balls)) < 4:
            raise ValueError(f"normals_balls: expected four different balls; found {', '.join(self.normals_balls)}")
        if self.balls and (unknown := sorted(set(self.normals_balls or ()) - set(names))):
            raise ValueError(f"normals_balls: expected names of {', '.join(names)}; found {', '.join(unknown)}")
        for (a, first), (b, second) in combinations(zip(names, self.balls, strict=True), 2):
            if math.dist(first.centre, second.centre) < first.radius + second.radius:
                raise ValueError(f"balls: expected places apart; {a} and {b} would be within one another")
        return self
