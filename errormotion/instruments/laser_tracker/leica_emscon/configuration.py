"""Configuration of an emScon server by the driver, and check that it is unchanged.

Several clients may be connected to one server, and each may change units and coordinates for all of them. The server
reports such a change; the driver then checks the configuration before the next measurement.
"""

from __future__ import annotations

from errormotion.errors import InstrumentError
from errormotion.instruments.laser_tracker.leica_emscon import codec, statuses
from errormotion.instruments.laser_tracker.leica_emscon.link import Link, RefusedError
from errormotion.instruments.laser_tracker.leica_emscon.results import MILLIBAR
from errormotion.instruments.laser_tracker.leica_emscon.settings import EmSconSettings
from errormotion.plugins.readings import Environment

METEO = {"manual": codec.METEO_OFF, "read": codec.METEO_READ, "refraction": codec.METEO_REFRACTION}
UNITS = {
    "length": codec.METRE,
    "angle": codec.RADIAN,
    "temperature": codec.CELSIUS,
    "pressure": codec.MILLIBAR,
    "humidity": codec.RELATIVE,
}
COORDINATES = {"kind": codec.SPHERICAL}
OWN_FRAME = {"transformation": 0, "orientation": 0}
"""Neither the transformation nor the station orientation of the server is applied."""


def configure(link: Link, settings: EmSconSettings) -> None:
    """Set units, coordinates, weather station, measuring time and search radius; initialise if necessary.

    Raises
    ------
    InstrumentError
        The tracker refuses.
    """
    link.query(codec.SET_UNITS, **UNITS)
    link.query(codec.SET_COORDINATES, **COORDINATES)
    system = dict(link.query(codec.GET_SYSTEM_SETTINGS).values)
    link.query(codec.SET_SYSTEM_SETTINGS, **{**system, **OWN_FRAME, "meteo": METEO[settings.meteo], "unsolicited": 1})
    initialised = link.query(codec.GET_SYSTEM_STATUS).values["processor"] == codec.INITIALISED
    if settings.initialise == "always" or (settings.initialise == "if_needed" and not initialised):
        link.query(codec.INITIALIZE, limit=settings.initialise_timeout)
    if settings.meteo == "manual":
        set_environment(link, Environment(settings.temperature, settings.pressure, settings.humidity))
    if settings.refraction_index is not None:
        set_refraction(link, settings.refraction_index)
    link.query(codec.SET_MODE, mode=codec.STATIONARY)
    link.query(codec.SET_STATIONARY, milliseconds=round(1000 * settings.measuring_time), use_adm=1)
    link.query(codec.SET_SEARCH, radius=settings.search_radius, milliseconds=round(1000 * settings.motion_timeout / 2))
    link.stale_refraction = link.stale_units = True


def verify(link: Link) -> None:
    """Check that units, coordinates and frame are as `configure` has set them.

    A setting whose request the server does not implement is not checked.

    Raises
    ------
    InstrumentError
        They differ: another client has changed them.
    """
    link.stale_units = False
    for number, expected in (
        (codec.GET_UNITS, UNITS),
        (codec.GET_COORDINATES, COORDINATES),
        (codec.GET_SYSTEM_SETTINGS, OWN_FRAME),
    ):
        try:
            found = link.query(number).values
        except RefusedError as error:
            if error.status != statuses.NOT_IMPLEMENTED:
                link.stale_units = True
                raise
            continue
        if differing := {name: found[name] for name, value in expected.items() if found[name] != value}:
            link.stale_units = True
            raise InstrumentError(
                f"{link.url} answers {codec.COMMANDS[number].name} with {differing}; expected "
                f"{ {name: expected[name] for name in differing} }, as configured. Another client has changed it: end "
                "the other client, then call configure() or open the tracker again",
                code="tracker.settings.differ",
            )


def set_environment(link: Link, environment: Environment) -> None:
    """Set the state of the air."""
    link.query(
        codec.SET_ENVIRONMENT,
        temperature=environment.temperature,
        pressure=environment.pressure / MILLIBAR,
        humidity=environment.humidity,
    )


def set_refraction(link: Link, index: float) -> None:
    """Set the refraction index of interferometer and absolute distance meter."""
    link.query(codec.SET_REFRACTION, ifm=float(index), adm=float(index))
    link.stale_refraction = True
