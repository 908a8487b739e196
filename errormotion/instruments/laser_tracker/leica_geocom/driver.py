"""Driver of a station with GeoCOM."""

from __future__ import annotations

import logging
import math
import time
from collections import Counter
from typing import ClassVar

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments import simulators
from errormotion.instruments.driver import Driver
from errormotion.instruments.laser_tracker.leica_geocom import air, codec, codes
from errormotion.instruments.laser_tracker.leica_geocom.settings import GeoComSettings
from errormotion.instruments.transports import Transport
from errormotion.instruments.transports.base import LINE_ENDS
from errormotion.instruments.transports.quiet import after_others
from errormotion.plugins import Identity, InstrumentInfo, InstrumentSubject
from errormotion.plugins.readings import Environment, Measurement

HECTOPASCAL = 100.0  # Pa
BUSY_INTERVAL = 0.05
"""Interval between requests to a busy station, s."""

log = logging.getLogger(__name__)


class LeicaGeoCom(Driver):
    """A Leica total station or industrial station: TM30, TS30, TS60, TDRA6000, TPS1200 and related models.

    Distances are absolute, in m, with the prism constant that is set at the station. The station's frame has x along
    the horizontal angle 0, z up and y to the left: the azimuth is the negative horizontal angle, which the station
    counts clockwise. The station moves only with ``move = true``; otherwise the operator points it.

    Parameters
    ----------
    address : str
        ``serial:///dev/ttyUSB0``, ``tcp://192.168.0.5:1212``, ``sim://cframe/station?seed=3``, ``replay://file``.
    settings : GeoComSettings, optional
    record : Path, optional
        Recording of the session.

    Attributes
    ----------
    warnings : Counter of int
        Number, by return code, of measurements that are valid but not fully corrected, or whose accuracy the station
        does not guarantee.
    """

    info: ClassVar[InstrumentInfo] = InstrumentInfo(
        id="leica_geocom",
        kind="laser_tracker",
        summary="Leica total stations and industrial stations (TM30, TS30, TS60, TDRA6000, TPS1200) by GeoCOM",
        status="simulated_only",
        simulator="errormotion.instruments.simulators.laser_tracker.leica_geocom:SimulatedGeoComStation",
    )
    Settings: ClassVar[type[GeoComSettings]] = GeoComSettings
    settings: GeoComSettings

    @classmethod
    def conformance(cls) -> InstrumentSubject:
        """Return the subject of the conformance kit, with a moving reflector, so that all readings differ."""
        return InstrumentSubject(cls, "sim://cframe?seed=3", vary=simulators.in_steps(seed=3))

    _transaction = 0
    _clear = True  # whether the station's buffer may contain unfinished requests

    # ------------------------------------------------------------------ requests

    def _start_session(self) -> None:
        self.warnings: Counter[int] = Counter()
        self._clear = True
        self._request(codes.NULL)
        self._request(codes.GET_NAME)
        self.configure(self.settings)

    def _call(self, call: int, *parameters: int | float, limit: float | None = None) -> codec.Reply:
        """Return the reply to one call, whatever its return code; late replies to earlier requests are discarded."""
        limit = self.settings.timeout if limit is None else limit
        self._transaction = self._transaction % codec.MAX_TRANSACTION + 1
        number = self._transaction
        try:
            with self.exchange() as line:
                line.write((b"\n" if self._clear else b"") + codec.request(call, number, *parameters))
                reply = self._reply(line, number, codes.name(call), limit)
        except InstrumentError:
            self._clear = True
            raise
        self._clear = False
        return reply

    def _reply(self, line: Transport, number: int, call: str, limit: float) -> codec.Reply:
        """Return the reply with a number; late replies, and data that the station records in between, are discarded."""
        deadline, others, recorded = time.monotonic() + limit, 0, 0
        while True:
            try:
                left = max(deadline - time.monotonic(), 0.0)
                text = line.read_until(LINE_ENDS, limit=codec.MAX_REPLY, timeout=left)
            except InstrumentTimeoutError as error:
                if recorded and not others:
                    raise ProtocolError(
                        f"{self.address}: expected a GeoCOM reply to {call}; found {recorded} lines of GSI and none of "
                        "GeoCOM. Check that the interface of the station is set to GeoCOM",
                        code="protocol.reply.other",
                    ) from None
                raise after_others(error, others, f"GeoCOM call {call}") from None
            if codec.is_gsi(text):
                recorded += 1
                continue
            reply = codec.reply(text)
            if reply.transaction == number:
                return reply
            others += 1

    def _request(self, call: int, *parameters: int | float, limit: float | None = None) -> codec.Reply:
        """Return the reply to a call that must succeed."""
        reply = self._call(call, *parameters, limit=limit)
        codec.check(call, reply)
        if reply.code != codes.OK:
            raise InstrumentError(
                f"{self.address} refuses GeoCOM call {codes.name(call)}: code {reply.code}, {codes.text(reply.code)}",
                code="instrument.refused",
            )
        return reply

    def _optional(self, call: int) -> codec.Reply | None:
        """Return the reply to a call that not all stations have; None if it is unavailable or fails."""
        reply = self._call(call)
        if reply.communication in codes.UNAVAILABLE:
            return None
        codec.check(call, reply)
        return reply if reply.code == codes.OK else None

    # ------------------------------------------------------------------ identity and state

    @property
    def distance_is_displacement(self) -> bool:
        """False: distances are absolute."""
        return False

    @property
    def dead_path(self) -> int:
        """0: distances are absolute and are never set again."""
        return 0

    def identify(self) -> Identity:
        """Request name and number of the station."""
        name = self._request(codes.GET_NAME).text(0)
        number = self._request(codes.GET_NUMBER).whole(0)
        version = self._optional(codes.GET_SOFTWARE)
        warmth = self._optional(codes.GET_TEMPERATURE)
        return Identity(
            manufacturer="Leica Geosystems",
            model=name,
            serial_number=str(number),
            firmware="" if version is None else f"{version.whole(0)}.{version.whole(1)}.{version.whole(2)}",
            simulated=self.transport.simulated,
            details={
                "address": self.address,
                "internal_temperature": math.nan if warmth is None else warmth.number(0),
                **self.settings.model_dump(include={"move", "distance_mode"}),
            },
        )

    def environment(self) -> Environment:
        """Return the conditions of the air for which the station corrects distances: degC, Pa, %."""
        values = self._request(codes.GET_AIR)
        pressure, dry, wet = HECTOPASCAL * values.number(1), values.number(2), values.number(3)
        return Environment(dry, pressure, air.humidity(dry, wet, pressure))

    def set_environment(self, environment: Environment) -> None:
        """Set the conditions of the air for which the station corrects distances; this writes to the station.

        Raises
        ------
        InstrumentError
            A value is unknown or not plausible, or the station refuses.
        """
        given = environment.temperature, environment.pressure, environment.humidity
        if not (-60.0 <= given[0] <= 60.0 and 5e4 <= given[1] <= 1.1e5 and 0.0 <= given[2] <= 100.0):
            raise InstrumentError(
                f"Expected the air for {self.address}: -60 to 60 degC, 50000 to 110000 Pa, 0 to 100 %; found {given}",
                code="tracker.air.outside",
            )
        wavelength = self._request(codes.GET_AIR).number(0)
        wet = air.wet_temperature(given[0], given[2], given[1])
        self._request(codes.SET_AIR, wavelength, given[1] / HECTOPASCAL, float(given[0]), wet)

    def refraction(self) -> float:
        """Return the index by which the station divides the optical path; NaN if it does not report its correction.

        It follows from the atmospheric correction and from the reference index of the distance meter, see `air`.
        """
        found = self._optional(codes.GET_AIR_PPM)
        return math.nan if found is None else air.refraction_index(found.number(0))

    def direction(self) -> tuple[float, float]:
        """Return the direction of the line of sight: azimuth and zenith angle, rad."""
        call = codes.GET_ANGLES
        reply = self._call(call, codes.INCLINATION[self.settings.inclination])
        codec.check(call, reply)
        if reply.code not in (codes.OK, *codes.WARNINGS):
            raise InstrumentError(
                f"{self.address} has no angles: code {reply.code}, {codes.text(reply.code)}", code="tracker.no_angles"
            )
        return math.remainder(-reply.number(0), math.tau), reply.number(1)

    # ------------------------------------------------------------------ moving

    def go_to(self, target: tuple[float, float, float]) -> None:
        """Turn to a position and aim at the reflector near it: the station moves.

        Parameters
        ----------
        target : (3,)
            Position in the station's frame, m.

        Raises
        ------
        InstrumentError
            ``move`` is not set, the target is not a position, or the station refuses or finds no reflector.
        """
        if reason := self._point_at(target):
            raise InstrumentError(
                f"{self.address} found no reflector near {target}: {reason}", code="tracker.reflector.not_found"
            )

    def _point_at(self, target: tuple[float, float, float]) -> str:
        """Turn to a position; return why no reflector was found, empty if one was found."""
        if not self.settings.move:
            raise InstrumentError(
                f"{self.address} is not armed: set 'move = true' to permit the driver to turn the station, or point it "
                "by hand and measure without a target",
                code="instrument.not_armed",
            )
        x, y, z = (float(each) for each in target)
        if not math.isfinite(x + y + z) or x == y == z == 0.0:
            raise InstrumentError(
                f"Expected a position x, y, z in the station's frame, m, other than the origin; found {target!r}",
                code="position.form",
            )
        horizontal, zenith = -math.atan2(y, x) % math.tau, math.atan2(math.hypot(x, y), z)
        limit, radius = self.settings.motion_timeout, self.settings.search_angle
        for call, parameters in (
            (codes.POSITION, (horizontal, zenith, 0, 0, 0)),
            (codes.FINE_ADJUST, (radius, radius, 0)),
        ):
            reply = self._call(call, *parameters, limit=limit)
            codec.check(call, reply)
            if reply.code in codes.NO_TARGET:
                return f"code {reply.code}, {codes.text(reply.code)}"
            if reply.code != codes.OK:
                raise InstrumentError(
                    f"{self.address} refuses GeoCOM call {codes.name(call)}: code {reply.code}, "
                    f"{codes.text(reply.code)}",
                    code="instrument.refused",
                )
        return ""

    # ------------------------------------------------------------------ measuring

    def measure(self, target: tuple[float, float, float] | None = None) -> Measurement:
        """Measure distance and angles of a reflector.

        Parameters
        ----------
        target : (3,), optional
            Approximate position, m, in the station's frame, to which the station turns; default: it does not move.

        Returns
        -------
        Measurement
            ``std`` is that of the settings. A measurement without a distance is not valid and states the reason.

        Raises
        ------
        InstrumentError
            A target is given without ``move``; or the station refuses for another reason, or does not answer.
        """
        if target is not None and (reason := self._point_at(target)):
            return Measurement(reason=reason)
        inclination = codes.INCLINATION[self.settings.inclination]
        self._request(codes.DO_MEASURE, codes.MEASURE_CLEAR, inclination)
        self._request(codes.DO_MEASURE, codes.MEASURE_DEFAULT, inclination)
        measurement = self._result(inclination)
        if measurement.code not in (codes.OK, *codes.WARNINGS):
            return Measurement(reason=f"code {measurement.code}, {codes.text(measurement.code)}")
        horizontal, zenith, distance = (measurement.number(index) for index in range(3))
        if not distance > 0.0:
            return Measurement(reason="the station returned no distance")
        if measurement.code != codes.OK:
            if not self.warnings[measurement.code]:
                log.warning("%s: code %d, %s", self.address, measurement.code, codes.text(measurement.code))
            self.warnings[measurement.code] += 1
        settings = self.settings
        return Measurement(
            distance,
            (math.remainder(-horizontal, math.tau), zenith),
            (math.hypot(settings.noise, settings.noise_per_length * distance), *(2 * (settings.angle_noise,))),
            self.environment(),
            self.refraction(),
            valid=True,
        )

    def _result(self, inclination: int) -> codec.Reply:
        """Return the measurement that was started; repeat the request while the station is busy."""
        limit = self.settings.measuring_timeout
        deadline = time.monotonic() + limit
        while True:
            reply = self._call(
                codes.GET_MEASUREMENT, round(1e3 * limit), inclination, limit=limit + self.settings.timeout
            )
            codec.check(codes.GET_MEASUREMENT, reply)
            if reply.code in (codes.OK, *codes.WARNINGS, *codes.NO_DISTANCE):
                return reply
            if reply.code != codes.BUSY or time.monotonic() > deadline:
                raise InstrumentError(
                    f"{self.address} does not measure: code {reply.code}, {codes.text(reply.code)}",
                    code="instrument.refused",
                )
            time.sleep(BUSY_INTERVAL)

    def read(self) -> float:
        """Return the present distance, m; NaN if there is none."""
        return self.measure().distance

    # ------------------------------------------------------------------ settings

    def configure(self, settings: GeoComSettings) -> None:
        """Use other settings from now on; a ``distance_mode`` other than ``as_set`` is written to the station."""
        self.settings = settings
        if settings.distance_mode != "as_set":
            self._request(codes.SET_DISTANCE_MODE, codes.DISTANCE_MODES[settings.distance_mode])
