"""Known geometry of a drift: beams with their covariance, radius of the bar, levels; what contradicts is refused."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.methods.spindle_drift.identification.bar import SIDE
from errormotion.methods.spindle_drift.schema import CHANNELS

if TYPE_CHECKING:
    from errormotion.methods.spindle_drift.settings import SpindleDriftSettings


@dataclass(frozen=True)
class Setup:
    """Beams (5, 3) with their covariance (5, 6, 6) and its group in the budget, bar radius and levels (2,), SI."""

    origin: Array
    direction: Array
    covariance: Array
    group: str
    radius: float
    levels: Array

    @classmethod
    def of(cls, raw: xr.Dataset, settings: SpindleDriftSettings, notes: list[str]) -> Setup:
        """Return the set-up that a raw dataset states.

        Raises
        ------
        MethodError
            Levels or beams that do not determine the axis.
        """
        levels = np.asarray(raw["level"].values, np.float64)
        if not abs(levels[1] - levels[0]) > 1e-3:
            raise MethodError(
                f"The levels L1 and L2 are {levels[0] * 1e3:g} mm and {levels[1] * 1e3:g} mm: expected two heights at "
                "least 1 mm apart.",
                code="drift.levels.too_close",
            )
        return cls(*_beams(raw, settings, notes), float(raw["bar_radius"]), levels)

    def check_senses(self, reading: Array, E: Array, a: Array) -> None:
        """Refuse beams that point from the bar to the sensor, for readings (5,) and the end E and direction a (3,)."""
        w = self.origin + self.direction * reading[:, None] - E
        outward = w - (w @ a)[:, None] * a
        outward[4] = a * (E[2] - self.levels.mean())
        leaving = [c for c, n, u in zip(CHANNELS, outward, self.direction, strict=True) if n @ u > 0]
        if leaving:
            raise MethodError(
                f"The beam of {', '.join(leaving)} points away from the bar. Expected beam_direction from the sensor "
                "to the bar, and readings that increase with the distance of the bar; check the sign of the direction.",
                code="drift.beam.opposite",
            )


def _beams(raw: xr.Dataset, settings: SpindleDriftSettings, notes: list[str]) -> tuple[Array, Array, Array, str]:
    """Return origins, directions (5, 3), covariance (5, 6, 6) and the budget's name for it."""
    nominal = settings.beams == "nominal"
    if nominal and "nominal_origin" not in raw:
        raise MethodError(
            "beams = 'nominal' needs nominal_origin and nominal_direction(channel, direction), which the raw dataset "
            "does not have. Use beams = 'raw'.",
            code="drift.nominal_beams.missing",
        )
    of_channel = raw[[f"{'nominal' if nominal else 'beam'}_{part}" for part in ("origin", "direction")]]
    origin, direction = (
        np.asarray(each.transpose("channel", "direction").values, np.float64) for each in of_channel.values()
    )
    if not (np.isfinite(origin).all() and np.isfinite(direction).all()):
        lost = [c for c, o, u in zip(CHANNELS, origin, direction, strict=True) if not np.isfinite([*o, *u]).all()]
        raise MethodError(
            f"The beam of {', '.join(lost)} is unknown (NaN); expected origin and direction of all five.",
            code="drift.beam.unknown",
        )
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    flat = direction[:SIDE, :2] / np.linalg.norm(direction[:SIDE, :2], axis=1, keepdims=True)
    for i, j in ((0, 2), (0, 3), (1, 2), (1, 3)):
        sine = abs(flat[i, 0] * flat[j, 1] - flat[i, 1] * flat[j, 0])
        if sine < 0.1:
            raise MethodError(
                f"The beams {CHANNELS[i]} and {CHANNELS[j]} are parallel within {np.degrees(np.arcsin(sine)):.1f} "
                "deg, so that they do not determine the position of the bar. Expected X beams across Y beams; check "
                "beam_direction.",
                code="drift.beams.parallel",
            )
    if nominal:
        covariance = np.zeros((5, 6, 6))
        for i in range(5):
            covariance[i, :3, :3] = np.eye(3) * settings.nominal_origin_uncertainty**2
            across = np.eye(3) - np.outer(direction[i], direction[i])
            covariance[i, 3:, 3:] = across * settings.nominal_direction_uncertainty**2
        return origin, direction, covariance, "nominal beams"
    if "beam_covariance" in raw:
        covariance = np.asarray(raw["beam_covariance"].transpose("channel", "p", "p_").values, np.float64)
        if raw.attrs.get("beam_uncertainty") == "assumed":
            notes.append("The uncertainty of the beams is assumed: the map of the imported log states none.")
        return origin, direction, covariance, "beam calibration"
    notes.append("The raw dataset states no beam_covariance: the beams are assumed to be exact.")
    return origin, direction, np.zeros((5, 6, 6)), "beam calibration"
