"""Sources of tracker readings for the Monte Carlo method.

A drawn reading contains the noise twice, that of the measurement and that of the draw. The identification therefore
tests drifts and similar effects with the noise times the square root of two.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from errormotion.methods.multilateration.identification.expansion import air_scale, scale_strain
from errormotion.methods.multilateration.identification.uncertainty import READINGS, REPEATABILITY, UNEXPLAINED
from errormotion.plugins import Redraw, Redrawing, replaced

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.arrays import Array
    from errormotion.methods.multilateration.settings import Expansion, Settings

DRAWN_NOISE = float(np.sqrt(2.0))
"""Noise of a drawn reading over that of a measured one."""


def redrawing(raw: xr.Dataset, settings: Settings, errors: xr.Dataset) -> Redrawing:
    """Return the readings without outliers, and their sources: noise and repeatability, scales, expansion."""
    d = _displacement(raw)
    known = (errors["left_out"].transpose("station", "target").values == 0) & np.isfinite(errors["EX"].values)
    measured = raw["displacement"].attrs
    reduced = raw.load().assign(displacement=(("station", "target"), np.where(known, d, np.nan), measured))
    reduced["displacement_noise"] = (raw["displacement_noise"] * DRAWN_NOISE).assign_attrs(
        raw["displacement_noise"].attrs
    )
    quiet = {"robust": False, "noise": "stated", "parametric": False}
    if settings.repeatability is not None:
        quiet |= {
            "repeatability": settings.repeatability * DRAWN_NOISE,
            "repeatability_uncertainty": settings.repeatability_uncertainty * DRAWN_NOISE,
        }
    sources = {"readings": _readings(float(errors["noise"]))}
    if settings.together and "repeatability" in errors:
        sources["repeatability"] = _positions(float(errors["repeatability"]), errors)
    refraction = float(np.linalg.norm(list(air_scale(raw, settings.air, [])[1].values())))  # all have the same effect
    for group, relative in (("refraction", refraction), ("scale of the tracker", settings.scale_or_assumed)):
        if relative > 0:
            sources[group] = _scale(relative, group)
    if settings.expansion is not None:
        warmer, _ = scale_strain(raw, settings.expansion)
        reduced["scale_temperature"] = (("station", "direction"), warmer + settings.expansion.reference)
        reduced["scale_temperature"].attrs["units"] = "degC"
        sources["expansion of the scales"] = _expansion(settings.expansion)
    return Redrawing(reduced, settings.model_copy(update=quiet), sources)


def _displacement(raw: xr.Dataset) -> Array:
    return np.array(raw.variables["displacement"].transpose("station", "target").values, dtype=np.float64)


def _with(raw: xr.Dataset, displacement: Array) -> xr.Dataset:
    return replaced(raw, {"displacement": displacement})


def _readings(noise: float) -> Redraw:
    """Return the noise of the readings, which includes drift and repeatability of separate set-ups."""

    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        d = _displacement(raw)
        return _with(raw, d + generator.normal(0.0, noise, d.shape)), settings

    return Redraw(draw, groups=(READINGS, REPEATABILITY, UNEXPLAINED, "drift"), own=True)


def _positions(repeatability: float, errors: xr.Dataset) -> Redraw:
    """Return the repeatability of positions read by all stations at the same time: a displacement of the target."""
    target = errors["target_place"].transpose("target", "direction").values
    beam = target - errors["station_place"].transpose("station", "direction").values[:, None]
    beam = np.nan_to_num(beam / np.linalg.norm(beam, axis=2, keepdims=True))

    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        shift = generator.normal(0.0, repeatability, target.shape)
        return _with(raw, _displacement(raw) + np.einsum("jta,ta->jt", beam, shift)), settings

    return Redraw(draw, own=True)


def _scale(relative: float, group: str) -> Redraw:
    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        return _with(raw, _displacement(raw) * (1.0 + relative * generator.normal())), settings

    return Redraw(draw, groups=(group,))


def _expansion(expansion: Expansion) -> Redraw:
    """Return the source of coefficient and temperature of the scales; an axis has one temperature for all set-ups."""

    def draw(raw: xr.Dataset, settings: Settings, generator: np.random.Generator) -> tuple[xr.Dataset, Settings]:
        coefficient = expansion.coefficient + expansion.coefficient_uncertainty * generator.normal()
        shift = expansion.temperature_uncertainty * generator.normal(size=3)
        moved = raw.variables["scale_temperature"].values + shift
        changed = expansion.model_copy(update={"coefficient": coefficient})
        return replaced(raw, {"scale_temperature": moved}), settings.model_copy(update={"expansion": changed})

    return Redraw(draw, groups=("scales",))
