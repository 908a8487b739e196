"""Schema of the log of a monitor."""

from errormotion.datasets.schemas import DIRECTION, NO_LIMIT, POSITION, XYZ, RawSchema, Row

SCHEMA = "errormotion.raw.monitor/1"

RAW_SCHEMAS = (
    RawSchema(
        SCHEMA,
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
                    ("sensor_place", ("sensor", "direction"), "m", *POSITION, "place on the machine; NaN = unknown"),
                    ("position", ("time", "direction"), "m", *POSITION, "of the axes; NaN = unknown"),
                    ("spindle_speed", ("time",), "1/min", -1e6, 1e6, "actual; NaN = unknown"),
                    ("spindle_load", ("time",), "1", -10.0, 10.0, "share of the rated load; NaN = unknown"),
                    ("feed", ("time",), "m/s", 0.0, 10.0, "actual; NaN = unknown"),
                )
            ),
        ),
        sizes=DIRECTION,
        labels=XYZ,
    ),
)
