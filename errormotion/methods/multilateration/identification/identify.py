"""From displacements to the errors of every target, and to those of the axes."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from scipy import stats

from errormotion.arrays import Array
from errormotion.datasets import provenance
from errormotion.errors import MethodError
from errormotion.methods.multilateration.identification import assembly, repeatability, uncertainty
from errormotion.methods.multilateration.identification.drift import Drift, estimate_drift, places
from errormotion.methods.multilateration.identification.expansion import (
    Shared,
    air_scale,
    along_beams,
    expansion_sources,
    scale_strain,
)
from errormotion.methods.multilateration.identification.moving import find_move
from errormotion.methods.multilateration.identification.parameters import fit_machine
from errormotion.methods.multilateration.identification.reading import Readings, read, short
from errormotion.methods.multilateration.identification.volume import parametric_extras
from errormotion.methods.multilateration.identification.weakness import weak_targets
from errormotion.methods.multilateration.network.alternating import alternate
from errormotion.methods.multilateration.network.model import directions
from errormotion.methods.multilateration.network.solver import solve

if TYPE_CHECKING:
    from collections.abc import Sequence

    from errormotion.methods.multilateration.identification.repeatability import Repeatability
    from errormotion.methods.multilateration.identification.uncertainty import Parts, Scatter
    from errormotion.methods.multilateration.network.network import Network
    from errormotion.methods.multilateration.settings import Settings

    Array = Array

log = logging.getLogger(__name__)

FALSE_ALARM = 1e-3
"""Chance at which sound readings are called noisier than stated."""
LEAST = 10
"""Targets that four stations need."""
MANY_WRONG = 0.05
"""Share of readings left out above which a cause is looked for."""
DATUM = (
    "best rigid fit of all targets to their commanded places; six motions of the whole, three shifts and three "
    "rotations, are not seen"
)


@dataclass(frozen=True)
class Solution:
    """The network, what was taken off the readings, and how uncertain that is."""

    network: Network
    factor: float
    corrected: Array
    drift: Drift
    sources: list[Shared]
    scale: dict[str, float]
    scatter: Scatter
    machine: Repeatability


def identify_targets(raw: xr.Dataset, settings: Settings, method: str, version: str) -> xr.Dataset:
    """Return an error dataset of component ``tool`` over ``target``: estimated places minus commanded ones.

    Raises
    ------
    MethodError
        Readings that do not determine the network, contradict one another, or are in another unit.
    """
    notes: list[str] = []
    data = read(raw, notes)
    found = _solved(raw, data, settings, notes)
    network = found.network
    notes.extend(network.notes)
    made = _uncertainty(found, settings)
    error = network.target - data.nominal
    values = np.full((len(error), 6), np.nan)
    values[:, :3] = error
    extras = _extras(data, found)
    extras |= _alternated(data, found, notes) if settings.alternating else {}
    extras |= _axes(raw, data, settings, error, made, notes)
    covariance = made.covariance(network.target_covariance, found.factor**2)
    if settings.together and found.machine.variance > 0:
        covariance[:, :3, :3] += found.machine.variance * np.eye(3)
    for note in notes:
        log.warning(note)
    position = data.position
    ds = assembly.build(
        values,
        covariance,
        made.influence,
        {
            "target": ("target", np.array(data.targets), {}),
            "direction": ("direction", list("xyz"), {}),
            **{name: ("target", position[:, k], {"units": "m"}) for k, name in enumerate("xyz")},
        },
        extras,
        component="tool",
        machine=str(raw.attrs.get("machine", "unknown")),
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=data.reflector[0]
        if np.ptp(data.reflector, axis=0).max() == 0
        else data.reflector.mean(axis=0),
        reference=DATUM,
        method=method,
        method_version=version,
        provenance=provenance.make(settings, raw, None, steps=_steps(found, settings)),
        sources=made.names,
        source_groups=made.groups,
    )
    return ds.assign_attrs(notes=notes or [""])


def _solved(raw: xr.Dataset, data: Readings, settings: Settings, notes: list[str]) -> Solution:
    """Solve the network, correct the readings for what its directions are needed for, and solve it again."""
    times, scale = air_scale(raw, settings.air, notes)
    d = data.displacement * times
    machine = repeatability.stated(settings.repeatability, settings.repeatability_uncertainty)
    noise = _noise(data, machine, settings)
    _leave_out_weak(d, data, noise, settings, notes)
    network = _network(d, data, noise, settings)
    correction: Array | None = None
    sources: list[Shared] = []
    e = None
    if _drifts(data, settings, notes):
        e = _beams(network, data)
        drift, machine = _drift(d, e, data, machine, settings, notes)
        if drift.correction.any():
            correction = drift.correction
    else:
        drift = Drift(np.full((len(d), 4), np.nan), np.zeros((len(d), 1)), [], float("nan"), 0)
    if settings.expansion is not None:
        e = _beams(network, data) if e is None else e
        warmer, strain = scale_strain(raw, settings.expansion)
        stretch = along_beams(strain, data.position - data.position.mean(axis=0), e)
        correction = stretch if correction is None else correction + stretch
        sources += expansion_sources(warmer, data.position, e, settings.expansion)
    corrected = d if correction is None else d - correction
    now = _noise(data, machine, settings)
    if correction is not None or now[0, 0] != noise[0, 0]:
        network = _network(corrected, data, now, settings, drift.sources)
    if settings.together:
        machine = repeatability.from_places(machine, network, places(data.nominal), 1.0, notes)
    factor, scatter, machine = _noise_factor(network, corrected, data, machine, settings, notes)
    _remark_on_stations(network, data, settings, notes)
    if settings.scale_uncertainty > 0:
        scale["tracker scale"] = settings.scale_uncertainty
    if not network.converged:
        notes.append(f"The network has not settled after {network.iterations} passes; its figures are rough.")
    return Solution(network, factor, corrected, drift, sources, scale, scatter, machine)


def _noise(data: Readings, machine: Repeatability, settings: Settings) -> Array:
    """Return the standard deviation of every reading, (n, m), m: one number, seen as many."""
    variance = 0.0 if settings.together else machine.variance
    return np.broadcast_to(np.sqrt(data.noise**2 + variance), data.displacement.shape)


def _beams(network: Network, data: Readings) -> Array:
    return directions(np.where(np.isnan(network.target), data.nominal, network.target), network.stations)


def _leave_out_weak(d: Array, data: Readings, noise: Array, settings: Settings, notes: list[str]) -> None:
    """Take the readings of targets that they hardly fix out of ``d``."""
    weak = weak_targets(d, data.nominal, data.station if settings.start == "nominal" else None, noise)
    if weak.any():
        d[:, weak] = np.nan
        names = short([name for name, lost in zip(data.targets, weak, strict=True) if lost])
        notes.append(
            f"{int(weak.sum())} of {len(weak)} targets are hardly fixed by their readings, since what they are seen "
            f"from lies nearly in one plane with them; they are not known: {names}."
        )


def _network(d: Array, data: Readings, noise: Array, settings: Settings, sources: Sequence[Shared] = ()) -> Network:
    """Solve; where readings fit no network, say whether a station moved.

    ``sources`` are what is not known of the drift: further parameters, each known to 1 beforehand.
    """
    rough = data.station if settings.start == "nominal" else None
    extra = np.nan_to_num([source.change for source in sources]) if sources else None
    try:
        return solve(
            d, data.nominal, rough, noise=noise, robust=settings.robust, extra=extra,
            extra_prior=None if extra is None else np.ones(len(extra)),
        )  # fmt: skip
    except MethodError as error:
        if _solvable(d, data, rough, noise):
            _refuse_move(d, data, rough, noise, error)
        raise


def _solvable(d: Array, data: Readings, rough: Array | None, noise: Array) -> bool:
    """Whether the readings give a network at all, however badly they fit."""
    try:
        solve(d, data.nominal, rough, noise=noise, robust=False)
    except MethodError:
        return False
    return True


def _drifts(data: Readings, settings: Settings, notes: list[str]) -> bool:
    """Return whether drift and repeatability are looked for in returns."""
    if settings.drift == "none" or settings.together:
        return False
    if not data.timed:
        notes.append("The times of the readings are not in the data (reading_time): drift is not seen.")
    return data.timed


def _drift(
    d: Array, e: Array, data: Readings, machine: Repeatability, settings: Settings, notes: list[str]
) -> tuple[Drift, Repeatability]:
    """Return drift and repeatability, each estimated with the other known."""
    place, stated = places(data.nominal), machine
    certain = bool(stated.source) and stated.spread == 0
    noise = _noise(data, stated, settings)
    first: list[str] = []
    drift = estimate_drift(d, data.time, place, e, noise, data.stations, first, certain=certain)
    machine = repeatability.from_returns(stated, drift, data.noise, float(noise[0, 0]), [])
    if not drift.freedom or machine == stated:
        notes.extend(first)
        return drift, repeatability.from_returns(stated, drift, data.noise, float(noise[0, 0]), notes)
    noise = _noise(data, machine, settings)
    drift = estimate_drift(d, data.time, place, e, noise, data.stations, notes, certain=certain)
    return drift, repeatability.from_returns(stated, drift, data.noise, float(noise[0, 0]), notes)


def _noise_factor(
    network: Network, d: Array, data: Readings, machine: Repeatability, settings: Settings, notes: list[str]
) -> tuple[float, Scatter, Repeatability]:
    """Return by how much the noise is raised, its parts, the repeatability; refuse readings of a station that moved."""
    freedom, wrong = network.freedom, len(network.left_out) + 4 * len(network.undecided)
    told = 0.0 if settings.together else machine.spread / (data.noise**2 + machine.variance)
    excess = freedom > 0 and repeatability.beyond(network, told)
    if excess or wrong > MANY_WRONG * np.isfinite(d).sum():
        _refuse_move(d, data, network.station, _noise(data, machine, settings), None)
    raised = settings.noise == "auto"
    found = repeatability.explained(machine, network, data.noise, raise_it=raised, together=settings.together)
    if excess:
        what = "the uncertainties are raised to match" if raised else "the stated noise was kept (noise = stated)"
        cause = "" if settings.together or machine.source else " Perhaps the machine repeats worse (repeatability)."
        notes.append(f"The readings scatter {network.sigma0:.3g} times as much as stated; {what}.{cause}")
    elif freedom > 0 and told == 0 and network.sigma0**2 * freedom < stats.chi2.ppf(FALSE_ALARM, freedom):
        notes.append(
            f"The readings scatter only {network.sigma0:.3g} times as much as stated; the stated noise was kept."
        )
    if "returns" in found[2].source and found[2].variance > 2 * found[2].spread:
        notes.append(
            f"The machine comes back to within {found[2].value * 1e6:.2g} um (standard deviation of a coordinate, "
            f"known to {found[2].uncertainty * 1e6:.1g} um), by {found[2].source}."
        )
    return found


def _remark_on_stations(network: Network, data: Readings, settings: Settings, notes: list[str]) -> None:
    if data.station is None or any("swapped" in note for note in network.notes):
        return
    off = np.linalg.norm(network.station - data.station, axis=1)
    for j in np.flatnonzero(off > settings.station_tolerance):
        notes.append(
            f"Station {data.stations[j]} was found {off[j] * 1e3:.3g} mm from its rough place. Is that place right, "
            "and do the targets have the coordinates of the machine?"
        )


def _refuse_move(d: Array, data: Readings, rough: Array | None, noise: Array, error: Exception | None) -> None:
    move = find_move(d, data.nominal, rough, noise, data.time)
    if move is None:
        return
    name, target = data.stations[move.station], data.targets[move.target]
    raise MethodError(
        f"Expected every station to stay where it is; the readings say that station {name} stood elsewhere from target "
        f"{target} on, by about {move.distance * 1e3:.3g} mm: taken as two stations the readings scatter "
        f"{move.sigma0:.3g} times their noise, as one {move.sigma0_before:.3g} times. Measure this set-up again, or "
        "give its readings from there on as a further station. A set-up that drifts looks alike: return to some "
        "targets within it."
    ) from error


def _uncertainty(found: Solution, settings: Settings) -> Parts:
    """Return what the targets' uncertainty is made of."""
    scales = [
        (name, "scale of the tracker" if name == "tracker scale" else "refraction", relative)
        for name, relative in found.scale.items()
        if relative > 0
    ]
    made = uncertainty.parts(
        found.network, found.factor, found.scatter, scales, found.corrected if scales else np.empty(0), found.sources
    )
    if settings.together and found.machine.variance > 0:
        made.own[:] += found.machine.variance * np.eye(3)
    return made


