"""Raw schema of the method: displacements over time, and what states the angle of the spindle."""

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

SCHEMA = "errormotion.raw.spindle_error_motion/1"
ASSUMED_POSITION = 0.1e-3
"""Standard uncertainty of the axial position of a sensor where the data do not state it, m."""
ASSUMED_ROUNDNESS = 0.05e-6
"""Roundness deviation of an artefact where the data do not state it, m: that of a good test ball."""


def _optional(name: str, dims: tuple[str, ...], unit: str, low: float, high: float, meaning: str) -> Row:
    return Row(name, dims, unit, low, high, meaning, required=False)


RAW_SCHEMAS = (
    RawSchema(
        SCHEMA,
        variant="",
        marker="displacement",
        rows=(
            Row(
                "displacement",
                ("time", "sensor"),
                "m",
                *READING,
                "reading of each sensor; NaN = none. Attribute `axis` of the dataset: A, B or C, the axis of rotation",
                missing=True,
            ),
            Row("time", ("time",), "s", -NO_LIMIT, NO_LIMIT, "increasing; or the attribute `sample_rate` (Hz)"),
            Row(
                "sensor_direction",
                ("sensor", "direction"),
                "1",
                *UNIT_VECTOR,
                "unit vector in the machine's frame: an artefact that moves along it increases the reading",
            ),
            Row("sensor_position", ("sensor", "direction"), "m", *POSITION, "point of the artefact that it looks at"),
            Row("axis_point", ("direction",), "m", *POSITION, "a point of the axis of rotation"),
            Row("artefact_radius", (), "m", *RADIUS, "radius of the ball or bar"),
            Row(
                "spindle_speed",
                (),
                "1/min",
                -5e5,
                5e5,
                "nominal; positive turns the spindle in the positive direction of the axis",
            ),
            Row("displacement_noise", (), "m", *NOISE, "standard deviation of one reading by the noise of a sensor"),
            Row("gain_uncertainty", (), "1", 0.0, 0.2, "relative standard uncertainty of the gain of each sensor"),
            Row(
                "sensor_direction_uncertainty",
                (),
                "rad",
                0.0,
                0.2,
                "standard uncertainty of each direction, in each direction across it",
            ),
            _optional(
                "index_time",
                ("index",),
                "s",
                -NO_LIMIT,
                NO_LIMIT,
                "of each pulse, one a turn, at angle 0; increasing",
            ),
            _optional("angle", ("time",), "rad", -NO_LIMIT, NO_LIMIT, "of the spindle, by an encoder, in its sense"),
            _optional(
                "standstill",
                ("rest", "sensor"),
                "m",
                *READING,
                "readings with the spindle at rest and the machine switched on, for the structural error motion",
            ),
            _optional(
                "position_uncertainty",
                (),
                "m",
                0.0,
                0.01,
                f"standard uncertainty of the axial coordinate of each sensor; else {ASSUMED_POSITION:g}",
            ),
            _optional(
                "roundness",
                (),
                "m",
                0.0,
                1e-4,
                "roundness deviation RONt of each artefact, not corrected; with a stated form, what that leaves; "
                f"else {ASSUMED_ROUNDNESS:g}",
            ),
            _optional(
                "form_cosine", ("undulation",), "m", -1e-4, 1e-4, "calibrated form at the radial sensors, outward"
            ),
            _optional(
                "form_sine",
                ("undulation",),
                "m",
                -1e-4,
                1e-4,
                "its sines; azimuth 0 is along the first axis at angle 0",
            ),
            _optional("undulation", ("undulation",), "1", 2, 1000, "undulations in one turn of the form"),
        ),
        sizes=DIRECTION,
        labels=XYZ,
        attributes={"axis": ("A", "B", "C")},
        longest_interval=0.1,  # even one turn in ten seconds has a hundred readings
    ),
)
