"""Raw schema of the method: displacements of spheres on the table in the nest, by commanded angle."""

import numpy as np

from errormotion.datasets.schemas import DIRECTION, POSITION, READING, UNIT_VECTOR, XYZ, RawSchema, Row

SCHEMA = "errormotion.raw.r_test/1"
READINGS = ("angle", "sphere", "sensor")
ASSUMED_POSITION = 0.1e-3
"""Standard uncertainty of each nominal coordinate of a sphere where the data do not state it, m."""


def _scalar(name: str, unit: str, high: float, meaning: str, required: bool = False) -> Row:
    return Row(name, (), unit, 0.0, high, meaning, required)


RAW_SCHEMAS = (
    RawSchema(
        SCHEMA,
        variant="",
        marker="displacement",
        rows=(
            Row(
                "displacement",
                READINGS,
                "m",
                *READING,
                "displacement of the sphere relative to the nest along the direction of the sensor, actual minus "
                "commanded; NaN = no reading. Attribute `axis` of the dataset: A, B or C",
                missing=True,
            ),
            Row(
                "angle", ("angle",), "rad", -4 * np.pi, 4 * np.pi, "commanded angle, sign of ISO 841; it must increase"
            ),
            Row(
                "sphere_position",
                ("sphere", "direction"),
                "m",
                *POSITION,
                "nominal centre of each sphere in the machine's frame, with all axes at zero",
            ),
            Row(
                "sensor_direction",
                ("sensor", "direction"),
                "1",
                *UNIT_VECTOR,
                "unit vector in the machine's frame: a sphere that moves along it increases the reading",
            ),
            Row("axis_point", ("direction",), "m", *POSITION, "a point of the nominal line of the axis"),
            _scalar("displacement_noise", "m", 1e-3, "standard deviation of one displacement; else from the residuals"),
            _scalar(
                "sensor_direction_uncertainty",
                "rad",
                0.2,
                "standard uncertainty of each direction, in each direction across it",
                True,
            ),
            _scalar("gain_uncertainty", "1", 0.2, "relative standard uncertainty of the gain of each sensor", True),
            _scalar(
                "position_uncertainty",
                "m",
                0.01,
                f"standard uncertainty of each coordinate of `sphere_position`; else {ASSUMED_POSITION:g}",
            ),
            _scalar(
                "nest_uncertainty",
                "m",
                0.01,
                "standard uncertainty of each coordinate of the nest's zero point relative to the point that the "
                "machine is commanded to take to the sphere; else 0",
            ),
        ),
        sizes=DIRECTION,
        labels=XYZ,
        words={"sphere": ("ball", "kugel")},
        attributes={"axis": ("A", "B", "C")},
    ),
)