def _axes(
    raw: xr.Dataset, data: Readings, settings: Settings, error: Array, made: Parts, notes: list[str]
) -> dict[str, xr.DataArray]:
    """Return the errors of the axes as extra results; where there are none, a note says why."""
    if not settings.parametric:
        return {}
    chain = settings.chain or raw.attrs.get("chain")
    if not isinstance(chain, str):
        notes.append("No errors of the axes: the chain of the machine is not known (setting or attribute 'chain').")
        return {}
    try:
        axes = fit_machine(
            chain,
            data.position,
            error,
            made.own,
            made.influence[..., :3],
            reflector=data.reflector,
            max_order=settings.max_order,
        )
    except MethodError as refusal:
        notes.append(f"No errors of the axes. {refusal}")
        return {}
    notes.extend(axes.notes)
    if axes.unseen:
        told = "; ".join(f"{name}: {why}" for name, why in axes.unseen.items())
        notes.append(f"Errors of the axes that these targets do not determine: {told}.")
    return parametric_extras(axes)


def _alternated(data: Readings, found: Solution, notes: list[str]) -> dict[str, xr.DataArray]:
    """Return what the published scheme makes of the same readings, where it can: it needs every reading."""
    whole = np.isfinite(found.corrected).all(axis=0)
    if np.count_nonzero(whole) < LEAST:
        notes.append(f"The alternating scheme was left out: fewer than {LEAST} targets have all readings.")
        return {}
    begin = found.network.station if data.station is None else data.station
    other = alternate(found.corrected[:, whole], data.nominal[whole], begin)
    place = np.full(data.nominal.shape, np.nan)
    place[whole] = other.target
    notes.append(
        f"The alternating scheme {'stopped' if other.converged else 'was given up'} after {other.iterations} turns, "
        f"where the joint solution took {found.network.iterations}; a target may still go about "
        f"{other.left * 1e6:.2g} um."
    )
    return {
        "alternating_place": xr.DataArray(place, dims=("target", "direction"), attrs={"units": "m"}),
        "alternating_iterations": xr.DataArray(other.iterations),
        "alternating_left": xr.DataArray(other.left, attrs={"units": "m"}),
    }


