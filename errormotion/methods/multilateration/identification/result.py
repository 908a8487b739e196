"""The error dataset of an identification: uncertainties, errors of the axes, and additional results.

Datasets of very many targets are built and checked in blocks, since the checks copy the data several times.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.datasets.certificates import certified
from errormotion.datasets.timing import start_of
from errormotion.errors import MethodError
from errormotion.methods.multilateration.identification import uncertainty
from errormotion.methods.multilateration.identification.parameters import fit_machine, misfit_note
from errormotion.methods.multilateration.identification.state import State
from errormotion.methods.multilateration.identification.volume import parametric_extras, parametric_labels
from errormotion.methods.multilateration.network.diagnosis.notes import notes_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from errormotion.kinematics.volumes import AxisErrors
    from errormotion.methods.multilateration.identification.uncertainty import Parts

log = logging.getLogger(__name__)

DATUM = (
    "best rigid fit of all targets to their commanded positions; the six rigid motions of the whole, three "
    "translations and three rotations, are not determined"
)
CERTIFIED = {
    "air temperature": ("thermometer", "offset"),
    "air pressure": ("barometer", "offset"),
    "air humidity": ("hygrometer", "offset"),
    "wavelength": ("tracker", "wavelength"),
    "tracker scale": ("tracker", "scale"),
    "coefficient of expansion": ("scales", "coefficient of expansion"),
    **{f"scale temperature {axis}": ("scale_thermometer", f"offset at {axis}") for axis in "XYZ"},
}
"""Sources whose error is the same in all measurements with one certificate."""
BLOCK = 50_000
"""Number of targets that are checked at a time."""


def result(state: State, method: str, version: str) -> xr.Dataset:
    """Return the error dataset over ``target``; its notes are also logged."""
    data, network, notes = state.data, state.network, state.notes
    notes.extend(notes_of(network))
    parts = _uncertainty(state)
    error = network.target - data.nominal
    values = np.full((len(error), 6), np.nan)
    values[:, :3] = error
    extras, labels = _extras(state), _labels(state)
    if (axes := _axes(state, error, parts)) is not None:
        extras |= parametric_extras(axes)
        labels |= parametric_labels(axes)
    for note in notes:
        log.warning(note)
    position, reflector = data.position, data.reflector
    ds = build(
        values,
        parts.covariance,
        parts.influence,
        {
            "target": ("target", np.array(data.targets), {}),
            **labels,
            **{name: ("target", position[:, k], {"units": "m"}) for k, name in enumerate("xyz")},
        },
        extras,
        component="tool",
        machine=str(state.raw.attrs.get("machine", "unknown")),
        frame=str(state.raw.attrs.get("frame", "machine")),
        functional_point=reflector[0] if np.ptp(reflector, axis=0).max() == 0 else reflector.mean(axis=0),
        reference=DATUM,
        method=method,
        method_version=version,
        measured={**state.raw.attrs, **({"chain": state.settings.chain} if state.settings.chain else {})},
        start=start_of(state.raw),
        provenance=provenance.make(state.settings, state.raw, None, steps=_steps(state)),
        sources=parts.names,
        source_groups=parts.groups,
        source_ids=certified(state.raw.attrs, {name: CERTIFIED[name] for name in parts.names if name in CERTIFIED}),
    )
    return ds.assign_attrs(notes=notes or [""])


def _uncertainty(state: State) -> Parts:
    """Return the parts of the targets' uncertainty."""
    parts = uncertainty.parts(state.network, state.factor, state.scatter)
    if state.settings.together and state.machine.variance > 0:
        parts.own[:] += state.machine.variance * np.eye(3)
        parts.covariance[:, :3, :3] += state.machine.variance * np.eye(3)
    return parts


def _axes(state: State, error: Array, parts: Parts) -> AxisErrors | None:
    """Return the errors of the axes; if they are not determined, a note states the reason."""
    data, settings, notes = state.data, state.settings, state.notes
    if not settings.parametric:
        return None
    chain = settings.chain or state.raw.attrs.get("chain")
    if not isinstance(chain, str):
        notes.append("No errors of the axes: the chain of the machine is unknown (setting or attribute 'chain').")
        return None
    try:
        axes = fit_machine(
            chain,
            data.position,
            error,
            parts.own,
            parts.influence[..., :3],
            reflector=data.reflector,
            max_order=settings.max_order,
        )
    except MethodError as refusal:
        notes.append(f"No errors of the axes. {refusal}")
        return None
    notes.extend(misfit_note(axes, settings.max_order))
    if axes.undetermined:
        reasons = "; ".join(f"{name}: {each.reason}" for name, each in axes.undetermined.items())
        notes.append(f"Errors of the axes that these targets do not determine: {reasons}.")
    return axes


def _steps(state: State) -> list[str]:
    steps = ["Gauss-Newton of targets, stations and dead paths, targets eliminated"]
    if state.network.left_out:
        steps.append(f"{len(state.network.left_out)} readings excluded")
    if state.drift is not None and state.drift.correction.any():
        steps.append("drift subtracted from the readings")
    if state.settings.expansion is not None:
        steps.append(f"scales corrected to {state.settings.expansion.reference:g} degC")
    return [*steps, "free network on the commanded positions"]


