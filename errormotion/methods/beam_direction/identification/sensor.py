"""The point sensor of a raw dataset: its calibration, the plane of its triangulation, and its mid-range."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from errormotion.arrays import Array
from errormotion.datasets.calibrations import owner
from errormotion.datasets.calibrations.inclination import InclinationCalibration
from errormotion.datasets.provenance import identity
from errormotion.methods.beam_direction.identification.reading import triangulation_normal

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.methods.beam_direction.settings import BeamDirectionSettings

CALIBRATION = "inclination calibration"
SAME_TILT = 0.01
"""Difference of tilts up to which a component of the calibration has the same effect in two datasets, rad."""
_NEGLIGIBLE = 1e-12


@dataclass(frozen=True)
class Sensor:
    """Properties of the sensor for the compensation.

    Attributes
    ----------
    calibration : InclinationCalibration
    triangulation_normal : ndarray (3,)
        Unit normal of the plane of emitted and received beam.
    normal_uncertainty : float
        Standard uncertainty of that normal's angle about the beam, rad.
    mid_range : float
        Reading at which the inclination error vanishes, m.
    notes : tuple of str
        Notes on the use of the calibration.
    """

    calibration: InclinationCalibration
    triangulation_normal: Array
    normal_uncertainty: float
    mid_range: float
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, raw: xr.Dataset, settings: BeamDirectionSettings) -> Sensor | None:
        """Return the sensor for the compensation; None without compensation.

        Raises
        ------
        MethodError
            The data do not state the orientation of the sensor, or the side of its receiver.
        DatasetError
            The calibration is not found, or belongs to another sensor.
        """
        if settings.compensation is None:
            return None
        calibration = InclinationCalibration.find(settings.compensation)
        normal = triangulation_normal(raw, settings.receiver)
        name = "triangulation_normal_uncertainty"
        mid_range = float(raw["mid_range"]) if "mid_range" in raw else calibration.mid_range
        serial, allowed = owner.serial_number(raw.attrs, "point_lds"), settings.allow_other_sensor
        return cls(
            calibration,
            normal,
            float(raw[name]) if name in raw else settings.triangulation_normal_uncertainty,
            mid_range,
            tuple(calibration.require_sensor(serial, mid_range, allow_other_sensor=allowed)),
        )

    def components(self, q: Array) -> tuple[Array, tuple[str, ...]]:
        """Return the changes (term, r) of the coefficients that the slopes at tilts q (k, 2) depend on.

        The coefficients with the covariance C change the slopes of k planes, ``J (c + dc)``, in at most k independent
        ways. With ``J C J' = W diag(l) W'``, one standard uncertainty of component i changes them by ``W_i sqrt(l_i)``:
        ``dc_i = C J' W_i / sqrt(l_i)``.

        Returns
        -------
        ndarray (term, r)
        tuple of str (r,)
            Identity of each component. Its error is the same in two datasets with the same calibration and the same
            tilts, to `SAME_TILT`, if it has the same sign on the plane with the largest effect.
        """
        J, C = self.calibration.jacobian(q), self.calibration.coefficient_covariance
        variance, axes = np.linalg.eigh(J @ C @ J.T)
        kept = np.flatnonzero(variance > _NEGLIGIBLE * max(float(variance[-1]), 1e-300))[::-1]
        effects = axes[:, kept] * np.sqrt(variance[kept])
        tilts = np.round(q / SAME_TILT) + 0.0
        reference = self.calibration.reference()["hash"]
        largest = np.argmax(np.abs(effects), axis=0)
        names = tuple(
            identity(reference, tilts, part=f"part {i + 1}", along=(int(row), np.sign(effects[row, i])))
            for i, row in enumerate(largest)
        )
        return C @ J.T @ axes[:, kept] / np.sqrt(variance[kept]), names
