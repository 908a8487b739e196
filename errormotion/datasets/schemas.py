"""The schemas as data: one row a variable. Validation and the reference page both follow this table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from errormotion.kinematics.iso import DOF

SCHEMA = "errormotion.errors/1"
"""Schema of every error dataset."""

SIGN = "actual minus commanded, tool side relative to workpiece side"
"""The one sign convention, as it stands in the attribute ``sign``."""

ERROR_DIMS = ("time", "position", "target", "beam")
"""Dimensions that errors may have."""

CHANNELS = ("X1", "X2", "Y1", "Y2", "Z")
"""Channels of the five-sensor frame."""


@dataclass(frozen=True)
class Row:
    """One variable of a schema.

    Attributes
    ----------
    name : str
    dims : tuple of str
        ``...`` stands for the dimensions of the errors themselves.
    unit : str
        Inside unit; "1" for a pure number, "" where elements differ in unit or the values are text.
    low, high : float
        Plausible range, both ends allowed; infinite where there is none.
    meaning : str
    required : bool
    """

    name: str
    dims: tuple[str, ...]
    unit: str
    low: float
    high: float
    meaning: str
    required: bool = True


@dataclass(frozen=True)
class RawSchema:
    """What the raw dataset of one method holds; a method with two procedures has two.

    Attributes
    ----------
    id : str
        Value of the attribute ``schema``.
    variant : str
        Which procedure; empty where there is only one.
    marker : str
        Variable or dimension that only this variant has.
    rows : tuple of Row
    sizes : mapping of str to int
        Dimensions of fixed length.
    labels : mapping of str to tuple of str
        Labels that a dimension must have, all of them and no other.
    """

    id: str
    variant: str
    marker: str
    rows: tuple[Row, ...]
    sizes: Mapping[str, int] = field(default_factory=dict)
    labels: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Id and variant for people."""
        return f"{self.id}, {self.variant}" if self.variant else self.id


NO_LIMIT = float("inf")
_PLACE = (-20.0, 20.0)  # m; the largest machine tools, and a place written in mm shows
_READING = (-0.1, 0.1)  # m; point sensors
_RADIUS = (0.0005, 0.1)  # m; bars and spheres
_NOISE = (0.0, 1e-3)  # m
_UNIT_VECTOR = (-1.000001, 1.000001)

ERROR_ROWS = (
    *(
        Row(f"E{letter}", ("...",), "m", -0.1, 0.1, f"displacement of the functional point along {letter}")
        for letter in "XYZ"
    ),
    *(
        Row(f"E{letter}", ("...",), "rad", -0.2, 0.2, f"small rotation about {axis}")
        for letter, axis in zip("ABC", "XYZ", strict=True)
    ),
    Row(
        "covariance",
        ("...", "dof", "dof_"),
        "",
        -NO_LIMIT,
        NO_LIMIT,
        "total covariance of the six freedoms at one place, influences included; m^2, m rad, rad^2",
    ),
    Row(
        "influence",
        ("source", "...", "dof"),
        "",
        -NO_LIMIT,
        NO_LIMIT,
        "signed effect of one standard uncertainty of a source that is one draw for many values; m, rad",
        required=False,
    ),
    Row("source_group", ("source",), "", -NO_LIMIT, NO_LIMIT, "what a source belongs to in the budget", required=False),
    Row("time", ("time",), "s", -NO_LIMIT, NO_LIMIT, "since the reference state, increasing", required=False),
    *(
        Row(name, ("position|target",), "m", *_PLACE, f"commanded {name.upper()}", required=False)
        for name in ("x", "y", "z")
    ),
)

ERROR_ATTRIBUTES = {
    "schema": f"`{SCHEMA}`",
    "component": "what moves wrongly: an axis (X, Y, Z, A, B, C, U, V, W), `spindle`, `tool` (the volume) or `beam`",
    "machine": "which machine",
    "frame": "coordinate system of the components",
    "functional_point": "three coordinates in that frame, m",
    "reference": "the state that the errors are relative to",
    "method": "id of the method",
    "method_version": "its version",
    "sign": f"`{SIGN}`",
    "provenance": "JSON text: settings with defaults, hash of the raw dataset, instruments, software, seed, steps",
}

