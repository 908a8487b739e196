"""The subject of the conformance kit."""

from errormotion.plugins import MethodSubject

OPTIONAL = (
    "reading_time",
    "length_noise",
    "temperature",
    "temperature_uncertainty",
    "calibration_temperature",
    "expansion",
    "expansion_uncertainty",
)


def subjects():
    """Return the method with simulated tests with few sectors, for a duration of seconds."""
    from ballbar_test.method import Ballbar

    settings = Ballbar.Settings(samples=540, places=60)
    return (
        MethodSubject(
            Ballbar,
            lambda seed: Ballbar.simulate(settings, seed),
            raw_vectors={"centre": "point", "axis_direction": "direction"},
            settings={"samples": 540, "places": 60},
            optional=OPTIONAL,
            measured=("length",),
            seeds=120,
        ),
    )
