"""Readings of a point sensor, compensated for its inclination error, and the raw readings."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from errormotion.datasets.calibrations.owner import known
from errormotion.errors import InstrumentError
from errormotion.plugins import Samples

if TYPE_CHECKING:
    from errormotion.datasets.calibrations.inclination import Compensated, InclinationCalibration
    from errormotion.plugins.kinds import PointLDS

Array = np.ndarray[Any, Any]

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class CompensatedSamples(Samples):
    """A block of readings whose ``values`` (1, n) are compensated.

    Attributes
    ----------
    raw : ndarray, float64, (1, n)
        Uncorrected readings, m.
    uncertainty : ndarray, float64, (1, n)
        Standard uncertainty of ``values`` due to the calibration, m.
    jacobian : ndarray, float64, (1, n, term)
        Derivative of ``values`` with respect to the coefficients of the calibration, m; all readings share their
        covariance.
    """

    raw: Array
    uncertainty: Array
    jacobian: Array


class CompensatedSensor:
    """A point sensor together with the calibration of its inclination error.

    The sensor must be open; it is neither opened nor closed here.

    Parameters
    ----------
    sensor : PointLDS
        A sensor that streams, open.
    calibration : path, name or InclinationCalibration
        A path or name is resolved by `InclinationCalibration.find`.
    extrapolate : bool
        Whether tilts and depths beyond the calibrated ones are compensated; refused otherwise.
    allow_other_sensor : bool
        Whether a calibration of another sensor, by its serial number or mid-range, is used; refused otherwise.

    Attributes
    ----------
    notes : tuple of str
        Checks that were not possible, and permitted deviations.

    Raises
    ------
    InstrumentError
        The sensor does not state the middle of its range, or is not open.
    DatasetError
        No such calibration, or one that belongs to another sensor.
    """

    def __init__(
        self,
        sensor: PointLDS,
        calibration: str | Path | InclinationCalibration,
        *,
        extrapolate: bool = False,
        allow_other_sensor: bool = False,
    ) -> None:
        if not hasattr(sensor, "mid_range"):
            raise InstrumentError(
                f"Expected a point sensor that states the middle of its range (mid_range); found {sensor!r}",
                code="sensor.mid_range.missing",
            )
        self.sensor = sensor
        self.calibration = _found(calibration)
        self.extrapolate = extrapolate
        serial = known(sensor.identify().serial_number)
        found = self.calibration.require_sensor(serial, sensor.mid_range, allow_other_sensor=allow_other_sensor)
        self.notes = tuple(found)
        for note in found:
            log.warning(note)

    def read(self, inclination: float, rotation: float) -> Compensated:
        """Return one reading of a surface with a known tilt to the beam: ``value`` and ``raw`` (), m.

        Parameters
        ----------
        inclination : float
            Angle between the beam and the normal of the surface, rad.
        rotation : float
            Azimuth of the surface's normal about the beam, rad: 0 where it leans away from the receiver, clockwise for
            an observer who looks along the beam.

        Raises
        ------
        InstrumentError
            An error of the sensor, or an angle that is not finite.
        MethodError
            The calibration does not cover this tilt or depth.
        """
        return self._compensate(self.sensor.read(), inclination, rotation)

    def stream(self, inclination: float, rotation: float, block: int | None = None) -> Iterator[CompensatedSamples]:
        """Yield blocks of readings of a surface with a known tilt, until the caller stops; see `read`."""
        for samples in self.sensor.stream(block):  # type: ignore[attr-defined]
            known = {field.name: getattr(samples, field.name) for field in fields(Samples)}
            compensated = self._compensate(samples.values, inclination, rotation)
            yield CompensatedSamples(
                **{**known, "values": compensated.value},
                raw=compensated.raw,
                uncertainty=compensated.uncertainty,
                jacobian=compensated.jacobian,
            )

    def _compensate(self, reading: float | Array, inclination: float, rotation: float) -> Compensated:
        from errormotion.kinematics.beams import tilt_vector

        q = tilt_vector(inclination, rotation)
        if not np.isfinite(q).all():
            raise InstrumentError(
                f"Expected finite angles of the surface; found inclination {inclination}, rotation {rotation} rad",
                code="sensor.surface.angle",
            )
        compensated = self.calibration.compensate(
            reading, q, mid_range=self.sensor.mid_range, extrapolate=self.extrapolate
        )
        shape = np.shape(reading)  # one tilt for all of them adds no dimension
        return replace(
            compensated,
            raw=compensated.raw.reshape(shape),
            value=compensated.value.reshape(shape),
            uncertainty=compensated.uncertainty.reshape(shape),
            jacobian=compensated.jacobian.reshape(*shape, -1),
        )


def _found(calibration: str | Path | InclinationCalibration) -> InclinationCalibration:
    from errormotion.datasets.calibrations.inclination import (
        InclinationCalibration,  # slow to import
    )

    if isinstance(calibration, InclinationCalibration):
        return calibration
    return InclinationCalibration.find(calibration)