def _steps(found: Solution, settings: Settings) -> list[str]:
    steps = ["Gauss-Newton of targets, stations and dead paths, targets eliminated"]
    if found.network.left_out:
        steps.append(f"{len(found.network.left_out)} readings left out")
    if found.drift.correction.any():
        steps.append("drift taken off the readings")
    if settings.expansion is not None:
        steps.append(f"scales brought to {settings.expansion.reference:g} degC")
    return [*steps, "free network on the commanded places"]


def _extras(data: Readings, found: Solution) -> dict[str, xr.DataArray]:
    network, f2 = found.network, found.factor**2
    n = len(data.stations)
    coords: dict[str, Any] = {
        "station": data.stations,
        "target": data.targets,
        "direction": list("xyz"),
        "direction_": list("xyz"),
        "drift_term": ["dead path", "x", "y", "z"],
    }

    def array(values: Any, dims: tuple[str, ...], unit: str, meaning: str = "") -> xr.DataArray:
        attrs = ({"units": unit} if unit else {}) | ({"long_name": meaning} if meaning else {})
        return xr.DataArray(values, {d: coords[d] for d in dims if d in coords}, dims, attrs=attrs)

    left_out = np.zeros(data.displacement.shape, np.int8)
    for j, i in network.left_out:
        left_out[j, i] = 1
    left_out[:, list(network.undecided)] = 2
    dead_path_variance = np.diag(network.joint_covariance)[3 : 4 * n : 4]
    by_reading, vector = ("station", "target"), ("station", "direction")
    extras = {
        "target_nominal": array(data.nominal, ("target", "direction"), "m", "commanded place of the reflector"),
        "target_place": array(network.target, ("target", "direction"), "m", "estimated place of the reflector"),
        "station_place": array(network.station, vector, "m", "estimated place of the tracker"),
        "station_covariance": array(f2 * network.station_covariance, (*vector, "direction_"), "m^2"),
        "dead_path": array(network.dead_path, ("station",), "m"),
        "dead_path_u": array(np.sqrt(f2 * dead_path_variance), ("station",), "m"),
        "residual": array(network.residual, by_reading, "m", "reading minus model"),
        "redundancy": array(network.redundancy, by_reading, "1", "share of a reading's error that its residual shows"),
        "left_out": array(left_out, by_reading, "", "1: wrong; 2: target given up, nothing tells which is wrong"),
        "iterations": array(network.iterations, (), ""),
        "condition": array(network.condition, (), "1", "of what distances can determine"),
        "sigma0": array(network.sigma0, (), "1", "scatter of the readings over what was stated"),
        "freedom": array(network.freedom, (), "", "readings less unknowns"),
        "noise": array(found.factor / np.max(network.weight), (), "m", "of a reading, repeatability included"),
    }
    if data.station is not None:
        extras["station_nominal"] = array(data.station, vector, "m", "rough place of the tracker")
    if found.drift.pairs:
        extras["drift_rate"] = array(found.drift.rate, ("station", "drift_term"), "m/s", "during each set-up")
    if found.machine.source:
        extras["repeatability"] = array(found.machine.value, (), "m", "of the machine, each coordinate of each visit")
        extras["repeatability"].attrs["source"] = found.machine.source
        extras["repeatability_u"] = array(found.machine.uncertainty, (), "m")
    shares = found.scatter.shares
    extras["scatter_share"] = xr.DataArray(
        list(shares.values()), {"cause": list(shares)}, "cause",
        attrs={"units": "1", "long_name": "of each cause in the variance of a reading"},
    )  # fmt: skip
    return extras
