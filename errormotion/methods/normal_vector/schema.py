"""Raw schema of the method: touches of balls, or their centres, cycle by cycle."""

from errormotion.datasets.schemas import DIRECTION, NO_LIMIT, NOISE, POSITION, RADIUS, UNIT_VECTOR, XYZ, RawSchema, Row

SCHEMA = "errormotion.raw.normal_vector/1"

TOUCH_FLAGS = ("", "no trip", "tripped at the start", "repeat differs", "not made")
"""Meanings of ``touch_flag``; 0 is a good touch."""


def flag_text(flag: float) -> str:
    """Return the meaning of a flag of a touch."""
    return TOUCH_FLAGS[int(flag)] if 0 <= flag < len(TOUCH_FLAGS) else f"flag {flag:g}"


_TIME = Row("time", ("time",), "s", -NO_LIMIT, NO_LIMIT, "time of the probing, increasing")
_WORDS = {"ball": ("sphere", "kugel"), "spindle_speed": ("drehzahl", "spindeldrehzahl", "rpm", "upm", "n")}
_NOMINAL = Row("ball_nominal", ("ball", "direction"), "m", *POSITION, "nominal centre of each ball", required=False)
_STATE = (
    Row("temperature", ("time", "sensor"), "degC", -40.0, 200.0, "at each probing; NaN = unknown", required=False),
    Row("spindle_speed", ("time",), "1/min", 0.0, 1e6, "at the start of each probing", required=False),
    Row("feed", ("time",), "m/s", 0.0, 10.0, "mean feed since the previous probing", required=False),
)

RAW_SCHEMAS = (
    RawSchema(
        SCHEMA,
        "centres",
        "centre",
        (
            _TIME,
            Row(
                "centre",
                ("time", "ball", "direction"),
                "m",
                *POSITION,
                "centre of each ball; NaN = not probed",
                missing=True,
            ),
            Row(
                "centre_covariance",
                ("time", "ball", "direction", "direction_"),
                "m^2",
                -1e-4,
                1e-4,
                "covariance of each centre",
                required=False,
            ),
            _NOMINAL,
            *_STATE,
        ),
        sizes={**DIRECTION, "direction_": 3},
        labels=XYZ,
        words=_WORDS,
    ),
    RawSchema(
        SCHEMA,
        "touches",
        "touch",
        (
            _TIME,
            Row(
                "touch",
                ("time", "ball", "touch", "direction"),
                "m",
                *POSITION,
                "commanded centre of the tip at each contact; NaN = no good touch",
                missing=True,
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
                *UNIT_VECTOR,
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
            Row("ball_radius", ("ball",), "m", *RADIUS, "radius of each ball; NaN = unknown", required=False),
            _NOMINAL,
            Row("touch_noise", (), "m", *NOISE, "standard deviation of one contact along its normal", required=False),
            *_STATE,
        ),
        sizes=DIRECTION,
        labels=XYZ,
        words=_WORDS,
    ),
)

EACH = "touch"
"""Dim of the numbers of a ball; "direction" where centres were given."""

RESULT: dict[str, tuple[tuple[str, ...], dict[str, str]]] = {
    "centre": (("time", "ball", "direction"), {"units": "m", "long_name": "apparent centre in machine coordinates"}),
    "centre_covariance": (
        ("time", "ball", "direction", "direction_"),
        {"units": "m^2", "long_name": "from the touches of the cycle itself"},
    ),
    "ball_displacement": (
        ("time", "ball", "direction"),
        {"units": "m", "long_name": "apparent, since the cold cycle: opposite to the error"},
    ),
    "residual": (("time", "ball", EACH), {"units": "m", "long_name": "measured minus fitted distance"}),
    "redundancy": (("time", "ball", EACH), {}),
    "smallest_error": (("time", "ball", EACH), {}),
    "smallest_error_effect": (("time", "ball", EACH), {}),
    "left_out": (
        ("time", "ball", EACH),
        {"long_name": "0 = used, 1 = missing, 2 = outlier, 3 = ball had moved, 4 = cycle not determined"},
    ),
    "ball_moved": (("time", "ball"), {"long_name": "1 from the first cycle after a move of the ball"}),
    "normals_errors": (("time", "dof"), {"long_name": "by the normals of two planes; m, rad"}),
    "normals_covariance": (("time", "dof", "dof_"), {"long_name": "m^2, m rad, rad^2"}),
    "normals_loss": (
        ("time", "dof"),
        {"units": "1", "long_name": "standard uncertainty by the normals over that by all touches"},
    ),
    "noise": ((), {"units": "m"}),
}
"""Dims and attributes of the further variables of a result."""
