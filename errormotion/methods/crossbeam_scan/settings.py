"""Settings of the method, as in a campaign file or after ``--set``."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

from pydantic import Field, model_validator

from errormotion.datasets.units import Angle, Length, Time, Velocity
from errormotion.plugins import PluginSettings

MINUTE = 60.0


class PoseSettings(PluginSettings):
    """Pose of the profiler in the tool frame, T(dx, dy, dz) R_X(a) R_Y(b) R_Z(g), and its uncertainty."""

    a: Angle = 0.0
    b: Angle = 0.0
    g: Angle = 0.0
    dx: Length = 0.0
    dy: Length = 0.0
    dz: Length = 0.0
    angle_uncertainty: Angle = Field(default=5e-3, ge=0, description="standard uncertainty of each angle")
    place_uncertainty: Length = Field(default=5e-3, ge=0, description="standard uncertainty of each length")


class Layout(PluginSettings):
    """The artefacts and the profiler that a plan assumes: waves along both directions, and the jitter of the lines."""

    relief: Length = Field(default=1.5e-3, gt=0, description="amplitude of the waves")
    wavelength: tuple[Length, Length] = Field(default=(28e-3, 36e-3), description="of the waves along x and y")
    width: Length = Field(default=40e-3, gt=0, description="length of a profile")
    points: int = Field(default=3200, ge=16, description="points of a profile")
    edge: Length = Field(default=2.5e-6, gt=0, description="standard deviation of a pocket's edge in one line")
    jitter_z: Length = Field(default=0.5e-6, ge=0, description="standard deviation of a line's height")
    jitter_y: Length = Field(default=2e-6, ge=0, description="standard deviation of a line's position along the feed")


class Settings(PluginSettings):
    """Settings of ``crossbeam_scan``."""

    procedure: Literal["scan", "profiler_pose"] = Field(
        default="scan", description="what to acquire; identification sees from the data which of the two they are"
    )

    # Scans: acquisition
    positions: tuple[Length, ...] = Field(
        default=(), description="position of the axis over the middle of each artefact, rising"
    )
    scan_length: Length = Field(default=56e-3, gt=0, description="length of a scan along the feed")
    line_pitch: Length = Field(default=70e-6, gt=0, description="distance of two lines")
    warm_up: tuple[Time, ...] = Field(
        default=tuple(MINUTE * m for m in (7, 15, 30, 45, 60, 90, 120, 150, 180)),
        description="warm-up time after which each measuring pass is made, rising",
    )
    cold_repeats: int = Field(default=1, ge=0, description="further cold passes, to see what stays the same")
    measuring_feed: Velocity = Field(default=1.5 / MINUTE, gt=0, description="feed while measuring")
    warm_up_feed: Velocity = Field(default=3.6 / MINUTE, gt=0, description="feed while warming up")
    warm_up_travel: tuple[Length, Length] | None = Field(
        default=None, description="ends of the warm-up moves; default those of the measuring pass"
    )
    margin: Length = Field(default=5e-3, gt=0, description="way before the first scan and behind the last one")
    travel: tuple[Length, Length] | None = Field(
        default=None, description="ends of the axis: programs that leave them are refused"
    )
    scan_z: Length | None = Field(
        default=None, description="Z of the spindle for the scans, at which every pass starts; default: where it stands"
    )
    encoder_pitch: Length = Field(default=1e-6, description="way per encoder count; negative where it counts backwards")
    encoder_zero: Length = Field(default=0.0, description="position of the axis where the encoder's count is 0")

    # What both procedures state
    lever: tuple[Length, Length, Length] = Field(
        default=(-0.9, 0.0, -2.051), description="(x_y, 0, z_y): from the carriage to the tool frame"
    )
    lever_uncertainty: tuple[Length, Length, Length] = Field(
        default=(1e-3, 1e-3, 1e-3), description="standard uncertainty of the lever"
    )
    carriage_origin: tuple[Length, Length, Length] | None = Field(
        default=None,
        description="origin of the carriage in machine coordinates with all axes at zero: for comparisons with others",
    )
    profiler_pose: PoseSettings | None = Field(
        default=None, description="pose of the profiler where no test of the campaign has found it"
    )
    height_noise: Length = Field(default=0.5e-6, gt=0, description="standard deviation of one height")

    # Profiler pose: acquisition
    pocket_position: Length = Field(default=0.0, description="position of the axis over the pocket's middle")
    pocket_z: Length = Field(default=0.0, description="Z of the spindle when it cut the pocket")
    pocket_radius: Length = Field(default=12.496e-3, gt=0, description="radius of the pocket")
    pocket_radius_uncertainty: Length = Field(default=1e-6, ge=0, description="standard uncertainty of the radius")
    pocket_lifts: tuple[Length, ...] = Field(
        default=(0.166, 0.182),
        min_length=1,
        description="how far the spindle is lifted for each scan of the pocket from where it was when it was cut",
    )
    pocket_scan_length: Length = Field(default=28e-3, gt=0, description="length of a scan of the pocket")
    angle_prior: Angle | None = Field(
        default=None, gt=0, description="standard uncertainty of the profiler's angles about 0, as it was set up"
    )

    # Identification
    registration: Literal["height_map", "open3d_plane", "paper"] = Field(
        default="height_map", description="what registers a warm scan on the cold one"
    )
    line_effects: bool = Field(default=True, description="look for jitter from line to line, and take it out")
    strain: Literal["free", "guided", "rigid"] = Field(
        default="free",
        description="how the carriage moves along a scan: with a drift of its own in each, with pitch and yaw that "
        "follow the guide besides, or not at all (each scan a rigid picture, as published)",
    )
    guide_uncertainty: Angle = Field(
        default=1e-6, gt=0, description="standard uncertainty of pitch and yaw against the slopes of the guide"
    )
    scale_uncertainty: float = Field(
        default=0.0, ge=0, description="relative standard uncertainty of the profiler's scale between cold and warm"
    )
    expansion_uncertainty: float = Field(
        default=0.0, ge=0, description="relative standard uncertainty of the artefacts' expansion between cold and warm"
    )
    moved: Literal["exclude", "keep"] = Field(
        default="exclude", description="what becomes of the errors of an artefact that has moved"
    )
    repeatability_shift: Length = Field(
        default=0.5e-6,
        gt=0,
        description="standard deviation with which the machine comes back, below which nothing moved",
    )
    repeatability_turn: Angle = Field(default=1e-6, gt=0, description="the same of its angles")

    # Planning
    layout: Layout = Field(default_factory=Layout, description="the artefacts and the profiler that a plan assumes")

    @model_validator(mode="after")
    def _fits(self) -> Settings:
        for name, unit in (("positions", 1e-3), ("warm_up", MINUTE)):
            values = getattr(self, name)
            if any(not first < second for first, second in pairwise(values)):
                raise ValueError(f"{name}: expected values that rise; found {[round(v / unit, 6) for v in values]}")
        if any(second - first < self.scan_length for first, second in pairwise(self.positions)):
            raise ValueError(f"positions: expected artefacts further apart than a scan ({self.scan_length * 1e3:g} mm)")
        if self.warm_up and self.warm_up[0] <= 0:
            raise ValueError("warm_up: expected times after the cold pass, above 0")
        if self.encoder_pitch == 0:
            raise ValueError("encoder_pitch: expected a way per count; found 0")
        return self
