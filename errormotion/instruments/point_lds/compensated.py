"""Readings of a point sensor with its inclination error taken off, the raw ones beside them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.plugins import Samples

if TYPE_CHECKING:
    from errormotion.datasets.calibrations.inclination import Compensated, InclinationCalibration

Array = np.ndarray[Any, Any]


class PointSensor(Protocol):
    """What every driver of the kind ``point_lds`` offers beyond an instrument."""

    @property
    def measuring_range(self) -> tuple[float, float]:
        """Lowest and highest reading, m."""

    @property
    def mid_range(self) -> float:
        """The reading in the middle of the range, m: there the tilt of a surface does nothing."""

    def read(self) -> float:
        """Return one reading now, m along the beam, more for what is further away; NaN where there is none."""

    def stream(self, block: int | None = None) -> Iterator[Samples]:
        """Yield blocks of readings."""


@dataclass(frozen=True, kw_only=True)
class CompensatedSamples(Samples):
    """A block of readings whose ``values`` (1, n) are compensated.

    Attributes
    ----------
    raw : ndarray, float64, (1, n)
        As they were read, m.
    uncertainty : ndarray, float64, (1, n)
        Standard uncertainty of ``values`` that comes from the calibration, m.
    jacobian : ndarray, float64, (1, n, term)
        Derivative of ``values`` by the coefficients of the calibration, m: all readings share their covariance.
    """

    raw: Array
    uncertainty: Array
    jacobian: Array


class CompensatedSensor:
    """Any point sensor together with the calibration of its inclination error.

    It opens and closes nothing: the sensor is used as it is.

    Parameters
    ----------
    sensor : PointSensor
        A driver of the kind ``point_lds``.
    calibration : path, name or InclinationCalibration
        Looked for as `InclinationCalibration.find` does.
    extrapolate : bool
        Whether to go beyond what was calibrated; refused else.

    Raises
    ------
    InstrumentError
        The sensor does not say where the middle of its range is.
    DatasetError
        No such calibration.
    """

    def __init__(
        self, sensor: PointSensor, calibration: str | Path | InclinationCalibration, *, extrapolate: bool = False
    ) -> None:
        if not hasattr(sensor, "mid_range"):
            raise InstrumentError(
                f"Expected a point sensor that says which reading is the middle of its range; found {sensor!r}"
            )
        self.sensor = sensor
        self.calibration = _found(calibration)
        self.extrapolate = extrapolate

    def read(self, inclination: float, rotation: float) -> Compensated:
        """Return one reading of a surface that lies so to the beam: ``value`` and ``raw`` (), m.

        Parameters
        ----------
        inclination : float
            Angle between the beam and the normal of the surface, rad.
        rotation : float
            Azimuth of that tilt about the beam from the plane of triangulation, rad.

        Raises
        ------
        InstrumentError
            Of the sensor; or an angle that is no number.
        MethodError
            The calibration does not speak for this tilt or depth.
        """
        return self._compensate(self.sensor.read(), inclination, rotation)

    def stream(self, inclination: float, rotation: float, block: int | None = None) -> Iterator[CompensatedSamples]:
        """Yield blocks of readings of a surface that lies so to the beam, until the caller stops; see `read`."""
        for samples in self.sensor.stream(block):
            known = {field.name: getattr(samples, field.name) for field in fields(Samples)}
            found = self._compensate(samples.values, inclination, rotation)
            yield CompensatedSamples(
                **{**known, "values": found.value},
                raw=found.raw,
                uncertainty=found.uncertainty,
                jacobian=found.jacobian,
            )

    def _compensate(self, reading: float | Array, inclination: float, rotation: float) -> Compensated:
        from errormotion.kinematics.beams import tilt_vector

        q = tilt_vector(inclination, rotation)
        if not np.isfinite(q).all():
            raise InstrumentError(
                f"Expected how the surface lies to the beam; found inclination {inclination}, rotation {rotation} rad"
            )
        found = self.calibration.compensate(reading, q, mid_range=self.sensor.mid_range, extrapolate=self.extrapolate)
        shape = np.shape(reading)  # one tilt for all of them adds no dimension
        return replace(
            found,
            raw=found.raw.reshape(shape),
            value=found.value.reshape(shape),
            uncertainty=found.uncertainty.reshape(shape),
            jacobian=found.jacobian.reshape(*shape, -1),
        )


def _found(calibration: str | Path | InclinationCalibration) -> InclinationCalibration:
    from errormotion.datasets.calibrations.inclination import (
        InclinationCalibration,  # reads files: only when one is needed
    )

    if isinstance(calibration, InclinationCalibration):
        return calibration
    return InclinationCalibration.find(calibration)
