"""Raw schema of the method: lengths of the bar over the angle, circle by circle."""

from __future__ import annotations

from typing import Any

from errormotion.datasets.schemas import DIRECTION, NO_LIMIT, NOISE, POSITION, UNIT_VECTOR, XYZ, RawSchema, Row

SCHEMA = "errormotion.raw.circular_test/1"
READINGS = ("direction_of_travel", "run", "sample")
OPTIONAL = (
    "reading_time",
    "length_noise",
    "temperature",
    "temperature_uncertainty",
    "calibration_temperature",
    "expansion",
    "expansion_uncertainty",
)
"""Variables that need not be there."""


def _row(name: str, dims: tuple[str, ...], unit: str, low: float, high: float, meaning: str, **more: Any) -> Row:
    return Row(name, dims, unit, low, high, meaning, required=name not in OPTIONAL, **more)


RAW_SCHEMAS = (
    RawSchema(
        SCHEMA,
        variant="",
        marker="length",
        rows=(
            _row(
                "length",
                READINGS,
                "m",
                0.0,
                5.0,
                "of the bar, by its transducer and its calibrated length; NaN = no reading. "
                "Labels of direction_of_travel: CCW, CW, as seen against the normal of the plane",
                missing=True,
            ),
            _row(
                "angle",
                READINGS,
                "rad",
                -100.0,
                100.0,
                "commanded angle, from the first axis towards the second; NaN only without a reading",
                missing=True,
            ),
            _row(
                "reading_time", READINGS, "s", -NO_LIMIT, NO_LIMIT, "of each reading, from the calibration of the bar"
            ),
            _row("nominal_radius", (), "m", 0.01, 5.0, "programmed radius of the circle"),
            _row("feed", (), "m/s", 1e-5, 5.0, "programmed feed along the circle"),
            _row("centre", ("direction",), "m", *POSITION, "programmed centre of the circle"),
            _row(
                "axis_direction",
                ("axis", "direction"),
                "1",
                *UNIT_VECTOR,
                "of the two axes of the plane; labels of axis, if stated: X Y, Y Z or Z X",
            ),
            _row("length_uncertainty", (), "m", *NOISE, "standard uncertainty of the calibrated length"),
            _row("length_noise", (), "m", *NOISE, "standard deviation of one reading; else from their scatter"),
            _row("temperature", READINGS[:2], "degC", -40.0, 100.0, "of the bar during each circle"),
            _row("temperature_uncertainty", (), "K", 0.0, 20.0, "standard uncertainty of `temperature`; else 0"),
            _row(
                "calibration_temperature", (), "degC", -40.0, 100.0, "at which the length was calibrated; else 20 degC"
            ),
            _row("expansion", (), "1/K", 0.0, 1e-4, "expansion coefficient of the bar"),
            _row("expansion_uncertainty", (), "1/K", 0.0, 1e-4, "standard uncertainty of `expansion`; else 0"),
        ),
        sizes={**DIRECTION, "direction_of_travel": 2, "axis": 2},
        labels=XYZ,
    ),
)
