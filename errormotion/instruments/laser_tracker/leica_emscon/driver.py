"""Driver of a laser tracker with an emScon server."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext, suppress
from typing import Any, ClassVar

from errormotion.errors import InstrumentError
from errormotion.instruments import simulators
from errormotion.instruments.laser_tracker.leica_emscon import codec, configuration, results, statuses
from errormotion.instruments.laser_tracker.leica_emscon.link import Event, RefusedError
from errormotion.instruments.laser_tracker.leica_emscon.session import EmSconSession
from errormotion.instruments.laser_tracker.leica_emscon.settings import EmSconSettings
from errormotion.instruments.laser_tracker.leica_emscon.streaming import points
from errormotion.instruments.laser_tracker.leica_emscon.targets import BeamBrokenError, Reflector, polar
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject, Samples
from errormotion.plugins.readings import Environment, Measurement

MEASURING_TIMEOUT_FACTOR = 20.0
"""Permitted duration of a measurement beyond the timeout, as a multiple of the measuring time: the tracker repeats
measurements."""

__all__ = ["Event", "LeicaEmScon"]


class LeicaEmScon(EmSconSession):
    """A Leica laser tracker: LT or AT901 with an interferometer, or AT4xx with an absolute distance meter.

    Lengths are in m, angles in rad, positions in the frame of the tracker: neither the station orientation nor the
    transformation of the server is applied.

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
        summary="Leica laser trackers (LT, AT901, AT4xx) with an emScon server, TCP",
        status="peer_verified",
        simulator="errormotion.instruments.simulators.laser_tracker.leica_emscon:SimulatedEmScon",
    )

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit, with a moving reflector, so that all readings differ."""
        return InstrumentSubject(cls, "sim://cframe?seed=3", vary=simulators.in_steps(seed=3))

    # ------------------------------------------------------------------ identity and state

    @property
    def rate(self) -> float:
        """Points per second of a stream."""
        return self.settings.rate

    @property
    def distance_is_displacement(self) -> bool:
        """Whether distances have an unknown zero and not the tracker's centre.

        All readings of an interferometer with the same `dead_path` share an unknown constant; only their differences
        have the uncertainty ``noise``. An AT4xx reports absolute distances. Multilateration uses
        ``Measurement.distance`` of either, and treats the dead path of each station as unknown.
        """
        return self.settings.tracker != "AT4xx"

    @property
    def dead_path(self) -> int:
        """Number of times the distance was lost or set again since opening; 0 if distances are absolute."""
        return self._link.breaks + self._resets if self.distance_is_displacement else 0

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
        """Return the conditions of the air that the tracker uses: of its weather station, or as set."""
        return results.environment(self._query(codec.GET_ENVIRONMENT).values)

    def set_environment(self, environment: Environment) -> None:
        """Set the conditions of the air; without effect if the weather station sets them."""
        configuration.set_environment(self._link, environment)

    def refraction(self) -> float:
        """Return the index by which the tracker divides the optical path."""
        found = self._query(codec.GET_REFRACTION).values
        self._link.stale_refraction = False
        self._refraction = float(found["ifm" if self.distance_is_displacement else "adm"])
        return self._refraction

    def set_refraction(self, index: float) -> None:
        """Set the refraction index of interferometer and absolute distance meter."""
        configuration.set_refraction(self._link, index)

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
        """Select a reflector by its name; the InstrumentError for another name lists the defined ones."""
        known = {each.name: each.number for each in self.reflectors()}
        if name not in known:
            raise InstrumentError(
                f"{self.address} has the reflectors {', '.join(known) or 'none'}; found '{name}'",
                code="tracker.reflector.unknown",
            )
        self._query(codec.SET_REFLECTOR, number=known[name])

    def direction(self) -> tuple[float, float]:
        """Return the direction of the beam: azimuth and zenith angle, rad."""
        found = self._query(codec.GET_DIRECTION).values
        return float(found["azimuth"]), float(found["zenith"])

    # ------------------------------------------------------------------ moving

    def initialise(self) -> None:
        """Initialise the tracker: it moves for about a minute."""
        self._query(codec.INITIALIZE, limit=self.settings.initialise_timeout)

    def home(self, *, clockwise: bool = True) -> None:
        """Point at the home position and lock on to its reflector, which sets the interferometer's distance.

        Raises
        ------
        BeamBrokenError
            No reflector in the home position.
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
            No reflector within the search radius.
        """
        self._move(codec.FIND_REFLECTOR, distance=float(distance))

    def _move(self, number: int, /, **values: Any) -> None:
        self._refuse_while_streaming()
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

        A tracker with an interferometer that follows its reflector to the target keeps its count: it is moved only if
        it does not already point to the target, and `dead_path` then increases. An AT4xx is always moved. A broken beam
        is not an error: the reflector is searched ``reacquire`` times; if this fails, the measurement is not valid and
        states the reason.

        Parameters
        ----------
        target : (3,), optional
            Approximate position, m, in the tracker's frame; default: the present direction of the beam.

        Raises
        ------
        InstrumentError
            The tracker refuses for another reason, does not answer or remains busy, or the connection is lost.
        """
        self._refuse_while_streaming()
        goal = None if target is None else polar(target)

        radius = self.settings.search_radius
        always_moves = goal is not None and self.settings.tracker == "AT4xx"
        measurement = Measurement(reason="beam broken", dead_path=self.dead_path)
        for attempt in range(self.settings.reacquire + 1):
            try:
                if self._link.broken and not always_moves:
                    if attempt == self.settings.reacquire == 0:
                        break
                    self._reacquire(goal)
                measurement = self._measure(goal if always_moves else None)
                if (
                    measurement.valid
                    and goal is not None
                    and not always_moves
                    and not results.is_near(measurement, goal, radius)
                ):
                    self._go(goal)
                    measurement = self._measure(None)
            except BeamBrokenError as error:
                measurement = Measurement(reason=str(error), dead_path=self.dead_path)
            if measurement.valid:
                break
        return measurement

    def read(self) -> float:
        """Return the present distance, m; NaN if the beam remains broken."""
        return self.measure().distance

    def stream(self, block: int | None = None) -> Iterator[Samples]:
        """Yield blocks of interferometer distances, evenly spaced by the tracker's clock, until the caller stops.

        Parameters
        ----------
        block : int, optional
            Points in a block; default: half a second.

        Yields
        ------
        Samples
            ``values`` (1, block) in m. Points that are missing by the tracker's clock are NaN: ``lost``, or ``beam
            broken``.

        Raises
        ------
        InstrumentError
            An AT4xx has no interferometer; the tracker refuses.
        BeamBrokenError
            The beam remains broken for longer than ``timeout``.
        InstrumentTimeoutError
            No answer within the time limit.
        """
        self._refuse_while_streaming()
        if self.settings.tracker == "AT4xx":
            raise InstrumentError(
                "An AT4xx measures point by point and has no stream of distances; use measure(), or set "
                'tracker = "AT901" for another tracker',
                code="tracker.stream.none",
            )
        if self._link.broken:
            self._reacquire()
        link, failed, delivered = self._link, False, 0
        if link.stale_units:
            configuration.verify(link)
        self._query(codec.SET_MODE, mode=codec.CONTINUOUS_TIME)
        self._query(codec.SET_CONTINUOUS_TIME, milliseconds=self.settings.interval, region=codec.SPHERE)
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

    def _measure(self, goal: tuple[float, float, float] | None) -> Measurement:
        link, settings = self._link, self.settings
        if link.stale_units:
            configuration.verify(link)
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
                number,
            )
        except RefusedError as error:
            if error.status not in statuses.NO_TARGET and not link.broken:
                raise
            return Measurement(reason=results.reason(error.status), dead_path=self.dead_path)
        if packet.kind == codec.ERROR or packet.status != statuses.OK:
            return Measurement(reason=results.reason(packet.status), dead_path=self.dead_path)
        self._last = results.polar_position(packet.values)
        return results.measurement(packet.values, self._refraction, self.dead_path)

    # ------------------------------------------------------------------ settings

    def configure(self, settings: EmSconSettings) -> None:
        """Configure the server: units, coordinates, weather station, measuring time, search radius, reflector.

        Raises
        ------
        InstrumentError
            The tracker refuses, or the reflector is not defined.
        """
        self._refuse_while_streaming()
        configuration.configure(self._link, settings)
        if settings.reflector is not None:
            self.set_reflector(settings.reflector)
        self.settings = settings
