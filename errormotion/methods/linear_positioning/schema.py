"""Raw schema of the method: deviations at target positions, by run and direction of approach."""

from errormotion.datasets.schemas import DIRECTION, NO_LIMIT, POSITION, XYZ, RawSchema, Row

SCHEMA = "errormotion.raw.linear_positioning/1"
APPROACHES = ("forward", "backward")
READINGS = ("freedom", "run", "approach", "target")
STOPS = ("diagonal", "run", "approach", "stop")
SENSORS = ("run", "approach", "target", "sensor")

_COEFFICIENT = (0.0, 1e-4)
"""Plausible coefficients of expansion, 1/K."""

_POINT = Row(
    "functional_point",
    ("direction",),
    "m",
    *POSITION,
    "point whose displacement was measured, with the axis at zero",
    required=False,
)
_LENGTH = Row(
    "length_uncertainty",
    (),
    "1",
    0.0,
    1e-3,
    "relative standard uncertainty of the lengths of the instrument (wavelength, air, calibration)",
    required=False,
)

_ALIGNMENT = Row(
    "alignment_uncertainty",
    (),
    "rad",
    0.0,
    0.1,
    "standard uncertainty of the angle between the measured line and the axis or diagonal, in each of two directions",
    required=False,
)

_SCATTER = "standard deviation of a reading; a smaller estimate is replaced by it. NaN = not stated"
_DRIFT = (
    "range of the readings at rest during one run; a smaller estimate of the drift from run to run is replaced by it. "
    "NaN = not stated"
)


def _scatter(dim: str) -> Row:
    unit, units = ("m", ()) if dim == "diagonal" else ("", ("m", "rad"))
    return Row("reading_scatter", (dim,), unit, 0.0, 1e-3, _SCATTER, required=False, missing=True, units=units)


def _drift(dim: str) -> Row:
    unit, units = ("m", ()) if dim == "diagonal" else ("", ("m", "rad"))
    return Row("run_drift", (dim,), unit, 0.0, 1e-3, _DRIFT, required=False, missing=True, units=units)


RAW_SCHEMAS = (
    RawSchema(
        SCHEMA,
        "targets",
        "target",
        (
            Row(
                "deviation",
                (*READINGS[1:], "freedom"),  # last: in the map of a log, each freedom is a column with its own unit
                "",
                -0.1,
                0.1,
                "actual minus target, m for EX EY EZ and rad for EA EB EC; NaN = no reading. Labels of freedom: names "
                "of ISO 230-1 such as EXX; labels of approach: forward, backward",
                missing=True,
                units=("m", "rad"),
            ),
            Row("target_position", ("target",), "m", *POSITION, "commanded position of the axis"),
            Row(
                "zero_position",
                (),
                "m",
                *POSITION,
                "position of the axis at which the instrument was set to zero; the first target where not given",
                required=False,
            ),
            _POINT,
            _LENGTH,
            Row(
                "gain_uncertainty",
                ("freedom",),
                "1",
                0.0,
                0.2,
                "relative standard uncertainty of the deviations of each freedom",
                required=False,
            ),
            Row(
                "target_uncertainty",
                ("freedom",),
                "",
                0.0,
                1e-3,
                "standard uncertainty by the instrument that is alike in all runs and differs from target to target "
                "(interpolation, flatness of a straightness reflector); m, rad",
                required=False,
                units=("m", "rad"),
            ),
            Row("temperature", SENSORS, "degC", -40.0, 100.0, "of each sensor; NaN = none", required=False),
            Row(
                "temperature_uncertainty",
                (),
                "K",
                0.0,
                20.0,
                "standard uncertainty of `temperature` that all readings of one sensor share",
                required=False,
            ),
            Row(
                "machine_expansion",
                (),
                "1/K",
                *_COEFFICIENT,
                "coefficient of expansion of the positioning system of the axis",
                required=False,
            ),
            Row(
                "workpiece_expansion",
                (),
                "1/K",
                *_COEFFICIENT,
                "coefficient of expansion on the side of the workpiece: of an artefact that gives the lengths; 0 for "
                "an interferometer",
                required=False,
            ),
            Row(
                "machine_expansion_uncertainty",
                (),
                "1/K",
                *_COEFFICIENT,
                "standard uncertainty of `machine_expansion`",
                required=False,
            ),
            Row(
                "workpiece_expansion_uncertainty",
                (),
                "1/K",
                *_COEFFICIENT,
                "standard uncertainty of `workpiece_expansion`",
                required=False,
            ),
            _ALIGNMENT,
            _scatter("freedom"),
            _drift("freedom"),
        ),
        sizes=DIRECTION,
        labels=XYZ,
        words={"target_position": ("position", "pos", "sollposition", "soll", "target", "nominal", "zielposition")},
        attributes={"axis": ("X", "Y", "Z")},
        asked=("functional_point", "length_uncertainty"),
    ),
    RawSchema(
        SCHEMA,
        "moving axis",
        "cycle",
        (
            Row(
                "end_deviation",
                ("cycle", "end", "freedom"),
                "",
                -0.1,
                0.1,
                "actual minus target at both ends of a stroke, m for EX EY EZ and rad for EA EB EC; NaN = no reading",
                missing=True,
                units=("m", "rad"),
            ),
            Row("end_position", ("end",), "m", *POSITION, "commanded positions of the two ends"),
            Row(
                "reading_time",
                ("cycle",),
                "s",
                -NO_LIMIT,
                NO_LIMIT,
                "of the readings of a cycle, since the axis started to move; 0 or less: the cold state; increasing",
            ),
            Row("moving", ("cycle",), "1", 0.0, 1.0, "1 while the axis was moving before the reading, 0 at rest"),
            _POINT,
            _LENGTH,
            _scatter("freedom"),
            Row("temperature", ("cycle", "sensor"), "degC", -40.0, 100.0, "of each sensor; NaN = none", required=False),
        ),
        sizes={**DIRECTION, "end": 2},
        labels=XYZ,
    ),
    RawSchema(
        SCHEMA,
        "diagonals",
        "diagonal",
        (
            Row(
                "diagonal_deviation",
                STOPS,
                "m",
                -0.1,
                0.1,
                "actual minus commanded displacement along the diagonal since its first stop; NaN = no reading. Labels "
                "of diagonal: such as PPP, NP0; labels of approach: forward, backward",
                missing=True,
            ),
            Row(
                "stop_point",
                ("diagonal", "stop", "direction"),
                "m",
                *POSITION,
                "commanded position of the axes at each stop, in the order of the diagonal",
            ),
            _POINT,
            _LENGTH,
            _ALIGNMENT,
            _scatter("diagonal"),
            _drift("diagonal"),
        ),
        sizes=DIRECTION,
        labels=XYZ,
    ),
)
