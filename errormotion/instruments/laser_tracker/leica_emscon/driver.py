"""Driver of a laser tracker behind an emScon server."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from typing import Any, ClassVar

from errormotion.errors import InstrumentError
from errormotion.instruments.driver import Driver
from errormotion.instruments.laser_tracker.leica_emscon import codec, statuses
from errormotion.instruments.laser_tracker.leica_emscon.codec import Packet
from errormotion.instruments.laser_tracker.leica_emscon.link import Event, Link, RefusedError
from errormotion.instruments.laser_tracker.leica_emscon.settings import EmSconSettings
from errormotion.instruments.laser_tracker.leica_emscon.streaming import points
from errormotion.instruments.laser_tracker.leica_emscon.targets import BeamBrokenError, Reflector, polar
from errormotion.instruments.transports import Transport, open_transport
from errormotion.plugins import Identity, InstrumentInfo, Samples
from errormotion.plugins.readings import Environment, Measurement

MILLIBAR = 100.0  # Pa
METEO = {"manual": codec.METEO_OFF, "read": codec.METEO_READ, "refraction": codec.METEO_REFRACTION}
MEASURING_TIMEOUT_FACTOR = 20.0
"""Allowed duration of a measurement beyond the timeout, in measuring times: the tracker repeats measurements."""

__all__ = ["Event", "LeicaEmScon"]


class LeicaEmScon(Driver):
    """A Leica laser tracker: LT or AT901 with an interferometer, or AT4xx with an absolute distance meter.

    Lengths are in m, angles in rad, positions in the tracker's own frame: neither the station orientation nor the
    transformation that the server may hold is applied.

    Parameters
    ----------
    address : str
        ``tcp://192.168.0.1:700``, ``sim://cframe/tracker?seed=3``, ``replay://file``.
    settings : EmSconSettings, optional
    record : Path, optional
        Recording of the session.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="leica_emscon",
        kind="laser_tracker",
        summary="Leica laser trackers (LT, AT901, AT4xx) behind an emScon server, TCP",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.laser_tracker.leica_emscon:SimulatedEmScon",
    )
    Settings: ClassVar[type[EmSconSettings]] = EmSconSettings
    settings: EmSconSettings
    _connection: Link | None = None
    _streaming = False
    _refraction = math.nan
    _resets = 0
    _last: tuple[float, float, float] | None = None

    # ------------------------------------------------------------------ identity and state

    @property
    def rate(self) -> float:
        """Points per second of a stream."""
        return self.settings.rate

    @property
    def distance_is_displacement(self) -> bool:
        """Whether distances count from an unknown dead path, and not from the tracker's centre.

        Of an interferometer all readings of one `dead_path` share an unknown constant; only their differences
        have the uncertainty ``noise``. An AT4xx reports absolute distances. Multilateration takes
        ``Measurement.distance`` of either, with the dead path of each station unknown.
        """
        return self.settings.tracker != "AT4xx"

    @property
    def beam_broken(self) -> bool:
        """Whether the beam has lost its reflector, as far as the tracker has reported."""
        return self._link.broken

    @property
    def dead_path(self) -> int:
        """Number of times the distance was lost or set again since opening; 0 where distances are absolute."""
        return self._link.breaks + self._resets if self.distance_is_displacement else 0

    @property
    def events(self) -> tuple[Event, ...]:
        """Messages of the tracker that were not requested, oldest first: broken beams, changes of its status."""
        return tuple(self._link.events)

    def identify(self) -> Identity:
        """Request the identity of the tracker and of its weather station."""
        status = self._query(codec.GET_SYSTEM_STATUS).values
        tracker = self._query_optional(codec.GET_TRACKER_INFO)
        station = self._query_optional(codec.GET_METEO_STATION)
        return Identity(
            manufacturer="Leica Geosystems",
            model=str(tracker.get("name") or f"emScon tracker ({self.settings.tracker})"),
            serial_number=str(status["serial_number"]),
            firmware=f"emScon {status['major']}.{status['minor']}.{status['build']}",
            simulated=self.transport.simulated,
            details={
                "address": self.address,
                "weather_station": statuses.STATIONS.get(int(station.get("type", 0)), "unknown"),
                **self.settings.model_dump(include={"tracker", "meteo", "reflector"}),
            },
        )

    def environment(self) -> Environment:
        """Return the air that the tracker uses: of its weather station, or as set."""
        return _environment(self._query(codec.GET_ENVIRONMENT).values)

    def set_environment(self, environment: Environment) -> None:
        """Set the state of the air; without effect where the weather station sets it."""
        self._query(
            codec.SET_ENVIRONMENT,
            temperature=environment.temperature,
            pressure=environment.pressure / MILLIBAR,
            humidity=environment.humidity,
        )

    def refraction(self) -> float:
        """Return the index by which the tracker divides the optical path."""
        found = self._query(codec.GET_REFRACTION).values
        self._link.stale_refraction = False
        self._refraction = float(found["ifm" if self.distance_is_displacement else "adm"])
        return self._refraction

    def set_refraction(self, index: float) -> None:
        """Set the index, of interferometer and absolute distance meter alike."""
        self._query(codec.SET_REFRACTION, ifm=float(index), adm=float(index))
        self._link.stale_refraction = True

    def reflectors(self) -> tuple[Reflector, ...]:
        """Return the reflectors that are defined in the tracker."""
        found = self._link.query_all(codec.GET_REFLECTORS, total=lambda first: int(first.values["total"]))
        return tuple(
            Reflector(
                int(each.values["number"]),
                str(each.values["name"]),
                statuses.TARGETS.get(int(each.values["kind"]), "unknown"),
                float(each.values["surface_offset"]),
            )
            for each in found
            if each.values["total"] > 0
        )

    def set_reflector(self, name: str) -> None:
        """Choose a reflector by its name; InstrumentError lists the defined ones."""
        known = {each.name: each.number for each in self.reflectors()}
        if name not in known:
            raise InstrumentError(f"{self.address} has the reflectors {', '.join(known) or 'none'}; found '{name}'")
        self._query(codec.SET_REFLECTOR, number=known[name])

    def direction(self) -> tuple[float, float]:
        """Return the direction of the beam: azimuth and zenith angle, rad."""
        found = self._query(codec.GET_DIRECTION).values
        return float(found["azimuth"]), float(found["zenith"])

    # ------------------------------------------------------------------ moving

    def initialise(self) -> None:
        """Initialise the tracker: it moves, for about a minute."""
        self._query(codec.INITIALIZE, limit=self.settings.initialise_timeout)

    def home(self, *, clockwise: bool = True) -> None:
        """Point at the nest of the tracker and lock on to its reflector, which sets the interferometer's distance.

        Raises
        ------
        BeamBrokenError
            No reflector in the nest.
        """
        self._move(codec.GO_BIRD_BATH2, clockwise=int(clockwise))

    def go_to(self, target: tuple[float, float, float]) -> None:
        """Point at a position and lock on to the reflector near it; the absolute distance meter sets the distance.

        Raises
        ------
        BeamBrokenError
            No reflector within the search radius.
        """
        self._go(polar(target))

    def _go(self, goal: tuple[float, float, float]) -> None:
        azimuth, zenith, distance = goal
        self._move(codec.GO_POSITION, val1=azimuth, val2=zenith, val3=distance, use_adm=1)

    def find_reflector(self, distance: float) -> None:
        """Search for a reflector around the present direction.

        Raises
        ------
        BeamBrokenError
            None within the search radius.
        """
        self._move(codec.FIND_REFLECTOR, distance=float(distance))

    def _move(self, number: int, /, **values: Any) -> None:
        self._not_streaming()
        try:
            self._query(number, limit=self.settings.motion_timeout, **values)
        except RefusedError as error:
            if error.status not in statuses.NO_TARGET and not self._link.broken:
                raise
            raise BeamBrokenError(f"{error}; check the position of the reflector and the line of sight") from error
        self._link.broken = False
        self._resets += 1

    # ------------------------------------------------------------------ measuring

    def measure(self, target: tuple[float, float, float] | None = None) -> Measurement:
        """Measure a reflector.

        A tracker with an interferometer that follows its reflector to the target keeps its count: it is moved only
        if it does not already point to the target, and `dead_path` then increases. An AT4xx is always moved. A broken
        beam is not an error: the reflector is searched ``reacquire`` times, and where that fails the measurement is
        not valid and states the reason.

        Parameters
        ----------
        target : (3,), optional
            Approximate position, m, in the tracker's frame; default: the present direction of the beam.

        Raises
        ------
        InstrumentError
            The tracker refuses for another reason, does not answer or remains busy, or the connection is lost.
        """
        self._not_streaming()
        goal = None if target is None else polar(target)

        always_moves = goal is not None and self.settings.tracker == "AT4xx"
        found = Measurement(reason="beam broken", dead_path=self.dead_path)
        for attempt in range(self.settings.reacquire + 1):
            try:
                if self._link.broken and not always_moves:
                    if attempt == self.settings.reacquire == 0:
                        break
                    self._reacquire(goal)
                found = self._measure(goal if always_moves else None)
                if found.valid and goal is not None and not always_moves and not self._near(found, goal):
                    self._go(goal)
                    found = self._measure(None)
            except BeamBrokenError as error:
                found = Measurement(reason=str(error), dead_path=self.dead_path)
            if found.valid:
                break
        return found

    def read(self) -> float:
        """Return the distance now, m; NaN where the beam stays broken."""
        return self.measure().distance

    def stream(self, block: int | None = None) -> Iterator[Samples]:
        """Yield blocks of interferometer distances, evenly spaced by the tracker's own clock, until the caller stops.

        Parameters
        ----------
        block : int, optional
            Points in a block; default: half a second.

        Yields
        ------
        Samples
            ``values`` (1, block) in m. Points that the tracker's clock shows missing are NaN: ``lost``, or
            ``beam broken`` where it was.

        Raises
        ------
        InstrumentError
            An AT4xx has no interferometer; the tracker refuses.
        BeamBrokenError
            The beam stays broken for longer than ``timeout``.
        InstrumentTimeoutError
            No answer within the time limit.
        """
        self._not_streaming()
        if self.settings.tracker == "AT4xx":
            raise InstrumentError(
                "An AT4xx measures point by point and has no stream of distances; use measure(), or set "
                'tracker = "AT901" for another tracker'
            )
        if self._link.broken:
            self._reacquire()
        link, failed, delivered = self._link, False, 0
        self._query(codec.SET_MODE, mode=codec.CONTINUOUS_TIME)
        self._query(codec.SET_CONTINUOUS_TIME, milliseconds=self.settings.interval, region=codec.NO_REGION)
        self._streaming = True
        try:
            link.early.clear()
            self._query(codec.START_MEASUREMENT)
            for samples in points(link, self.settings, block):
                delivered += samples.values.shape[1]
                self.transport.report_delivered(delivered)
                yield samples
        except InstrumentError:
            failed = True
            raise
        finally:
            if self._streaming and self._connection is link:
                self._streaming = False
                with suppress(InstrumentError) if failed else nullcontext():
                    self._stop()

    def _stop(self) -> None:
        self._query(codec.STOP_MEASUREMENT)
        self._query(codec.SET_MODE, mode=codec.STATIONARY)

    def _reacquire(self, goal: tuple[float, float, float] | None = None) -> None:
        """Search for the reflector: at the goal, at its last position, or around the present direction."""
        if (position := goal or self._last) is not None:
            self._go(position)
        else:
            self.find_reflector(0.0)

    def _near(self, found: Measurement, goal: tuple[float, float, float]) -> bool:
        """Whether a measurement points to within the search radius of a position."""
        angle = math.hypot(
            found.angles[1] - goal[1],
            math.remainder(found.angles[0] - goal[0], math.tau) * math.sin(goal[1]),
        )
        return angle * goal[2] <= self.settings.search_radius

    def _measure(self, goal: tuple[float, float, float] | None) -> Measurement:
        link, settings = self._link, self.settings
        if link.stale_refraction:
            self.refraction()
        number, values = codec.START_MEASUREMENT, {}
        if goal is not None:
            number, values = codec.GO_AND_MEASURE, dict(zip(("val1", "val2", "val3"), goal, strict=True))
        limit = settings.motion_timeout if values else settings.timeout
        try:
            self._query(number, limit=limit, **values)
            packet = link.await_packet(
                lambda each: (
                    each.kind in (codec.SINGLE, codec.SINGLE2) or (each.kind == codec.ERROR and each.command == number)
                ),
                settings.timeout + MEASURING_TIMEOUT_FACTOR * settings.measuring_time,
                "a measurement",
            )
        except RefusedError as error:
            if error.status not in statuses.NO_TARGET and not link.broken:
                raise
            return Measurement(reason=_reason(error.status), dead_path=self.dead_path)
        if packet.kind == codec.ERROR or packet.status != statuses.OK:
            return Measurement(reason=_reason(packet.status), dead_path=self.dead_path)
        return self._result(packet.values)

    def _result(self, values: Any) -> Measurement:
        azimuth, zenith, distance = (float(values[f"val{k}"]) for k in (1, 2, 3))
        self._last = (azimuth, zenith, distance)
        spread = [float(values[f"std{k}"]) for k in (3, 1, 2)]
        return Measurement(
            distance,
            (azimuth, zenith),
            (spread[0], spread[1], spread[2]),
            _environment(values),
            self._refraction,
            valid=True,
            dead_path=self.dead_path,
        )

    # ------------------------------------------------------------------ connection

    @property
    def _link(self) -> Link:
        if self._connection is None or self._transport is None:
            self.transport  # noqa: B018 - raises where it is not open
            raise InstrumentError(f"The connection to {self.address} is closed; open it again")
        return self._connection

    def _query(self, number: int, /, *, limit: float | None = None, **values: Any) -> Packet:
        return self._link.query(number, limit=limit, **values)

    def _query_optional(self, number: int) -> dict[str, Any]:
        try:
            return dict(self._query(number).values)
        except RefusedError as error:
            if error.status not in (statuses.NOT_IMPLEMENTED, 27):
                raise
            return {}

    def _not_streaming(self) -> None:
        if self._streaming:
            raise InstrumentError(f"{self.info.id} is streaming; close the stream first")

    def configure(self, settings: EmSconSettings) -> None:
        """Configure the server: units, coordinates, weather station, measuring time, search radius, reflector.

        Raises
        ------
        InstrumentError
            The tracker refuses, or the reflector is not defined.
        """
        self._not_streaming()
        self._query(
            codec.SET_UNITS,
            length=codec.METRE,
            angle=codec.RADIAN,
            temperature=codec.CELSIUS,
            pressure=codec.MILLIBAR,
            humidity=codec.RELATIVE,
        )
        self._query(codec.SET_COORDINATES, kind=codec.SPHERICAL)
        system = dict(self._query(codec.GET_SYSTEM_SETTINGS).values)
        system |= {"meteo": METEO[settings.meteo], "transformation": 0, "orientation": 0, "unsolicited": 1}
        self._query(codec.SET_SYSTEM_SETTINGS, **system)
        initialised = self._query(codec.GET_SYSTEM_STATUS).values["processor"] == codec.INITIALISED
        if settings.initialise == "always" or (settings.initialise == "if_needed" and not initialised):
            self._query(codec.INITIALIZE, limit=settings.initialise_timeout)
        if settings.meteo == "manual":
            self.set_environment(Environment(settings.temperature, settings.pressure, settings.humidity))
        if settings.refraction_index is not None:
            self.set_refraction(settings.refraction_index)
        self._query(codec.SET_MODE, mode=codec.STATIONARY)
        self._query(codec.SET_STATIONARY, milliseconds=round(1000 * settings.measuring_time), use_adm=1)
        milliseconds = round(1000 * settings.motion_timeout / 2)
        self._query(codec.SET_SEARCH, radius=settings.search_radius, milliseconds=milliseconds)
        if settings.reflector is not None:
            self.set_reflector(settings.reflector)
        self._link.stale_refraction = True
        self.settings = settings

    def _connect(self) -> Transport:
        return open_transport(
            self.address, simulator=self.info.simulator, recorder=self._record, timeout=self.settings.timeout
        )

    def _start_session(self) -> None:
        self._last, self._resets = None, 0
        self._streaming = False
        self._connection = Link(self.transport, self.settings.timeout, self.settings.busy_timeout)
        self.configure(self.settings)

    def _end_session(self) -> None:
        link, self._connection = self._connection, None
        if link is not None and self._streaming:
            self._streaming = False
            with suppress(InstrumentError):
                link.query(codec.STOP_MEASUREMENT)


def _environment(values: Any) -> Environment:
    return Environment(float(values["temperature"]), MILLIBAR * float(values["pressure"]), float(values["humidity"]))


def _reason(status: int) -> str:
    return f"status {status}: {statuses.result_text(status)}"
