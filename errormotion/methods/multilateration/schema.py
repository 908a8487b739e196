"""Raw schema of the method: displacements from stations to targets, and the state of the air."""

from errormotion.datasets.schemas import DIRECTION, NO_LIMIT, NOISE, POSITION, XYZ, RawSchema, Row

SCHEMA = "errormotion.raw.multilateration/1"

RAW_SCHEMAS = (
    RawSchema(
        SCHEMA,
        "",
        "displacement",
        (
            Row(
                "displacement",
                ("station", "target"),
                "m",
                -100.0,
                100.0,
                "interferometer reading, which increases with the distance; NaN = beam broken",
                missing=True,
            ),
            Row("target_nominal", ("target", "direction"), "m", -100.0, 100.0, "commanded position of the reflector"),
            Row(
                "station_nominal",
                ("station", "direction"),
                "m",
                -100.0,
                100.0,
                "approximate position of the tracker; without it, or where NaN, determined from the displacements",
                required=False,
            ),
            Row(
                "reflector",
                ("target", "direction"),
                "m",
                *POSITION,
                "position of the reflector with all axes at zero: commanded position minus axis positions",
                required=False,
            ),
            Row(
                "reading_time",
                ("station", "target"),
                "s",
                -NO_LIMIT,
                NO_LIMIT,
                "time of each reading; with targets visited again it shows the drift",
                required=False,
            ),
            *(
                Row(name, ("station", "target"), unit, low, high, meaning, required=False)
                for name, unit, low, high, meaning in (
                    ("air_temperature", "degC", -40.0, 100.0, "of the air along the beam"),
                    ("air_pressure", "Pa", 1e4, 1.4e5, "of the air"),
                    ("relative_humidity", "1", 0.0, 1.0, "of the air, 0 to 1"),
                    (
                        "refractive_index",
                        "1",
                        1.0,
                        1.001,
                        "with which the displacements were computed, 1 for lengths in vacuum; where given, "
                        "displacements are corrected again from the state of the air",
                    ),
                )
            ),
            Row("vacuum_wavelength", (), "m", 3e-7, 1.7e-6, "of the interferometer", required=False),
            Row(
                "scale_temperature",
                ("station", "direction"),
                "degC",
                -40.0,
                100.0,
                "of the scales of X, Y and Z during each set-up",
                required=False,
            ),
            Row("displacement_noise", (), "m", *NOISE, "standard deviation of one reading"),
        ),
        sizes=DIRECTION,
        labels=XYZ,
        words={"station": ("tracker",)},
    ),
)
