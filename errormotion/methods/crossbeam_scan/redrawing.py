"""Redrawing of the sources of scans for the Monte Carlo method: noise of points and lines, pose, lever, scales, guide.

Scans of the pocket state no noise. Their lines are drawn with replacement, which reproduces their scatter.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from errormotion.datasets import DOF
from errormotion.errors import MethodError
from errormotion.methods.crossbeam_scan.identification import chain
from errormotion.methods.crossbeam_scan.identification.artefact_check import MOVED
from errormotion.methods.crossbeam_scan.identification.carriage import carriage
from errormotion.methods.crossbeam_scan.identification.cutting import Scans
from errormotion.methods.crossbeam_scan.identification.profiler_pose import calibration
from errormotion.methods.crossbeam_scan.identification.registrations import register_all
from errormotion.methods.crossbeam_scan.identification.scans import cold_cycles, rig_of
from errormotion.plugins import Redraw, Redrawing

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from errormotion.arrays import Array
    from errormotion.methods.crossbeam_scan.identification.carriage import Rig
    from errormotion.methods.crossbeam_scan.identification.registrations import Registrations
    from errormotion.methods.crossbeam_scan.settings import Settings

RADIUS_UNCERTAINTY = 1e-6
"""Standard uncertainty of the radius of a pocket, m, where the data state none."""
HEIGHT = ("cycle", "artefact", "profile", "point")


def redrawing(raw: xr.Dataset, settings: Settings, errors: xr.Dataset) -> Redrawing:
    """Return the scans with their sources of uncertainty."""
    if "pocket_radius" in raw:
        return _pocket(raw, settings)
    reduced = _scans(raw)
    rig, cold = rig_of(raw), cold_cycles(raw, reduced.sizes["cycle"])
    rows = [cold[0], *(c for c in range(reduced.sizes["cycle"]) if c not in cold)]
    moved = np.zeros((reduced.sizes["cycle"], reduced.sizes["artefact"]), dtype=bool)
    moved[rows] = errors["reason"].values == MOVED
    found = register_all(Scans(reduced), cold, float(raw["height_noise"]), settings)
    sources = {"heights": _heights(reduced, found, cold)}
    if settings.strain == "guided":
        # Otherwise an excluded scan would affect its neighbours through the guide.
        reduced = reduced.assign(height=reduced["height"].where(~xr.DataArray(moved, dims=HEIGHT[:2])))
        sources["guide"] = _guide(found.without(moved), reduced, rig, settings.guide_uncertainty, rows)
    if rig.pose_covariance is not None:
        sources["profiler pose"] = _pose(rig)
    if rig.lever_uncertainty.any():
        sources["lever"] = _lever(rig)
    strains = settings.strains()
    for name, parameter in (("scale of the profiler", "scale_x"), ("expansion of the artefacts", "expansion")):
        if parameter in strains:
            sources[name] = _strain(strains[parameter], together=parameter == "expansion")
    return Redrawing(reduced, settings.model_copy(update={"moved": "keep"}), sources)


def _scans(raw: xr.Dataset) -> xr.Dataset:
    """Return the scans of a campaign in memory, cut out of the record where the raw data are one."""
    scans = Scans(raw)
    cut: dict[tuple[int, int], tuple[NDArray[np.float32], Array, float]] = {}
    for cycle, artefact in np.ndindex(scans.cycles, scans.artefacts):
        try:
            surface, _, along, moment = scans.scan(cycle, artefact)
        except MethodError:
            continue
        cut[cycle, artefact] = surface, along, moment
    lines = max(len(along) for _, along, _ in cut.values())
    shape = (scans.cycles, scans.artefacts, lines)
    height = np.full((*shape, raw.sizes["point"]), np.nan, dtype=np.float32)
    y, time = np.full(shape, np.nan), np.full(shape[:2], np.nan)
    for index, (surface, along, moment) in cut.items():
        rows = slice(len(along))
        height[(*index, rows)], y[(*index, rows)], time[index] = surface, along, moment
    known = np.isfinite(time).any(axis=1)
    of_cycle = np.arange(scans.cycles, dtype=float)
    of_cycle[known] = [float(np.nanmean(row)) for row in time[known]]
    kept = (
        "x", "position", "profiler_pose", "lever", "lever_uncertainty", "pose_covariance", "height_noise", "warm_up",
    )  # fmt: skip
    reduced = raw[[name for name in kept if name in raw.variables]].load()
    return reduced.assign(
        height=(HEIGHT, height, {"units": "m"}),
        y=(HEIGHT[:3], y, {"units": "m"}),
        time=("cycle", of_cycle, {"units": "s"}),
    )


def _heights(raw: xr.Dataset, found: Registrations, cold: list[int]) -> Redraw:
    """Return the noise of the points, and the jitter of the lines along z and along the feed.

    The noise of the points is increased to the variance of their blocks: noise that neighbouring points share is drawn
    as independent noise with the same effect on a block. The jitter found by a registration is that of both scans; half
    of its variance belongs to the cold scan.
    """
    quality = found.quality
    warm = [c for c in range(raw.sizes["cycle"]) if c not in cold]
    factor, jitter_z, jitter_y = (quality[name].copy() for name in ("variance_factor", "jitter_z", "jitter_y"))
    for values, both in ((factor, 1.0), (jitter_z, 2.0), (jitter_y, 2.0)):
        values[cold] = np.where(np.isfinite(values[cold]), values[cold], np.nan_to_num(values[warm]).mean(axis=0))
        values /= np.sqrt(both)
    noise = np.nan_to_num(quality["noise_found"] * np.sqrt(factor))
    jitter = np.nan_to_num(np.stack([jitter_z, jitter_y], axis=-1))

    def draw(raw: xr.Dataset, settings: Settings, generator: Generator) -> tuple[xr.Dataset, Settings]:
        height = raw["height"].transpose(*HEIGHT).values.copy()
        y = raw["y"].transpose(*HEIGHT[:3]).values
        for (c, k), white in np.ndenumerate(noise):
            scan = height[c, k]
            lines = generator.normal(size=(2, len(scan), 1)) * jitter[c, k][:, None, None]
            change = white * generator.standard_normal(scan.shape, dtype=np.float32) + lines[0]
            if jitter[c, k, 1] > 0:
                change += lines[1] * np.nan_to_num(np.gradient(scan, axis=0) / _pitch(y[c, k]))
            scan += change.astype(np.float32)
        return raw.assign(height=(HEIGHT, height, raw["height"].attrs)), settings

    return Redraw(draw, groups=("cold scan",), own=True)


def _pitch(y: Array) -> float:
    return float(np.nanmedian(np.diff(y)))


def _guide(found: Registrations, raw: xr.Dataset, rig: Rig, uncertainty: float, rows: list[int]) -> Redraw:
    """Return the deviation of pitch and yaw of the carriage from the slopes of its guide, which no reading contains.

    The least squares include the assumptions that EA - dEZ/dY and EC + dEX/dY are 0. Their effect is linear.
    """
    assumed = carriage(found, raw["position"].values, rig, guide=uncertainty).assumed[:, rows]

    def act(errors: xr.Dataset, generator: Generator) -> xr.Dataset:
        drawn = generator.normal(size=assumed.shape[:2])
        change = np.einsum("ac,acki->cki", drawn, assumed)
        values = {name: errors.variables[name].transpose("time", "position") for name in DOF}
        return errors.assign(
            {name: each.copy(data=each.values + change[..., k]) for k, (name, each) in enumerate(values.items())}
        )

    return Redraw(act=act, groups=("cold scan",))


def _pose(rig: Rig) -> Redraw:
    values, factor = calibration.parameters(rig.pose), chain.root(rig.pose_covariance)

    def draw(raw: xr.Dataset, settings: Settings, generator: Generator) -> tuple[xr.Dataset, Settings]:
        a, b, g, dx, dy, dz = values + generator.normal(size=6) @ factor
        matrix = calibration.pose(a, b, g, dx, dy, dz).as_matrix()
        return raw.assign(profiler_pose=(("row", "column"), matrix)), settings

    return Redraw(draw, groups=("profiler pose",))


def _lever(rig: Rig) -> Redraw:
    def draw(raw: xr.Dataset, settings: Settings, generator: Generator) -> tuple[xr.Dataset, Settings]:
        lever = rig.lever + rig.lever_uncertainty * generator.normal(size=3)
        return raw.assign(lever=("direction", lever, raw["lever"].attrs)), settings

    return Redraw(draw, groups=("lever",))


def _strain(relative: float, *, together: bool) -> Redraw:
    """Return independent scales of x and z of each scan, or the expansion of x, y and z ``together``.

    A surface expanded by e has the height z - e x dz/dx at x.
    """

    def draw(raw: xr.Dataset, settings: Settings, generator: Generator) -> tuple[xr.Dataset, Settings]:
        height = raw["height"].transpose(*HEIGHT).values.copy()
        x, y = raw["x"].values, raw["y"].transpose(*HEIGHT[:3]).values
        for index in np.ndindex(height.shape[:2]):
            scan, along = height[index], np.nan_to_num(y[index])
            e = relative * (np.full(3, generator.normal()) if together else generator.normal(size=3) * (1, 0, 1))
            across = np.nan_to_num(np.gradient(scan, axis=1) / np.median(np.diff(x)))
            change = e[2] * np.nan_to_num(scan) - e[0] * x * across
            if e[1]:
                change -= e[1] * along[:, None] * np.nan_to_num(np.gradient(scan, axis=0) / _pitch(y[index]))
            scan += change.astype(np.float32)
        return raw.assign(height=(HEIGHT, height, raw["height"].attrs)), settings

    return Redraw(draw, own=True)


def _pocket(raw: xr.Dataset, settings: Settings) -> Redrawing:
    """Return the scans of a pocket with their sources: lines drawn with replacement, radius and centre."""
    radius = float(raw["pocket_radius_uncertainty"]) if "pocket_radius_uncertainty" in raw else RADIUS_UNCERTAINTY
    sources = {"lines": Redraw(_lines, own=True), "radius of the pocket": _shift("pocket_radius", radius)}
    if "pocket_centre_uncertainty" in raw:
        centre = np.asarray(raw["pocket_centre_uncertainty"].values, dtype=float)
        sources["centre of the pocket"] = _shift("pocket_centre", centre)
    return Redrawing(raw.load(), settings, sources)


def _lines(raw: xr.Dataset, settings: Settings, generator: Generator) -> tuple[xr.Dataset, Settings]:
    """Return every scan with the same number of its lines, drawn with replacement."""
    scans = []
    for number in range(raw.sizes["scan"]):
        drawn = np.sort(generator.integers(0, raw.sizes["profile"], raw.sizes["profile"]))
        scans.append(raw[["height", "stage"]].isel(scan=number, profile=drawn))
    chosen = xr.concat(scans, "scan")
    return raw.assign({name: chosen[name].transpose(*raw[name].dims) for name in ("height", "stage")}), settings


def _shift(name: str, uncertainty: Array | float) -> Redraw:
    def draw(raw: xr.Dataset, settings: Settings, generator: Generator) -> tuple[xr.Dataset, Settings]:
        value = raw[name]
        change = uncertainty * generator.normal(size=value.shape)
        return raw.assign({name: value.copy(data=value.values + change)}), settings

    return Redraw(draw, own=True)