def _labels(state: State) -> dict[str, Any]:
    """Return the coordinates of the variables by `_extras`."""
    labels = {
        "station": state.data.stations,
        "direction": list("xyz"),
        "direction_": list("xyz"),
        "cause": list(state.scatter.shares),
    }
    if state.drift is not None and state.drift.pairs:
        labels["drift_term"] = ["dead path", "x", "y", "z"]
    return {name: (name, values, {}) for name, values in labels.items()}


def _extras(state: State) -> dict[str, xr.DataArray]:
    data, network, f2 = state.data, state.network, state.factor**2

    def array(values: Any, dims: tuple[str, ...], unit: str, meaning: str = "") -> xr.DataArray:
        attrs = ({"units": unit} if unit else {}) | ({"long_name": meaning} if meaning else {})
        return xr.DataArray(values, dims=dims, attrs=attrs)

    left_out = np.zeros(data.displacement.shape, np.int8)
    for j, i in network.left_out:
        left_out[j, i] = 1
    left_out[:, list(network.undecided)] = 2
    dead_path_variance = np.diag(network.joint_covariance)[3::4]
    by_reading, vector = ("station", "target"), ("station", "direction")
    extras = {
        "target_nominal": array(data.nominal, ("target", "direction"), "m", "commanded position of the reflector"),
        "target_place": array(network.target, ("target", "direction"), "m", "estimated position of the reflector"),
        "station_place": array(network.station, vector, "m", "estimated position of the tracker"),
        "station_covariance": array(f2 * network.station_covariance, (*vector, "direction_"), "m^2"),
        "dead_path": array(network.dead_path, ("station",), "m"),
        "dead_path_u": array(np.sqrt(f2 * dead_path_variance), ("station",), "m"),
        "residual": array(network.residual, by_reading, "m", "reading minus model"),
        "redundancy": array(network.redundancy, by_reading, "1", "share of a reading's error that is in its residual"),
        "left_out": array(left_out, by_reading, "", "1: wrong; 2: target excluded, wrong reading not identified"),
        "condition": array(network.condition, (), "1", "of the stations' information, without motions of the whole"),
        "sigma0": array(network.sigma0, (), "1", "ratio of the scatter of the readings to the stated one"),
        "freedom": array(network.freedom, (), "", "readings minus unknowns"),
        "noise": array(state.factor / np.max(network.weight), (), "m", "of a reading, repeatability included"),
    }
    if data.station is not None:
        extras["station_nominal"] = array(data.station, vector, "m", "approximate position of the tracker")
    if state.drift is not None and state.drift.pairs:
        extras["drift_rate"] = array(state.drift.rate, ("station", "drift_term"), "m/s", "during each set-up")
    if state.machine.sources:
        extras["repeatability"] = array(state.machine.value, (), "m", "of the machine, each coordinate of each visit")
        extras["repeatability"].attrs["source"] = state.machine.source
        extras["repeatability_u"] = array(state.machine.uncertainty, (), "m")
    shares = state.scatter.shares
    extras["scatter_share"] = xr.DataArray(
        list(shares.values()), dims="cause",
        attrs={"units": "1", "long_name": "share of each cause in the variance of a reading"},
    )  # fmt: skip
    return extras


def build(
    values: Array, covariance: Array, influence: Array, coords: Mapping[str, Any], extras: Mapping[str, xr.DataArray],
    **further: Any,
) -> xr.Dataset:  # fmt: skip
    """Return the error dataset over ``target``; see `errormotion.datasets.build_errors`.

    Parameters
    ----------
    values, covariance, influence : ndarray (m, 6), (m, 6, 6), (source, m, 6)
        For many targets they become part of the dataset without a copy; unknown values are set to NaN in position.
    coords : mapping
        Name to (dims, array, attrs).
    extras : mapping of str to DataArray
    **further
        Further arguments of `build_errors`.

    Raises
    ------
    DatasetError
        Any violation of the schema.
    """
    m = len(values)
    if m <= BLOCK:
        return build_errors(
            values, covariance, influence=influence, dims=("target",), coords=coords, extras=extras, **further
        )
    pieces: list[xr.Dataset] = []
    for first in range(0, m, BLOCK):
        part = slice(first, min(first + BLOCK, m))
        piece = build_errors(
            values[part], covariance[part], influence=influence[:, part], dims=("target",),
            coords={name: (dims, array[part] if "target" in dims else array, attrs)
                    for name, (dims, array, attrs) in coords.items()},
            extras={name: array.isel(target=part) if "target" in array.dims else array
                    for name, array in extras.items()} if not pieces else None,
            **further,
        )  # fmt: skip
        covariance[part] = piece["covariance"].values
        influence[:, part] = piece["influence"].values
        pieces = pieces or [piece]
    piece = pieces[0]
    whole: dict[str, Any] = {"covariance": covariance, "influence": influence}
    whole |= {name: values[:, k] for k, name in enumerate(piece["dof"].values)}
    whole["target_index"] = np.arange(m)
    variables = {name: (piece[name].dims, array, piece[name].attrs) for name, array in whole.items()}
    without_target = {name: piece.coords[name] for name in piece.coords if "target" not in piece[name].dims}
    over_target = {
        name: (piece[name].dims, array, piece[name].attrs)
        for name, (dims, array, _) in coords.items() if "target" in dims
    }  # fmt: skip
    return xr.Dataset(variables, {**without_target, **over_target}, piece.attrs).assign(dict(extras))
