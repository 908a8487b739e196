"""Raw schema of the method: lengths of the bar over the angle, circle by circle."""

from errormotion.datasets.schemas import DIRECTION, NO_LIMIT, NOISE, POSITION, UNIT_VECTOR, XYZ, RawSchema, Row

SCHEMA = "errormotion.raw.ballbar/1"
READINGS = ("direction_of_travel", "run", "sample")

RAW_SCHEMAS = (
    RawSchema(
        SCHEMA,
        "",
        "length",
        (
            Row(
                "length",
                READINGS,
                "m",
                0.0,
                5.0,
                "of the bar, by its transducer and its calibrated length; NaN = no reading. "
                "Labels of direction_of_travel: CCW, CW, as seen against the normal of the plane",
                missing=True,
            ),
            Row(
                "angle",
                READINGS,
                "rad",
                -100.0,
                100.0,
                "commanded angle, from the first axis towards the second; NaN only without a reading",
                missing=True,
            ),
            Row(
                "reading_time",
                READINGS,
                "s",
                -NO_LIMIT,
                NO_LIMIT,
                "of each reading, since the calibration of the bar",
                required=False,
            ),
            Row("nominal_radius", (), "m", 0.01, 5.0, "programmed radius of the circle"),
            Row("feed", (), "m/s", 1e-5, 5.0, "programmed feed along the circle"),
            Row("centre", ("direction",), "m", *POSITION, "programmed centre of the circle"),
            Row(
                "axis_direction",
                ("axis", "direction"),
                "1",
                *UNIT_VECTOR,
                "of the two axes of the plane; labels of axis, if stated: X Y, Y Z or Z X",
            ),
            Row("length_uncertainty", (), "m", *NOISE, "standard uncertainty of the calibrated length"),
            Row(
                "length_noise",
                (),
                "m",
                *NOISE,
                "standard deviation of one reading; default: from the scatter of the readings",
                required=False,
            ),
            Row(
                "temperature",
                ("direction_of_travel", "run"),
                "degC",
                -40.0,
                100.0,
                "of the bar during each circle",
                required=False,
            ),
            Row("temperature_uncertainty", (), "K", 0.0, 20.0, "standard uncertainty of `temperature`", required=False),
            Row(
                "calibration_temperature",
                (),
                "degC",
                -40.0,
                100.0,
                "reference temperature of the calibrated length; default 20 degC",
                required=False,
            ),
            Row("expansion", (), "1/K", 0.0, 1e-4, "expansion coefficient of the bar", required=False),
            Row("expansion_uncertainty", (), "1/K", 0.0, 1e-4, "standard uncertainty of `expansion`", required=False),
        ),
        sizes={**DIRECTION, "direction_of_travel": 2, "axis": 2},
        labels=XYZ,
    ),
)