_DIRECTION = {"direction": 3}
_XYZ = {"direction": ("x", "y", "z")}

_STEPPED_SPHERE = (
    Row(
        "sphere_centre",
        ("channel", "profile", "step", "direction"),
        "m",
        *_PLACE,
        "commanded centre of the sphere",
    ),
    Row("sphere_radius", (), "m", *_RADIUS, "radius of the calibrated sphere"),
    Row("scan_direction", ("channel", "profile", "direction"), "1", *_UNIT_VECTOR, "direction of the steps"),
    Row("nominal_origin", ("channel", "direction"), "m", *_PLACE, "origin of the beam, from the drawing"),
    Row(
        "nominal_direction",
        ("channel", "direction"),
        "1",
        *_UNIT_VECTOR,
        "direction of the beam, from the drawing",
    ),
)

_PROFILER = (
    Row("x", ("point",), "m", -1.0, 1.0, "along the profile, profiler frame"),
    Row("position", ("artefact",), "m", *_PLACE, "position of the axis at each artefact"),
    Row("profiler_pose", ("row", "column"), "", *_PLACE, "homogeneous matrix, profiler to tool frame; m, 1"),
    Row(
        "pose_covariance",
        ("p", "p_"),
        "",
        -1e-2,
        1e-2,
        "covariance of the pose's (a, b, g, dx, dy, dz), one draw for all scans; rad, m",
        required=False,
    ),
    Row("lever", ("direction",), "m", *_PLACE, "(x_y, 0, z_y): carriage to tool frame"),
    Row("lever_uncertainty", ("direction",), "m", 0.0, 1.0, "standard uncertainty of `lever`", required=False),
    Row("height_noise", (), "m", *_NOISE, "standard deviation of one height"),
    Row(
        "warm_up",
        ("cycle",),
        "s",
        0.0,
        NO_LIMIT,
        "warm-up time before each cycle; 0 = cold: cycle 0 is the reference, others repeat it",
        required=False,
    ),
)
_PROFILER_SIZES = {"row": 4, "column": 4, "p": 6, "p_": 6}

_POINT_SENSOR = (
    Row(
        "triangulation_normal",
        ("direction",),
        "1",
        *_UNIT_VECTOR,
        "normal of the sensor's triangulation plane, for the inclination compensation",
        required=False,
    ),
    Row(
        "triangulation_normal_uncertainty",
        (),
        "rad",
        0.0,
        0.5,
        "standard uncertainty of that normal's angle about the beam",
        required=False,
    ),
    Row("mid_range", (), "m", *_READING, "reading at which the inclination error vanishes", required=False),
    Row("reading_range", ("limit",), "m", *_READING, "least and greatest reading of the sensor", required=False),
    Row(
        "speckle",
        (),
        "m",
        *_NOISE,
        "standard deviation of what the surface adds along a stroke",
        required=False,
    ),
    Row("speckle_length", (), "m", 0.0, 0.1, "way of the stage on which that correlates", required=False),
)

