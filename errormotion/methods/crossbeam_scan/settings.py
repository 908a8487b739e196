"""Settings of the method, as in a campaign file or after ``--set``."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

from pydantic import Field, model_validator

from errormotion.datasets.units import Angle, Length, Time, Velocity
from errormotion.plugins import PluginSettings

MINUTE = 60.0
STRAIN = 20e-6
"""Standard uncertainty of a scale or expansion that is not stated, m/m: of steel, 2 K; of a profiler, a fifth of 0.01 %
per kelvin, as data sheets state, at 1 K."""
HEIGHT = 0.05
"""Height of the artefacts where none is stated, m."""


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
    """Artefacts and profiler that a plan assumes: waves along both directions, and jitter of the lines."""

    relief: Length = Field(default=1.5e-3, gt=0, description="amplitude of the waves")
    wavelength: tuple[Length, Length] = Field(default=(28e-3, 36e-3), description="of the waves along x and y")
    width: Length = Field(default=40e-3, gt=0, description="length of a profile")
    points: int = Field(default=3200, ge=16, description="points of a profile")
    edge: Length = Field(default=2.5e-6, gt=0, description="standard deviation of a pocket's edge in one line")
    jitter_z: Length = Field(default=0.5e-6, ge=0, description="standard deviation of a line's height")
    jitter_y: Length = Field(default=2e-6, ge=0, description="standard deviation of a line's position along the feed")


class CrossbeamScanSettings(PluginSettings):
    """Settings of ``crossbeam_scan``."""

    procedure: Literal["scan", "profiler_pose"] = Field(
        default="scan", description="what to acquire; the identification is selected by the data"
    )

    # Scans: acquisition
    positions: tuple[Length, ...] = Field(
        default=(), description="position of the axis over the middle of each artefact, increasing"
    )
    scan_length: Length = Field(default=56e-3, gt=0, description="length of a scan along the feed")
    line_pitch: Length = Field(default=70e-6, gt=0, description="distance of two lines")
    warm_up: tuple[Time, ...] = Field(
        default=tuple(MINUTE * m for m in (7, 15, 30, 45, 60, 90, 120, 150, 180)),
        description="warm-up time before each measuring pass, increasing",
    )
    cold_repeats: int = Field(default=1, ge=0, description="number of further cold passes, to test the repeatability")
    measuring_feed: Velocity = Field(default=1.5 / MINUTE, gt=0, description="feed during measuring passes")
    warm_up_feed: Velocity = Field(default=3.6 / MINUTE, gt=0, description="feed during warm-up moves")
    warm_up_travel: tuple[Length, Length] | None = Field(
        default=None, description="ends of the warm-up moves; default: those of the measuring pass"
    )
    margin: Length = Field(default=5e-3, gt=0, description="travel before the first scan and after the last one")
    travel: tuple[Length, Length] | None = Field(
        default=None, description="ends of travel of the axis; programs that exceed them are refused"
    )
    scan_z: Length | None = Field(
        default=None, description="Z of the spindle for the scans, approached before each pass; default: no motion of Z"
    )
    encoder_pitch: Length = Field(default=1e-6, description="travel per encoder count; negative if it counts backwards")
    encoder_zero: Length = Field(default=0.0, description="position of the axis where the encoder's count is 0")

    # Both procedures
    lever: tuple[Length, Length, Length] = Field(
        default=(-0.9, 0.0, -2.051), description="(x_y, 0, z_y): from the carriage to the tool frame"
    )
    lever_uncertainty: tuple[Length, Length, Length] = Field(
        default=(1e-3, 1e-3, 1e-3), description="standard uncertainty of the lever"
    )
    carriage_origin: tuple[Length, Length, Length] | None = Field(
        default=None,
        description="origin of the carriage in machine coordinates with all axes at zero; for comparisons with other "
        "results",
    )
    profiler_pose: PoseSettings | None = Field(
        default=None, description="pose of the profiler, where no test of the campaign determines it"
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
        description="height of the spindle for each scan of the pocket, above its height when the pocket was cut",
    )
    pocket_scan_length: Length = Field(default=28e-3, gt=0, description="length of a scan of the pocket")
    angle_prior: Angle | None = Field(
        default=None, gt=0, description="standard uncertainty of the profiler's angles about 0, from its alignment"
    )

    # Identification
    registration: Literal["height_map", "open3d_plane", "paper"] = Field(
        default="height_map", description="algorithm that registers a warm scan onto the cold one"
    )
    line_effects: bool = Field(default=True, description="estimate and remove jitter from line to line")
    strain: Literal["free", "guided", "rigid"] = Field(
        default="free",
        description="motion of the carriage during a scan: free: a drift in each scan; guided: in addition, pitch and "
        "yaw follow the guide; rigid: none, as published",
    )
    guide_uncertainty: Angle = Field(
        default=1e-6, gt=0, description="standard uncertainty of pitch and yaw relative to the slopes of the guide"
    )
    scale_uncertainty: float | None = Field(
        default=None,
        ge=0,
        description="relative standard uncertainty of the profiler's scales between cold and warm; default: 20 um/m, "
        "with a note",
    )
    expansion_uncertainty: float | None = Field(
        default=None,
        ge=0,
        description="relative standard uncertainty of the artefacts' expansion between cold and warm; default: "
        "20 um/m, with a note",
    )
    artefact_height: Length | None = Field(
        default=None,
        ge=0,
        description="height of the scanned surfaces above the plane on which the artefacts stand, which an expansion "
        "raises; default: 50 mm, with a note",
    )
    mount_expansion_uncertainty: float | None = Field(
        default=None,
        ge=0,
        description="relative standard uncertainty of the expansion of the profiler's mount, from the tool frame to "
        "the profiler, between cold and warm; default: 20 um/m, with a note",
    )
    moved: Literal["exclude", "keep"] = Field(
        default="exclude", description="treatment of the errors of an artefact that has moved"
    )
    repeatability_shift: Length = Field(
        default=0.5e-6, gt=0, description="repeatability of the machine (standard deviation), to detect moved artefacts"
    )
    repeatability_turn: Angle = Field(default=1e-6, gt=0, description="repeatability of its angles")

    # Planning
    layout: Layout = Field(default_factory=Layout, description="artefacts and profiler that a plan assumes")

    def strains(self) -> dict[str, float]:
        """Return the standard uncertainty, m/m, of each scale and expansion: of the profiler, artefacts, and mount."""
        scale, expansion, mount = (
            STRAIN if value is None else value
            for value in (self.scale_uncertainty, self.expansion_uncertainty, self.mount_expansion_uncertainty)
        )
        return {"scale_x": scale, "scale_z": scale, "expansion": expansion, "mount": mount}

    def height_of_artefacts(self) -> float:
        """Return the height of the artefacts, m."""
        return HEIGHT if self.artefact_height is None else self.artefact_height

    @model_validator(mode="after")
    def _fits(self) -> CrossbeamScanSettings:
        for name, unit in (("positions", 1e-3), ("warm_up", MINUTE)):
            values = getattr(self, name)
            if any(not first < second for first, second in pairwise(values)):
                raise ValueError(f"{name}: expected increasing values; found {[round(v / unit, 6) for v in values]}")
        if any(second - first < self.scan_length for first, second in pairwise(self.positions)):
            raise ValueError(f"positions: expected artefacts further apart than a scan ({self.scan_length * 1e3:g} mm)")
        if self.warm_up and self.warm_up[0] <= 0:
            raise ValueError(f"warm_up: expected times above 0; found {self.warm_up[0]:g} s")
        if self.encoder_pitch == 0:
            raise ValueError("encoder_pitch: expected a travel per count other than 0; found 0")
        return self
