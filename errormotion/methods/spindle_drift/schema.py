"""Raw schema of the method: the variables of a drift record and of a beam detection."""

from errormotion.datasets.schemas import (
    DIRECTION,
    NO_LIMIT,
    NOISE,
    POSITION,
    RADIUS,
    READING,
    UNIT_VECTOR,
    XYZ,
    RawSchema,
    Row,
)
from errormotion.methods.spindle_drift.imported_beams import with_beam_covariance

SCHEMA = "errormotion.raw.spindle_drift/1"
"""Id of all raw schemas of the method."""

PLANNED = "plan"
"""The machine of expected readings."""
CHANNELS = ("X1", "X2", "Y1", "Y2", "Z")
"""Channels of the five-sensor frame."""

_STEPPED_SPHERE = (
    Row("sphere_centre", ("channel", "profile", "step", "direction"), "m", *POSITION, "commanded centre of the sphere"),
    Row("sphere_radius", (), "m", *RADIUS, "radius of the calibrated sphere"),
    Row(
        "sphere_radius_uncertainty",
        (),
        "m",
        0.0,
        1e-3,
        "standard uncertainty of that radius, common to all beams; else 0",
        required=False,
    ),
    Row(
        "position_scale_uncertainty",
        (),
        "1",
        0.0,
        1e-2,
        "relative standard uncertainty of the machine's positions along each axis, common to all beams; else 0",
        required=False,
    ),
    Row("scan_direction", ("channel", "profile", "direction"), "1", *UNIT_VECTOR, "direction of the steps"),
    Row("nominal_origin", ("channel", "direction"), "m", *POSITION, "origin of the beam, from the drawing"),
    Row("nominal_direction", ("channel", "direction"), "1", *UNIT_VECTOR, "direction of the beam, from the drawing"),
)

RAW_SCHEMAS = (
    RawSchema(
        SCHEMA,
        "drift",
        "time",
        (
            Row(
                "distance",
                ("channel", "time"),
                "m",
                *READING,
                "reading along the beam from its origin; NaN = none",
                missing=True,
            ),
            Row("time", ("time",), "s", -NO_LIMIT, NO_LIMIT, "increasing; or the attribute `sample_rate` (Hz)"),
            Row("beam_origin", ("channel", "direction"), "m", *POSITION, "position at which the reading is zero"),
            Row("beam_direction", ("channel", "direction"), "1", *UNIT_VECTOR, "unit vector from sensor to bar"),
            Row(
                "beam_covariance",
                ("channel", "p", "p_"),
                "",
                -1e-2,
                1e-2,
                "covariance of (origin, direction), one draw for the record; m^2, m, 1",
                required=False,
            ),
            Row("bar_radius", (), "m", *RADIUS, "radius of the bar at the side beams"),
            Row("distance_noise", (), "m", *NOISE, "standard deviation of one sample of `distance`"),
            Row("level", ("height",), "m", *POSITION, "z of the levels L1 and L2"),
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
                "displacement of the origin of each beam with the temperature of the measuring frame",
                required=False,
            ),
            Row("nominal_origin", ("channel", "direction"), "m", *POSITION, "from the drawing", required=False),
            Row("nominal_direction", ("channel", "direction"), "1", *UNIT_VECTOR, "from the drawing", required=False),
        ),
        sizes={**DIRECTION, "channel": 5, "height": 2, "p": 6, "p_": 6},
        labels={**XYZ, "channel": CHANNELS, "height": ("L1", "L2")},
        aliases={"reading": "distance"},
        words={
            "distance": ("sensor", "messtaster", "gap"),
            "spindle_speed": ("drehzahl", "spindeldrehzahl", "rpm", "upm", "n"),
        },
        stated=(
            Row("beam_origin_uncertainty", ("channel",), "m", *NOISE, "standard uncertainty of each coordinate"),
            Row("beam_direction_uncertainty", ("channel",), "rad", 0.0, 0.1, "standard uncertainty across the beam"),
        ),
        imported=with_beam_covariance,
    ),
    RawSchema(
        SCHEMA,
        "beam detection as recorded",
        "scan",
        (
            Row("record", ("sample",), "m", *READING, "reading along the scanned beam; NaN = none", missing=True),
            Row("scan", ("sample",), "", 0, 1000, "number of the scan: channel times profiles plus profile"),
            Row("attempt", ("sample",), "", 0, 1000, "number of the attempt; the last one is used", required=False),
            *_STEPPED_SPHERE,
        ),
        sizes={**DIRECTION, "channel": 5},
        labels={**XYZ, "channel": CHANNELS},
        aliases={"reading": "distance"},
    ),
    RawSchema(
        SCHEMA,
        "beam detection",
        "step",
        (
            Row(
                "distance",
                ("channel", "profile", "step"),
                "m",
                *READING,
                "mean reading at rest; NaN = none",
                missing=True,
            ),
            *_STEPPED_SPHERE,
            Row("distance_noise", (), "m", *NOISE, "standard deviation of one value of `distance`", required=False),
        ),
        sizes={**DIRECTION, "channel": 5},
        labels={**XYZ, "channel": CHANNELS},
        aliases={"reading": "distance"},
    ),
)
