"""What to expect of the set-up in the settings before anybody carries a tracker, and of the best one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.datasets import build_errors, provenance
from errormotion.datasets.units import format_quantity
from errormotion.errors import MethodError
from errormotion.methods.multilateration import layout
from errormotion.methods.multilateration.bound import bound
from errormotion.methods.multilateration.model import motions
from errormotion.methods.multilateration.refraction import index_uncertainty, sensitivities
from errormotion.methods.multilateration.sight import Sight

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from errormotion.methods.multilateration.network import Network
    from errormotion.methods.multilateration.settings import Settings
    from errormotion.methods.multilateration.sight import Planning
    from errormotion.plugins import MethodInfo

    Array = NDArray[np.float64]

SETUPS = ("as set", "best")
_COARSE = 4
"""Targets along each axis with which places are searched: the worst are at the sides."""
_AIR = (20.0, 101325.0, 0.5)
"""Temperature (degC), pressure (Pa), humidity (1) of the air that a plan reckons with."""


def plan(info: MethodInfo, settings: Settings, planning: Planning | None = None) -> xr.Dataset:
    """Return an error dataset of zeros with the covariance to expect of the layout that the settings name.

    What it holds beside: ``target_uncertainty`` and ``best_uncertainty`` (target), the standard uncertainty of all
    three coordinates together by the readings alone, m: the map of the layout as set and of the best one within the
    boxes; ``station_place`` and ``best_place`` (station, direction), m; ``sees`` and ``best_sees`` (station, target);
    ``largest_uncertainty`` and ``mean_uncertainty`` (setup), m; ``gain``, the factor by which the best layout is
    better in what was minimised. ``notes`` say it in words.

    Parameters
    ----------
    info : MethodInfo
        Of the method.
    settings : Settings
    planning : Planning, optional
        Boxes, obstacles, reflector, and what is minimised; default: those of the settings.

    Raises
    ------
    MethodError
        The layout leaves a freedom loose, or there is no better one within the boxes.
    """
    p = settings.layout
    planning = planning or settings.planning
    position, target = layout.grid(p)
    sight = Sight.of(planning)
    own = np.array(p.stations, np.float64)
    noise = reading_noise(settings)
    sees = sight.sees(own, target)
    expected = bound(target, own, noise=noise, seen=sees)
    place, best = _best(settings, planning, sight, own, expected)
    sigma = [layout.uncertainty(network.target_covariance) for network in (expected, best)]
    gain = _measure(planning, sigma[0]) / _measure(planning, sigma[1])
    names, groups, shared = _shared(settings, position, target)
    moves = np.concatenate([expected.influence(), shared])
    influence = np.concatenate([moves, np.zeros_like(moves)], axis=-1)
    covariance = np.full((len(target), 6, 6), np.nan)
    covariance[:, :3, :3] = expected.target_covariance + np.einsum("sia,sib->iab", shared, shared)
    errors = np.zeros((len(target), 6))
    errors[:, 3:] = np.nan
    errors[~np.isfinite(sigma[0])] = np.nan
    m = {"units": "m"}
    coords = {name: ("target", position[:, i], m) for i, name in enumerate("xyz")}
    ds = build_errors(
        errors,
        covariance,
        dims=("target",),
        coords={
            **coords,
            "target": layout.target_names(len(target)),
            "station": layout.station_names(len(own)),
            "direction": list("xyz"),
            "setup": list(SETUPS),
        },
        component="tool",
        machine="plan",
        frame="machine",
        functional_point=np.array(p.reflector),
        reference="planned, not measured",
        method=info.id,
        method_version=info.version,
        provenance=provenance.make(settings, None, None, steps=["plan"]),
        influence=influence,
        sources=[*(f"stations.{k}" for k in range(len(moves) - len(names))), *names],
        source_groups=[*["stations"] * (len(moves) - len(names)), *groups],
        extras={
            "target_uncertainty": xr.DataArray(sigma[0], dims="target", attrs=m),
            "best_uncertainty": xr.DataArray(sigma[1], dims="target", attrs=m),
            "station_place": xr.DataArray(own, dims=("station", "direction"), attrs=m),
            "best_place": xr.DataArray(place, dims=("station", "direction"), attrs=m),
            "sees": xr.DataArray(sees.astype(np.int8), dims=("station", "target")),
            "best_sees": xr.DataArray(sight.sees(place, target).astype(np.int8), dims=("station", "target")),
            "largest_uncertainty": xr.DataArray([np.nanmax(s) for s in sigma], dims="setup", attrs=m),
            "mean_uncertainty": xr.DataArray([np.nanmean(s) for s in sigma], dims="setup", attrs=m),
            "gain": xr.DataArray(gain, attrs={"units": "1"}),
        },
    )
    return ds.assign_attrs(notes=_notes(sigma, place, sees, gain, planning, position))


def reading_noise(settings: Settings) -> float:
    """Return the standard deviation of a reading, m: the tracker's, and with set-ups in turn the machine's."""
    repeated = 0.0 if settings.together else settings.repeatability or 0.0
    return float(np.hypot(settings.layout.displacement_noise, repeated))


def boxes_of(planning: Planning, stations: Array) -> Array:
    """Return the box of each station, (n, 2, 3), m: as stated, or the one around all stations of the layout.

    Raises
    ------
    MethodError
        Boxes for another number of stations.
    """
    if planning.boxes:
        boxes = np.array([(box.low, box.high) for box in planning.boxes], np.float64)
        if len(boxes) not in (1, len(stations)):
            raise MethodError(
                f"expected one box for all stations or one for each of {len(stations)}; found {len(boxes)}"
            )
        return np.tile(boxes, (len(stations), 1, 1)) if len(boxes) == 1 else boxes
    around = np.stack([stations.min(axis=0), stations.max(axis=0)])
    return np.tile(around, (len(stations), 1, 1))


def _measure(planning: Planning, sigma: Array) -> float:
    """Return what is minimised, m, of uncertainties of the targets, NaN for those that are not determined."""
    return float(np.nanmax(sigma) if planning.minimise == "largest" else np.nanmean(sigma))


def _best(settings: Settings, planning: Planning, sight: Sight, own: Array, expected: Network) -> tuple[Array, Network]:
    """Return the best places and what they are worth; the own ones where no others are better."""
    p, noise = settings.layout, reading_noise(settings)
    coarse = p.model_copy(update={"count": tuple(min(k, _COARSE) for k in p.count)})
    place = layout.optimise(
        layout.grid(coarse)[1],
        boxes_of(planning, own),
        sight,
        noise=noise,
        start=own,
        minimise=planning.minimise,
    )
    target = layout.grid(p)[1]
    best = bound(target, place, noise=noise, seen=sight.sees(place, target))
    there, here = (layout.uncertainty(network.target_covariance) for network in (best, expected))
    unseen = np.isnan(here).sum() - np.isnan(there).sum()
    return (place, best) if unseen > 0 or _measure(planning, there) < _measure(planning, here) else (own, expected)


def _shared(settings: Settings, position: Array, target: Array) -> tuple[list[str], list[str], Array]:
    """Return sources that all readings share, their groups, and what they do to the targets (source, m, 3), m.

    A scale error of the lengths makes the whole larger, stations and dead paths with it. An expansion of the scales
    that is not known makes the grid look smaller.
    """
    centred = target - target.mean(axis=0)
    air = settings.air
    u = {
        "temperature": air.temperature_uncertainty,
        "pressure": air.pressure_uncertainty,
        "humidity": air.humidity_uncertainty / 100,
    }
    index = index_uncertainty(sensitivities(*_AIR, air.co2, air.wavelength), u)
    scales = {f"air {name}": ("air", float(abs(value))) for name, value in index.items()}
    scales["wavelength"] = ("air", air.wavelength_uncertainty)
    scales["scale of the tracker"] = ("tracker", settings.scale_uncertainty)
    names = [name for name, (_, value) in scales.items() if value > 0]
    groups = [scales[name][0] for name in names]
    effects = [scales[name][1] * centred for name in names]
    if (e := settings.expansion) is not None:
        warmer = 0.0 if e.temperature is None else e.temperature - e.reference
        strains = {"expansion coefficient": np.full(3, e.coefficient_uncertainty * warmer)}
        strains |= {
            f"temperature of {axis} scale": e.coefficient * e.temperature_uncertainty * np.eye(3)[k]
            for k, axis in enumerate("XYZ")
        }
        strains = {name: strain for name, strain in strains.items() if strain.any()}
        names += list(strains)
        groups += ["expansion"] * len(strains)
        effects += [_without_motion(-strain * position, target) for strain in strains.values()]
    return names, groups, np.array(effects).reshape(-1, *target.shape)


def _without_motion(change: Array, target: Array) -> Array:
    """Return a change (m, 3) of the targets less the rigid motion that fits it best."""
    G = motions(target, target.mean(axis=0)).reshape(-1, 6)
    left = change.ravel() - G @ np.linalg.lstsq(G, change.ravel())[0]
    return np.asarray(left.reshape(change.shape))


def _notes(
    sigma: list[Array], place: Array, sees: NDArray[np.bool_], gain: float, planning: Planning, position: Array
) -> list[str]:
    own, best = ([format_quantity(float(x), "um", 3) for x in (np.nanmax(s), np.nanmean(s))] for s in sigma)
    worst = "({:.0f}, {:.0f}, {:.0f}) mm".format(*(position[np.nanargmax(sigma[0])] * 1e3))
    notes = [
        f"As set, a target has a standard uncertainty (three coordinates together) of {own[0]} at the worst, with the "
        f"axes at {worst}, and {own[1]} in the mean, by the readings alone.",
    ]
    if missing := int(np.count_nonzero(~sees)):
        notes.append(
            f"As set, {missing} of {sees.size} lines of sight are blocked or beyond the reflector's acceptance."
        )
    if unseen := int(np.count_nonzero(np.isnan(sigma[0]))):
        what = "target is" if unseen == 1 else "targets are"
        notes.append(f"As set, {unseen} {what} seen by fewer than three stations and will not be determined.")
    if gain != 1:
        where = "; ".join("{:.0f}, {:.0f}, {:.0f}".format(*(U * 1e3)) for U in place)
        notes.append(
            f"The best layout within the boxes: {best[0]} at the worst, {best[1]} in the mean. Its {planning.minimise} "
            f"uncertainty is {gain:.3g} times smaller. Stations at (mm): {where}."
        )
    else:
        notes.append("No better layout was found within the boxes.")
    return notes
