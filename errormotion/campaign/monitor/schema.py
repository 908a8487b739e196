"""Schema of the log of a monitor."""

import numpy as np
import xarray as xr

from errormotion.datasets.schemas import DIRECTION, NO_LIMIT, POSITION, XYZ, RawSchema, Row

SCHEMA = "errormotion.raw.monitor/1"


def _with_gaps(raw: xr.Dataset) -> xr.Dataset:
    """Return an imported log with its gaps: the rows in which no reading of the file is known."""
    readings = [
        raw[name] for name in ("temperature", "position", "spindle_speed", "spindle_load", "feed") if name in raw
    ]
    if "gap" in raw or not readings:
        return raw
    empty = [each.isnull().all([dim for dim in each.dims if dim != "time"]).values for each in readings]
    gap = np.logical_and.reduce(empty).astype(float)[:, None]
    return raw.assign(gap=(("time", "source"), gap, {"units": "1"})).assign_coords(source=["file"])


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
        derived=("gap",),
        imported=_with_gaps,
    ),
)