RAW_SCHEMAS = (
    RawSchema(
        "errormotion.raw.spindle_drift/1",
        "drift",
        "time",
        (
            Row("distance", ("channel", "time"), "m", *_READING, "reading along the beam from its origin; NaN = none"),
            Row("time", ("time",), "s", -NO_LIMIT, NO_LIMIT, "increasing; or the attribute `sample_rate` (Hz)"),
            Row("beam_origin", ("channel", "direction"), "m", *_PLACE, "place where the reading is zero"),
            Row("beam_direction", ("channel", "direction"), "1", *_UNIT_VECTOR, "unit vector from sensor to bar"),
            Row(
                "beam_covariance",
                ("channel", "p", "p_"),
                "",
                -1e-2,
                1e-2,
                "covariance of (origin, direction), one draw for the record; m^2, m, 1",
                required=False,
            ),
            Row("bar_radius", (), "m", *_RADIUS, "radius of the bar at the side beams"),
            Row("distance_noise", (), "m", *_NOISE, "standard deviation of one sample of `distance`"),
            Row("level", ("height",), "m", *_PLACE, "z of the levels L1 and L2"),
            Row(
                "temperature", ("time", "sensor"), "degC", -60.0, 200.0, "of each sensor; NaN = unknown", required=False
            ),
            Row("spindle_speed", ("time",), "1/min", -5e5, 5e5, "turns per minute; NaN = unknown", required=False),
            Row(
                "frame_expansion",
                ("channel", "direction"),
                "m/K",
                -1e-4,
                1e-4,
                "how each beam's origin moves as the measuring frame warms",
                required=False,
            ),
            Row("nominal_origin", ("channel", "direction"), "m", *_PLACE, "from the drawing", required=False),
            Row("nominal_direction", ("channel", "direction"), "1", *_UNIT_VECTOR, "from the drawing", required=False),
        ),
        sizes={**_DIRECTION, "channel": 5, "height": 2, "p": 6, "p_": 6},
        labels={**_XYZ, "channel": CHANNELS, "height": ("L1", "L2")},
    ),
    RawSchema(
        "errormotion.raw.spindle_drift/1",
        "beam detection as recorded",
        "scan",
        (
            Row("record", ("sample",), "m", *_READING, "reading along the beam that is scanned; NaN = none"),
            Row("scan", ("sample",), "", 0, 1000, "number of the scan: channel times profiles plus profile"),
            Row("attempt", ("sample",), "", 0, 1000, "number of the attempt; the last one counts", required=False),
            *_STEPPED_SPHERE,
        ),
        sizes={**_DIRECTION, "channel": 5},
        labels={**_XYZ, "channel": CHANNELS},
    ),
    RawSchema(
        "errormotion.raw.spindle_drift/1",
        "beam detection",
        "step",
        (
            Row("distance", ("channel", "profile", "step"), "m", *_READING, "mean reading at rest; NaN = none"),
            *_STEPPED_SPHERE,
            Row(
                "distance_noise",
                (),
                "m",
                *_NOISE,
                "standard deviation of one value of `distance`",
                required=False,
            ),
        ),
        sizes={**_DIRECTION, "channel": 5},
        labels={**_XYZ, "channel": CHANNELS},
    ),
    RawSchema(
        "errormotion.raw.crossbeam_scan/1",
        "scans",
        "y",
        (
            Row(
                "height",
                ("cycle", "artefact", "profile", "point"),
                "m",
                -1.0,
                1.0,
                "surface in the profiler frame, float32 allowed; NaN = no value",
            ),
            Row("y", ("cycle", "artefact", "profile"), "m", *_PLACE, "along the feed, from `position` of the axis"),
            Row("time", ("cycle",), "s", -NO_LIMIT, NO_LIMIT, "time of the scan; cycle 0 is the cold one"),
            *_PROFILER,
        ),
        sizes={**_DIRECTION, **_PROFILER_SIZES},
        labels=_XYZ,
    ),
    RawSchema(
        "errormotion.raw.crossbeam_scan/1",
        "scans as recorded",
        "record",
        (
            Row(
                "record",
                ("line", "point"),
                "m",
                -1.0,
                1.0,
                "surface in the profiler frame, line by line; float32 allowed; NaN = no value",
            ),
            Row("encoder", ("line",), "", -NO_LIMIT, NO_LIMIT, "count of the axis at each line; NaN = line lost"),
            Row("cycle_of_line", ("line",), "", 0, 100000, "number of the measuring pass; pass 0 is the cold one"),
            Row("line_time", ("line",), "s", -NO_LIMIT, NO_LIMIT, "since the warm-up began"),
            Row(
                "line_clock",
                ("line",),
                "s",
                -NO_LIMIT,
                NO_LIMIT,
                "since the attribute `start`: for a campaign that is resumed",
                required=False,
            ),
            Row("encoder_pitch", (), "m", -1e-2, 1e-2, "way of the axis per count"),
            Row("encoder_zero", (), "m", *_PLACE, "position of the axis where the count is 0"),
            Row("scan_length", (), "m", 0.0, 1.0, "length of a scan along the feed"),
            *_PROFILER,
        ),
        sizes={**_DIRECTION, **_PROFILER_SIZES},
        labels=_XYZ,
    ),
    RawSchema(
        "errormotion.raw.crossbeam_scan/1",
        "profiler pose",
        "scan",
        (
            Row(
                "height",
                ("scan", "profile", "point"),
                "m",
                -1.0,
                1.0,
                "plate and pocket in the profiler frame, float32 allowed; NaN = no value",
            ),
            Row("x", ("point",), "m", -1.0, 1.0, "along the profile, profiler frame"),
            Row("stage", ("scan", "profile", "direction"), "m", *_PLACE, "tool frame, off its place over the pocket"),
            Row("pocket_centre", ("direction",), "m", *_PLACE, "centre of the rim in the tool frame at that place"),
            Row("pocket_radius", (), "m", *_RADIUS, "radius of the pocket"),
            Row(
                "pocket_centre_uncertainty",
                ("direction",),
                "m",
                *_NOISE,
                "standard uncertainty of `pocket_centre`",
                required=False,
            ),
            Row(
                "pocket_radius_uncertainty",
                (),
                "m",
                *_NOISE,
                "standard uncertainty of `pocket_radius`; 1 um where not given",
                required=False,
            ),
        ),
        sizes=_DIRECTION,
        labels=_XYZ,
    ),
    RawSchema(
        "errormotion.raw.beam_direction/1",
        "planes",
        "stage",
        (
            Row("distance", ("plane", "reading"), "m", -2.0, 2.0, "reading along the beam; NaN = none"),
            Row(
                "stage",
                ("plane", "reading", "direction"),
                "m",
                *_PLACE,
                "place of the stage; NaN only where a plane has fewer readings than others",
            ),
            Row("nominal_direction", ("direction",), "1", *_UNIT_VECTOR, "rough direction of the beam"),
            Row("distance_noise", (), "m", *_NOISE, "standard deviation of one reading"),
            Row("nominal_origin", ("direction",), "m", *_PLACE, "zero point while the stage is at 0", required=False),
            Row(
                "nominal_normal",
                ("plane", "direction"),
                "1",
                *_UNIT_VECTOR,
                "normal of each plane as set, to compare; the method needs none",
                required=False,
            ),
            *_POINT_SENSOR,
            Row("plane_point", ("plane", "direction"), "m", *_PLACE, "known point of each plane", required=False),
            Row(
                "plane_point_uncertainty",
                (),
                "m",
                *_NOISE,
                "standard uncertainty of `plane_point` along the normal, independent by plane",
                required=False,
            ),
            Row("bar_distance", ("bar_reading",), "m", -2.0, 2.0, "reading on a check bar; NaN = none", required=False),
            Row("bar_stage", ("bar_reading", "direction"), "m", *_PLACE, "place of the stage there", required=False),
            Row("bar_axis", ("direction",), "1", *_UNIT_VECTOR, "direction of the bar", required=False),
            Row("bar_radius", (), "m", *_RADIUS, "radius of the bar; NaN = to be found", required=False),
        ),
        sizes={**_DIRECTION, "limit": 2},
        labels=_XYZ,
    ),
    RawSchema(
        "errormotion.raw.beam_direction/1",
        "check bar alone",
        "bar_distance",
        (
            Row("bar_distance", ("bar_reading",), "m", -2.0, 2.0, "reading on a check bar; NaN = none"),
            Row("bar_stage", ("bar_reading", "direction"), "m", *_PLACE, "place of the stage there"),
            Row("bar_axis", ("direction",), "1", *_UNIT_VECTOR, "direction of the bar"),
            Row("bar_radius", (), "m", *_RADIUS, "radius of the bar; NaN = to be found", required=False),
            Row("nominal_direction", ("direction",), "1", *_UNIT_VECTOR, "direction of the beam"),
            Row("distance_noise", (), "m", *_NOISE, "standard deviation of one reading"),
            Row("nominal_origin", ("direction",), "m", *_PLACE, "zero point while the stage is at 0", required=False),
            *_POINT_SENSOR,
        ),
        sizes={**_DIRECTION, "limit": 2},
        labels=_XYZ,
    ),
    RawSchema(
        "errormotion.raw.multilateration/1",
        "",
        "displacement",
        (
            Row("displacement", ("station", "target"), "m", -100.0, 100.0, "interferometer reading; NaN = beam broken"),
            Row("target_nominal", ("target", "direction"), "m", -100.0, 100.0, "commanded place of the reflector"),
            Row(
                "station_nominal",
                ("station", "direction"),
                "m",
                -100.0,
                100.0,
                "rough place of the tracker; without it, or where NaN, found from the displacements",
                required=False,
            ),
            Row(
                "reflector",
                ("target", "direction"),
                "m",
                *_PLACE,
                "where the reflector is with all axes at zero: commanded place less axis positions",
                required=False,
            ),
            Row(
                "reading_time",
                ("station", "target"),
                "s",
                -NO_LIMIT,
                NO_LIMIT,
                "when each reading was taken; with places visited again it shows the drift",
                required=False,
            ),
            *(
                Row(name, ("station", "target"), unit, low, high, meaning, required=False)
                for name, unit, low, high, meaning in (
                    ("air_temperature", "degC", -40.0, 100.0, "of the air along the beam"),
                    ("air_pressure", "Pa", 1e4, 1.4e5, "of the air"),
                    ("relative_humidity", "1", 0.0, 1.0, "of the air, 0 to 1"),
                    (
                        "refractive_index",
                        "1",
                        1.0,
                        1.001,
                        "that the displacements were computed with, 1 for lengths in vacuum; where given, "
                        "displacements are computed anew from the state of the air",
                    ),
                )
            ),
            Row("vacuum_wavelength", (), "m", 3e-7, 1.7e-6, "of the interferometer", required=False),
            Row(
                "scale_temperature",
                ("station", "direction"),
                "degC",
                -40.0,
                100.0,
                "of the scales of X, Y and Z during each set-up",
                required=False,
            ),
            Row("displacement_noise", (), "m", *_NOISE, "standard deviation of one reading"),
        ),
        sizes=_DIRECTION,
        labels=_XYZ,
    ),
    RawSchema(
        "errormotion.raw.normal_vector/1",
        "centres",
        "centre",
        (
            Row("time", ("time",), "s", -NO_LIMIT, NO_LIMIT, "time of the probing, increasing"),
            Row("centre", ("time", "ball", "direction"), "m", *_PLACE, "centre of each ball; NaN = not probed"),
            Row(
                "centre_covariance",
                ("time", "ball", "direction", "direction_"),
                "m^2",
                -1e-4,
                1e-4,
                "covariance of each centre",
                required=False,
            ),
            Row("ball_nominal", ("ball", "direction"), "m", *_PLACE, "nominal centre of each ball", required=False),
            Row(
                "temperature",
                ("time", "sensor"),
                "degC",
                -40.0,
                200.0,
                "at each probing; NaN = not known",
                required=False,
            ),
            Row("spindle_speed", ("time",), "1/min", 0.0, 1e6, "at the begin of each probing", required=False),
            Row("feed", ("time",), "m/s", 0.0, 10.0, "mean feed since the probing before", required=False),
        ),
        sizes={**_DIRECTION, "direction_": 3},
        labels=_XYZ,
    ),
    RawSchema(
        "errormotion.raw.normal_vector/1",
        "touches",
        "touch",
        (
            Row("time", ("time",), "s", -NO_LIMIT, NO_LIMIT, "time of the probing, increasing"),
            Row(
                "touch",
                ("time", "ball", "touch", "direction"),
                "m",
                *_PLACE,
                "centre of the tip at each contact, as the machine says; NaN = no good touch",
            ),
            Row("tip_radius", (), "m", 1e-4, 0.05, "radius of the probe's tip"),
            Row(
                "touch_time",
                ("time", "ball", "touch"),
                "s",
                -NO_LIMIT,
                NO_LIMIT,
                "time of each contact, on the clock of `time`",
                required=False,
            ),
            Row(
                "approach",
                ("ball", "touch", "direction"),
                "1",
                *_UNIT_VECTOR,
                "unit vector of the probe's motion into each contact",
                required=False,
            ),
            Row(
                "touch_flag",
                ("time", "ball", "touch"),
                "1",
                0,
                255,
                "0 = good, 1 = no trip, 2 = tripped at the start, 3 = repeat differs, 4 = not made",
                required=False,
            ),
            Row("ball_radius", ("ball",), "m", *_RADIUS, "radius of each ball; NaN = not known", required=False),
            Row("ball_nominal", ("ball", "direction"), "m", *_PLACE, "nominal centre of each ball", required=False),
            Row("touch_noise", (), "m", *_NOISE, "standard deviation of one contact along its normal", required=False),
            Row(
                "temperature",
                ("time", "sensor"),
                "degC",
                -40.0,
                200.0,
                "at each probing; NaN = not known",
                required=False,
            ),
            Row("spindle_speed", ("time",), "1/min", 0.0, 1e6, "at the begin of each probing", required=False),
            Row("feed", ("time",), "m/s", 0.0, 10.0, "mean feed since the probing before", required=False),
        ),
        sizes=_DIRECTION,
        labels=_XYZ,
    ),
    RawSchema(
        "errormotion.raw.monitor/1",
        "",
        "gap",
        (
            Row("time", ("time",), "s", -NO_LIMIT, NO_LIMIT, "since the start of the log, increasing"),
            Row("gap", ("time", "source"), "1", 0, 1, "1 where an instrument gave no answer, else 0"),
            *(
                Row(name, dims, unit, low, high, meaning, required=False)
                for name, dims, unit, low, high, meaning in (
                    ("temperature", ("time", "sensor"), "degC", -200.0, 2000.0, "of each sensor; NaN = unknown"),
                    ("temperature_flag", ("time", "sensor"), "1", 0, 255, "why a temperature is unknown; 0 = known"),
                    ("sensor_place", ("sensor", "direction"), "m", *_PLACE, "place on the machine; NaN = unknown"),
                    ("position", ("time", "direction"), "m", *_PLACE, "of the axes; NaN = unknown"),
                    ("spindle_speed", ("time",), "1/min", -1e6, 1e6, "actual; NaN = unknown"),
                    ("spindle_load", ("time",), "1", -10.0, 10.0, "share of the rated load; NaN = unknown"),
                    ("feed", ("time",), "m/s", 0.0, 10.0, "actual; NaN = unknown"),
                )
            ),
        ),
        sizes=_DIRECTION,
        labels=_XYZ,
    ),
    RawSchema(
        "errormotion.raw.inclination/1",
        "",
        "group",
        (
            Row("reading", ("group",), "m", *_READING, "of the sensor; NaN = none"),
            Row("reference", ("group",), "m", *_READING, "true depth, by an interferometer, counted as the reading is"),
            Row("inclination", ("group",), "rad", -1.5, 1.5, "of the surface; negative: tilted the other way"),
            Row("rotation", ("group",), "rad", -6.3, 6.3, "azimuth of the tilt from the triangulation plane"),
            Row("reading_noise", (), "m", *_NOISE, "standard deviation of one reading", required=False),
            Row(
                "mid_range",
                (),
                "m",
                *_READING,
                "reading at which the error vanishes; 0 where not given",
                required=False,
            ),
        ),
    ),
)
"""Every raw schema; `variants` finds those of one id."""


def variants(schema: str) -> tuple[RawSchema, ...]:
    """Return the raw schemas of one id, none for an unknown id."""
    return tuple(raw for raw in RAW_SCHEMAS if raw.id == schema)


__all__ = [
    "CHANNELS",
    "DOF",
    "ERROR_ATTRIBUTES",
    "ERROR_DIMS",
    "ERROR_ROWS",
    "RAW_SCHEMAS",
    "SCHEMA",
    "SIGN",
    "RawSchema",
    "Row",
    "variants",
]
