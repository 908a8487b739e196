"""Predicted uncertainty of the layout of the settings, and of the best one."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets.units import format_quantity
from errormotion.errors import MethodError
from errormotion.methods.multilateration.networks import bound
from errormotion.methods.multilateration.planning import layout
from errormotion.methods.multilateration.planning.bound import predicted_uncertainty
from errormotion.methods.multilateration.planning.sight import Sight
from errormotion.methods.multilateration.planning.target_plan import Choice, choose
from errormotion.methods.multilateration.planning.text import layout_text, map_text
from errormotion.methods.multilateration.readings import station_names, target_names
from errormotion.methods.multilateration.schema import SCHEMA
from errormotion.methods.multilateration.start import Stations, readings

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from errormotion.methods.multilateration.settings import MultilaterationSettings, Planning

SETUPS = ("as set", "best")
_COARSE = 4
"""Targets along each axis for the search of positions: the largest uncertainties are at the faces."""


def expected(settings: MultilaterationSettings) -> xr.Dataset:
    """Return the raw data of the layout of the settings without errors and noise, each target visited once."""
    p = settings.layout
    target = layout.grid(p)[1]
    own = np.array(p.stations, np.float64)
    seen = Sight.of(settings.planning).sees(own, target)
    d = np.where(seen, readings(target, Stations(own, np.zeros(len(own)))), np.nan)
    m, vector = {"units": "m"}, ("target", "direction")
    variables = {
        "displacement": (("station", "target"), d, m),
        "target_nominal": (vector, target, m),
        "station_nominal": (("station", "direction"), own, m),
        "reflector": (vector, np.tile(p.reflector, (len(target), 1)), m),
        "displacement_noise": ((), p.displacement_noise, m),
    }
    if (e := settings.expansion) is not None:
        warm = e.reference if e.temperature is None else e.temperature
        variables["scale_temperature"] = (("station", "direction"), np.full(own.shape, warm), {"units": "degC"})
    coords = {"station": station_names(len(own)), "target": target_names(len(target)), "direction": list("xyz")}
    attrs = {"schema": SCHEMA, "machine": "plan"} | ({"chain": settings.chain} if settings.chain else {})
    return xr.Dataset(variables, coords, attrs)


def with_best_layout(planned: xr.Dataset, settings: MultilaterationSettings, planning: Planning) -> xr.Dataset:
    """Return the plan of the layout of the settings with the best layout.

    Further variables; standard uncertainties are those of three coordinates together, by the readings only, m:
    ``target_uncertainty`` (target) of the layout as set; ``map_uncertainty`` (setup, place) at ``map_position``
    (place, direction), as set and with the best layout; ``largest_uncertainty`` and ``mean_uncertainty`` (setup) of
    that map; ``gain``, the ratio of the minimised uncertainty, as set over best; ``best_place`` (station, direction),
    m; ``sees`` (station, target) and ``best_sees`` (station, place). If targets are chosen, the map is over the
    candidates, and ``chosen`` (place) is 1 for those to measure. The attribute ``best_layout`` is the best layout as
    settings of a campaign; ``notes`` describe the plan.

    Parameters
    ----------
    planned : Dataset
    settings : MultilaterationSettings
    planning : Planning
        Boxes, obstacles, reflector, and the minimised quantity.

    Raises
    ------
    MethodError
        No positions within the boxes determine the targets.
    """
    p = settings.layout
    position, target = layout.grid(p)
    sight = Sight.of(planning)
    own = np.array(p.stations, np.float64)
    noise = reading_noise(settings)
    sees = sight.sees(own, target)
    sigma = _uncertainty(own, target, sees, noise)
    if planning.targets is None:
        choice = _best_stations(settings, planning, sight, own, sigma)
    else:
        choice = choose(settings, planning, planning.targets, sight, boxes_of(planning, own, target), noise)
    gain = _minimised(planning, choice.own) / _minimised(planning, choice.best) if choice.better else 1.0
    text = layout_text(p, choice.station, None if planning.targets is None else choice.position[choice.chosen])
    if planning.write is not None:
        _write(planning.write, text)
    m = {"units": "m"}
    further = {
        "target_uncertainty": ("target", sigma, m),
        "map_position": (("place", "direction"), choice.position, m),
        "map_uncertainty": (("setup", "place"), np.stack([choice.own, choice.best]), m),
        **_chosen(planning, choice),
        "best_place": (("station", "direction"), choice.station, m),
        "sees": (("station", "target"), sees.astype(np.int8)),
        "best_sees": (("station", "place"), choice.sees.astype(np.int8)),
        "largest_uncertainty": ("setup", [np.nanmax(s) for s in (choice.own, choice.best)], m),
        "mean_uncertainty": ("setup", [np.nanmean(s) for s in (choice.own, choice.best)], m),
        "gain": ((), gain, {"units": "1"}),
    }
    notes = _notes(sigma, choice, sees, gain, planning, position)
    return planned.assign(further).assign_coords(setup=list(SETUPS)).assign_attrs(notes=notes, best_layout=text)


def _uncertainty(station: Array, target: Array, sees: NDArray[np.bool_], noise: float) -> Array:
    """Return the standard uncertainties of targets by the readings, (m,), m.

    Raises
    ------
    MethodError
        Positions with an undetermined freedom.
    """
    uncertainty = predicted_uncertainty(sees / noise, station, target)
    if uncertainty is None:
        bound(target, station, noise=noise, seen=sees)
        raise MethodError(
            "The distances do not determine stations and targets. Distribute them more widely.",
            code="network.undetermined",
        )
    return uncertainty


def reading_noise(settings: MultilaterationSettings) -> float:
    """Return the standard deviation of a reading, m: of the tracker, and with separate set-ups of the machine."""
    repeated = 0.0 if settings.together else settings.repeatability or 0.0
    return float(np.hypot(settings.layout.displacement_noise, repeated))


def boxes_of(planning: Planning, stations: Array, targets: Array) -> Array:
    """Return the box of each station, (n, 2, 3), m: as stated, or by default outside of the machine.

    A default box is around all stations of the layout, on the same side of the targets (m, 3) as the station and not
    closer to them than it: possible obstacles are not known. A station among the targets is fixed.

    Raises
    ------
    MethodError
        Boxes for another number of stations.
    """
    if planning.boxes:
        boxes = np.array([(box.low, box.high) for box in planning.boxes], np.float64)
        if len(boxes) not in (1, len(stations)):
            raise MethodError(
                f"Expected one box for all stations, or one for each of {len(stations)}; found {len(boxes)}.",
                code="network.plan.boxes_count",
            )
        return np.tile(boxes, (len(stations), 1, 1)) if len(boxes) == 1 else boxes
    boxes = np.tile(np.stack([stations.min(axis=0), stations.max(axis=0)]), (len(stations), 1, 1))
    low, high = targets.min(axis=0), targets.max(axis=0)
    for box, station in zip(boxes, stations, strict=True):
        beyond = np.maximum(low - station, station - high)
        axis = int(np.argmax(beyond))
        if beyond[axis] <= 0:
            box[:] = station
        else:
            box[1 if station[axis] < low[axis] else 0, axis] = station[axis]
    return boxes


def _minimised(planning: Planning, sigma: Array) -> float:
    """Return the minimised quantity, m, of uncertainties of the targets, NaN for undetermined ones."""
    return float(np.nanmax(sigma) if planning.minimise == "largest" else np.nanmean(sigma))


def _best_stations(
    settings: MultilaterationSettings, planning: Planning, sight: Sight, own: Array, here: Array
) -> Choice:
    """Return the best stations and the uncertainty at the targets; the layout as set if none are better."""
    p, noise = settings.layout, reading_noise(settings)
    position, target = layout.grid(p)
    coarse = p.model_copy(update={"count": tuple(min(k, _COARSE) for k in p.count)})
    station = layout.optimise(
        layout.grid(coarse)[1],
        boxes_of(planning, own, target),
        sight,
        noise=noise,
        start=own,
        minimise=planning.minimise,
    )
    seen = sight.sees(station, target)
    there = _uncertainty(station, target, seen, noise)
    choice = Choice(position, np.arange(len(target)), station, here, there, here, seen)
    unseen = np.isnan(here).sum() - np.isnan(there).sum()
    if unseen > 0 or _minimised(planning, there) < _minimised(planning, here):
        return choice
    return replace(choice, station=own, best=here, sees=sight.sees(own, target))


def _chosen(planning: Planning, choice: Choice) -> dict[str, Any]:
    """Return the variable of the candidates to measure, if targets are chosen."""
    if planning.targets is None:
        return {}
    chosen = np.zeros(len(choice.position), np.int8)
    chosen[choice.chosen] = 1
    about = {"long_name": "1: to be measured", "of": planning.targets.uncertainty}
    return {"chosen": ("place", chosen, about)}


def _write(path: Path, text: str) -> None:
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise MethodError(
            f"planning.write: {path}: the file cannot be created: {error.strerror or error}. State another name.",
            code="file.unwritable",
        ) from error


def _notes(
    sigma: Array, choice: Choice, sees: NDArray[np.bool_], gain: float, planning: Planning, position: Array
) -> list[str]:
    worst = "({:.0f}, {:.0f}, {:.0f}) mm".format(*(position[np.nanargmax(sigma)] * 1e3))
    own = _largest_and_mean(sigma)
    notes = [
        f"Layout as set: the standard uncertainty of a target (three coordinates together), by the readings only, is "
        f"at most {own[0]}, with the axes at {worst}, and {own[1]} on average.",
    ]
    if missing := int(np.count_nonzero(~sees)):
        notes.append(
            f"Layout as set: {missing} of {sees.size} lines of sight are blocked or exceed the acceptance angle of the "
            "reflector."
        )
    if unseen := int(np.count_nonzero(np.isnan(sigma))):
        notes.append(f"Layout as set: targets visible from fewer than three stations, not determined: {unseen}.")
    if planning.targets is not None:
        notes += _notes_of_choice(choice, len(position), planning.targets.uncertainty)
    where = "; ".join("{:.0f}, {:.0f}, {:.0f}".format(*(U * 1e3)) for U in choice.station)
    if gain != 1:
        best = _largest_and_mean(choice.best)
        notes.append(
            f"Best layout within the boxes: at most {best[0]}, {best[1]} on average. Its {planning.minimise} "
            f"uncertainty is {_times(gain)}. Stations at (mm): {where}."
        )
    else:
        notes.append("No better layout was found within the boxes.")
    if text := map_text(choice.position, choice.own, choice.best):
        notes.append(text)
    if planning.write is not None:
        notes.append(f"The best layout is in {planning.write}. It can replace the layout of the campaign.")
    return notes


def _notes_of_choice(choice: Choice, own: int, of: str) -> list[str]:
    what = "the error calculated from the errors of the axes" if of == "axes" else "a target measured there"
    as_set, chosen = _largest_and_mean(choice.own), _largest_and_mean(choice.before)
    return [
        f"{len(choice.chosen)} of {len(choice.position)} candidates are chosen as targets. Over the box, the standard "
        f"uncertainty of {what} is at most {as_set[0]} and {as_set[1]} on average with the {own} targets as set; at "
        f"most {chosen[0]} and {chosen[1]} on average with the chosen ones, from the same stations.",
    ]


def _largest_and_mean(sigma: Array) -> list[str]:
    return [format_quantity(float(x), "um", 3) for x in (np.nanmax(sigma), np.nanmean(sigma))]


def _times(gain: float) -> str:
    return f"smaller by the factor {gain:.3g}" if gain > 1 else f"larger by the factor {1 / gain:.3g}"
