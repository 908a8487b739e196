"""Settings of the method, for campaign files and ``--set``."""

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

    centre: tuple[Length, Length, Length] = Field(description="approximate position of its centre, machine coordinates")
    radius: Length = Field(default=12.5e-3, gt=0, description="radius of the ball")
    name: str = Field(default="", description="name of the ball; default: its number, starting at 1")


class Event(PluginSettings):
    """A change of the spindle speed."""

    at: Time = Field(ge=0, description="time since the start of the warm-up, which is the end of the cold cycle")
    spindle_speed: Speed = Field(ge=0, description="spindle speed from this time on, 1/min")


class NormalVectorSettings(PluginSettings):
    """Settings of ``normal_vector``."""

    # Balls and touches
    balls: tuple[Ball, ...] = Field(default=(), description="the balls on the table, three or more")
    touches: int = Field(default=5, ge=4, description="touches of each ball: one on top, the others around it")
    elevation: Angle = Field(
        default=0.0, ge=0, lt=1.4, description="elevation of the touches around the ball above its equator"
    )
    order: Literal["there and back", "forward"] = Field(
        default="there and back",
        description="there and back: one half of the touches from the first ball to the last, the other half in "
        "reverse order, so that every ball has the same mean time; forward: ball after ball",
    )
    tip_radius: Length | None = Field(default=None, gt=0, description="radius of the tip; default: that of the probe")
    touch_noise: Length | None = Field(
        default=None, gt=0, description="standard deviation of one touch along its normal; default: that of the probe"
    )

    # Motion of the machine
    approach: Length = Field(
        default=4e-3, gt=0, description="distance from the start of a touch to the nominal contact"
    )
    overtravel: Length = Field(
        default=3e-3, gt=0, description="distance beyond the nominal contact at which a touch without contact ends"
    )
    clearance: Length = Field(
        default=15e-3,
        gt=0,
        description="height of the tip above the starts of the touches on its way to another ball; that of the probe "
        "has priority",
    )
    probing_feed: Velocity = Field(
        default=0.3 / MINUTE, gt=0, description="feed of the touches; that of the probe has priority"
    )
    positioning_feed: Velocity = Field(
        default=5.0 / MINUTE, gt=0, description="feed of all other moves of a cycle; that of the probe has priority"
    )
    # Warm-up
    duration: Time = Field(default=180 * MINUTE, gt=0, description="duration of the warm-up after the cold cycle")
    interval: Time = Field(default=10 * MINUTE, gt=0, description="interval of the starts of the probing cycles")
    schedule: tuple[Event, ...] = Field(default=(), description="spindle speeds over time")
    moves: tuple[tuple[Length, Length, Length], ...] = Field(
        default=(),
        description="positions that the machine approaches in turn between the cycles, to warm its axes; no ball may "
        "stand on the straight paths between them",
    )
    moves_feed: Velocity = Field(default=10.0 / MINUTE, gt=0, description="feed of these moves")
    settle: Time = Field(default=2.0, ge=0, description="dwell between the stop of the spindle and the first touch")
    to_probe: tuple[str, ...] = Field(
        default=(), description="program lines that insert the probe into the spindle, such as 'T9 M6'"
    )
    to_warm_up: tuple[str, ...] = Field(
        default=(), description="program lines that insert the tool of the warm-up into the spindle"
    )
    dwell: Literal["P s", "P ms", "X s"] = Field(
        default="P s", description="format of dwells in programs: G4 with P in s, P in ms, or X in s"
    )

    # Identification
    tool_axes: Axes = Field(
        default="XYZ",
        description="linear axes that carry the tool (XYZ for a gantry, Z for a C-frame with a cross table); the "
        "attribute tool_axes of a raw dataset has priority",
    )
    functional_point: tuple[Length, Length, Length] | None = Field(
        default=None,
        description="functional point of the errors; default: the mean of the balls' centres, rounded to 0.1 mm",
    )
    procedure: Literal["rigid", "normals"] = Field(
        default="rigid",
        description="rigid: joint least squares of all touches of all balls; normals: the published construction from "
        "two planes through four balls",
    )
    normals_balls: tuple[str, str, str, str] | None = Field(
        default=None, description="balls P1 P2 P3 P4 of the two planes; default: the first four"
    )
    reference: Literal["cold", "first"] = Field(
        default="cold", description="cold: the cold cycle at time 0; first: the first existing cycle, at any time"
    )
    interpolate: bool = Field(
        default=True, description="assume a smooth drift between the cycles and during each cycle"
    )
    robust: bool = Field(default=True, description="exclude outliers and balls that moved, and report them")
    smallest_move: Length = Field(
        default=1e-6, gt=0, description="smallest displacement of a ball that counts as a move"
    )
    noise: Literal["auto", "stated"] = Field(
        default="auto", description="stated: the stated noise of a touch; auto: increased if the touches scatter more"
    )
    ball_tolerance: Length = Field(
        default=5e-3, gt=0, description="tolerance of a ball's centre from its approximate position, and of its radius"
    )

    @model_validator(mode="after")
    def _fits(self) -> NormalVectorSettings:
        names = [ball.name or str(i + 1) for i, ball in enumerate(self.balls)]
        if len(set(names)) < len(names):
            raise ValueError(f"balls: expected different names; found {', '.join(names)}")
        times = [event.at for event in self.schedule]
        if any(second <= first for first, second in pairwise(times)):
            raise ValueError(f"schedule: expected increasing times; found {times} s")
        if self.normals_balls is not None and len(set(self.normals_balls)) < 4:
            raise ValueError(f"normals_balls: expected four different balls; found {', '.join(self.normals_balls)}")
        if self.balls and (unknown := sorted(set(self.normals_balls or ()) - set(names))):
            raise ValueError(f"normals_balls: expected names of {', '.join(names)}; found {', '.join(unknown)}")
        for (a, first), (b, second) in combinations(zip(names, self.balls, strict=True), 2):
            if math.dist(first.centre, second.centre) < first.radius + second.radius:
                raise ValueError(f"balls: expected separate balls; {a} and {b} overlap")
        return self
