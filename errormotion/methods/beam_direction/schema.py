"""Raw schemas of the method: readings on planes and a check bar, and the readings of an inclination calibration."""

from errormotion.datasets.schemas import DIRECTION, NOISE, POSITION, RADIUS, READING, UNIT_VECTOR, XYZ, RawSchema, Row

SCHEMA = "errormotion.raw.beam_direction/1"
INCLINATION_SCHEMA = "errormotion.raw.inclination/1"

_POINT_SENSOR = (
    Row(
        "triangulation_normal",
        ("direction",),
        "1",
        *UNIT_VECTOR,
        "normal of the sensor's triangulation plane, for the inclination compensation, with the attribute `receiver`",
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
    Row("mid_range", (), "m", *READING, "reading at which the inclination error vanishes", required=False),
    Row("reading_range", ("limit",), "m", *READING, "least and greatest reading of the sensor", required=False),
    Row(
        "speckle",
        (),
        "m",
        *NOISE,
        "standard deviation of the error caused by the surface texture along a stroke",
        required=False,
    ),
    Row("speckle_length", (), "m", 0.0, 0.1, "correlation length of that error", required=False),
)

_ALIASES = {"reading": "distance", "x": "stage_x", "y": "stage_y", "z": "stage_z"}

RAW_SCHEMAS = (
    RawSchema(
        SCHEMA,
        "planes",
        "stage",
        (
            Row("distance", ("plane", "reading"), "m", -2.0, 2.0, "reading along the beam; NaN = none", missing=True),
            Row(
                "stage",
                ("plane", "reading", "direction"),
                "m",
                *POSITION,
                "position of the stage; NaN only where a plane has fewer readings than others",
                missing=True,
            ),
            Row("nominal_direction", ("direction",), "1", *UNIT_VECTOR, "rough direction of the beam"),
            Row("distance_noise", (), "m", *NOISE, "standard deviation of one reading"),
            Row("nominal_origin", ("direction",), "m", *POSITION, "zero point while the stage is at 0", required=False),
            Row(
                "nominal_normal",
                ("plane", "direction"),
                "1",
                *UNIT_VECTOR,
                "normal of each plane as set, for comparison only",
                required=False,
            ),
            *_POINT_SENSOR,
            Row("plane_point", ("plane", "direction"), "m", *POSITION, "known point of each plane", required=False),
            Row(
                "plane_point_uncertainty",
                (),
                "m",
                *NOISE,
                "standard uncertainty of `plane_point` along the normal, independent by plane",
                required=False,
            ),
            Row("bar_distance", ("bar_reading",), "m", -2.0, 2.0, "reading on a check bar; NaN = none", required=False),
            Row(
                "bar_stage", ("bar_reading", "direction"), "m", *POSITION, "position of the stage there", required=False
            ),
            Row("bar_axis", ("direction",), "1", *UNIT_VECTOR, "direction of the bar", required=False),
            Row("bar_radius", (), "m", *RADIUS, "radius of the bar; NaN = unknown", required=False),
            Row(
                "bar_radius_uncertainty", (), "m", *NOISE, "standard uncertainty of that radius; else 0", required=False
            ),
        ),
        sizes={**DIRECTION, "limit": 2},
        labels=XYZ,
        aliases=_ALIASES,
    ),
    RawSchema(
        SCHEMA,
        "check bar alone",
        "bar_distance",
        (
            Row("bar_distance", ("bar_reading",), "m", -2.0, 2.0, "reading on a check bar; NaN = none", missing=True),
            Row("bar_stage", ("bar_reading", "direction"), "m", *POSITION, "position of the stage there"),
            Row("bar_axis", ("direction",), "1", *UNIT_VECTOR, "direction of the bar"),
            Row("bar_radius", (), "m", *RADIUS, "radius of the bar; NaN = unknown", required=False),
            Row(
                "bar_radius_uncertainty", (), "m", *NOISE, "standard uncertainty of that radius; else 0", required=False
            ),
            Row("nominal_direction", ("direction",), "1", *UNIT_VECTOR, "direction of the beam"),
            Row("distance_noise", (), "m", *NOISE, "standard deviation of one reading"),
            Row("nominal_origin", ("direction",), "m", *POSITION, "zero point while the stage is at 0", required=False),
            *_POINT_SENSOR,
        ),
        sizes={**DIRECTION, "limit": 2},
        labels=XYZ,
        aliases=_ALIASES,
    ),
    RawSchema(
        INCLINATION_SCHEMA,
        "",
        "group",
        (
            Row("reading", ("group",), "m", *READING, "of the sensor; NaN = none", missing=True),
            Row(
                "reference", ("group",), "m", *READING, "true depth by an interferometer, with the sign of the reading"
            ),
            Row(
                "inclination",
                ("group",),
                "rad",
                -1.5,
                1.5,
                "of the surface; negative: tilted in the opposite direction",
            ),
            Row(
                "rotation",
                ("group",),
                "rad",
                -6.3,
                6.3,
                "azimuth of the surface's normal, clockwise about the beam for an observer who looks along it",
            ),
            Row(
                "receiver_rotation",
                (),
                "rad",
                -6.3,
                6.3,
                "rotation at which the normal leans towards the receiver: 0 or 180 deg; needed, here or as a setting",
                required=False,
            ),
            Row("reading_noise", (), "m", *NOISE, "standard deviation of one reading", required=False),
            Row(
                "mid_range",
                (),
                "m",
                *READING,
                "reading at which the error vanishes; 0 where not given",
                required=False,
            ),
        ),
    ),
)
