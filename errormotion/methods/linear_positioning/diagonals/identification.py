"""From displacements along diagonals to the figures of ISO 230-6, the errors along them, and squareness.

Each diagonal is evaluated as an axis is: means, scatter, drift, figures with bias and uncertainty. The scale of the
instrument is one draw for all diagonals; the alignment and the drift are new at each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import build_deviations, provenance
from errormotion.datasets.certificates import certified
from errormotion.datasets.timing import start_of
from errormotion.errors import MethodError
from errormotion.methods.linear_positioning.diagonals.lines import squareness_of
from errormotion.methods.linear_positioning.identification import extremes, standard
from errormotion.methods.linear_positioning.identification.identify import LIMITS, Evaluated, evaluate
from errormotion.methods.linear_positioning.identification.reading import point_of
from errormotion.methods.linear_positioning.identification.standard import FIGURES
from errormotion.methods.linear_positioning.schema import APPROACHES, READINGS, SCHEMA, STOPS
from errormotion.methods.linear_positioning.settings import Settings, Side

if TYPE_CHECKING:
    from errormotion.plugins import MethodInfo

DIMS = ("diagonal", "target")
STRAIGHT = 2e-6
"""Largest distance of a stop from the line of its diagonal, m: positions are commanded to 1 um."""
SHARED = "scale of the lengths"
"""The source that is one draw for all diagonals."""
REFERENCE = "first stop of each diagonal, approached forward, at the temperature of the test"


@dataclass(frozen=True)
class Measured:
    """One diagonal.

    Attributes
    ----------
    name : str
    unit : ndarray, (3,)
    points : ndarray, (stop, 3)
        Commanded positions, m.
    distance : ndarray, (stop,)
        From the first stop, along the diagonal, m.
    found : Evaluated
        Its readings, as those of an axis over the distance.
    """

    name: str
    unit: Array
    points: Array
    distance: Array
    found: Evaluated


def identify_diagonals(raw: xr.Dataset, settings: Settings, info: MethodInfo, *, planned: bool = False) -> xr.Dataset:
    """Return the errors along each diagonal over its stops, with figures and squareness.

    ``planned`` takes scatter and drift from the settings.

    Raises
    ------
    MethodError
        Stops that are no line, diagonals of one name, readings that do not determine the result.
    """
    notes: list[str] = []
    measured = measure(raw, settings, notes, planned=planned)
    sources, groups, effects = shared(measured)
    value = np.array([each.found.mean[0] for each in measured])
    own = np.array([each.found.variance[0] for each in measured])
    sensitivity = np.array([np.tile([*each.unit, 0.0, 0.0, 0.0], (each.distance.size, 1)) for each in measured])
    square = squareness(measured, own, effects)
    if all(np.abs(each.unit).min() > 0.0 for each in measured):
        notes.append(
            "Body diagonals alone do not separate linear errors, straightness, angles and squareness of the axes: "
            "different errors give the same four diagonals. Face diagonals show squareness."
        )
    errors = build_deviations(
        value,
        own + (effects**2).sum(axis=0),
        sensitivity,
        dims=DIMS,
        coords={
            "diagonal": ("diagonal", [each.name for each in measured], {"long_name": "diagonal of the volume"}),
            "approach": list(APPROACHES),
            "figure": list(FIGURES),
            "direction": list("xyz"),
            "squareness_of": square.names,
            "squareness_of_": square.names,
        },
        component="tool",
        machine=str(raw.attrs.get("machine", "unknown")),
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=point_of(raw, settings, notes),
        reference=REFERENCE,
        method=info.id,
        method_version=info.version,
        provenance=provenance.make(settings, raw, None, steps=["mean cosine error of the alignment corrected"]),
        influence=effects,
        sources=sources,
        source_groups=groups,
        source_ids=certified(raw.attrs, {SHARED: ("tracker", "scale")} if SHARED in sources else {}),
        extras=_extras(measured, square, settings),
        start=start_of(raw),
        measured=raw.attrs,
    )
    stated = {name: getattr(settings, name) for name in LIMITS.values() if getattr(settings, name) is not None}
    return errors.assign_attrs(notes=notes or [""], **stated)


def measure(raw: xr.Dataset, settings: Settings, notes: list[str], *, planned: bool = False) -> list[Measured]:
    """Return every diagonal of a raw dataset that follows its schema; remarks go to ``notes``."""
    names = [_text(label) for label in raw["diagonal"].values] if "diagonal" in raw.coords else []
    if not names or len(set(names)) < len(names):
        raise MethodError(f"diagonal: expected a name of each diagonal; found {', '.join(names) or 'none'}")
    points = np.asarray(raw["stop_point"].transpose("diagonal", "stop", "direction").values, dtype=float)
    if "direction" in raw.coords:
        points = points[..., [[_text(label) for label in raw["direction"].values].index(axis) for axis in "xyz"]]
    return [
        _one(name, raw.isel(diagonal=k, drop=True), points[k], settings, notes, planned) for k, name in enumerate(names)
    ]


def _one(name: str, raw: xr.Dataset, points: Array, settings: Settings, notes: list[str], planned: bool) -> Measured:
    way = points[-1] - points[0]
    length = float(np.linalg.norm(way))
    if not (np.isfinite(points).all() and length > 0.0):
        raise MethodError(
            f"stop_point of {name}: expected a line of positions; found NaN, or the first stop at its end"
        )
    unit = way / length
    distance = (points - points[0]) @ unit
    off = np.linalg.norm(points - points[0] - distance[:, None] * unit, axis=1).max()
    if off > STRAIGHT or (np.diff(distance) <= 0.0).any():
        raise MethodError(
            f"stop_point of {name}: expected positions one behind the other on a line; found one {off * 1e6:.1f} um "
            "beside it, or out of order"
        )
    stated = [each for each in ("length_uncertainty", "alignment_uncertainty") if each in raw]
    axis = xr.Dataset(
        {
            "deviation": (READINGS, raw["diagonal_deviation"].transpose(*STOPS[1:]).values[None]),
            "target_position": ("target", distance, {"units": "m"}),
            **{each: raw[each] for each in stated},
        },
        {"freedom": ["EXX"], "approach": [_text(label) for label in raw["approach"].values]},
        {"schema": SCHEMA, "axis": "X"},
    )
    bare = settings.model_copy(
        update={
            "machine": Side(),
            "workpiece": Side(expansion=0.0, expansion_uncertainty=0.0),
            "functional_point": (0.0, 0.0, 0.0),
        }
    )
    remarks: list[str] = []
    try:
        found = evaluate(axis, bare, remarks, planned=planned)
    except MethodError as error:
        raise MethodError(f"Diagonal {name}: {error}") from None
    notes += [f"Diagonal {name}: {remark}" for remark in remarks if "readings are missing" in remark]
    return Measured(name, unit, points, distance, found)


def _text(label: object) -> str:
    return label.decode() if isinstance(label, bytes) else str(label)


def shared(measured: list[Measured]) -> tuple[list[str], list[str], Array]:
    """Return sources, their groups, and the effect of one standard uncertainty of each, (source, diagonal, target)."""
    shape = (len(measured), measured[0].distance.size)
    groups: dict[str, str] = {}
    effects: dict[str, Array] = {}
    for k, each in enumerate(measured):
        for source in each.found.sources:
            name = source.name if source.name == SHARED else f"{source.name.removesuffix(', EXX')}, {each.name}"
            groups[name] = source.group
            effects.setdefault(name, np.zeros(shape))[k] = source.effect[0]
    return list(groups), list(groups.values()), np.array(list(effects.values())).reshape(-1, *shape)


@dataclass(frozen=True)
class Squareness:
    """What pairs of face diagonals show.

    Attributes
    ----------
    names : list of str
        ISO 230-1.
    value : ndarray, (name,)
        rad.
    covariance : ndarray, (name, name)
    influence : ndarray, (name, source)
        Effect of one standard uncertainty of each source, rad.
    """

    names: list[str]
    value: Array
    covariance: Array
    influence: Array


def squareness(measured: list[Measured], own: Array, effects: Array) -> Squareness:
    """Return each squareness that the diagonals show.

    The slopes are those of least-squares lines through the mean bidirectional deviations.
    """
    names, weights = [], []
    for name, k, other, coefficient in squareness_of([each.unit for each in measured]):
        weight = np.zeros(own.shape)
        weight[k], weight[other] = _slope(measured[k]) / coefficient, -_slope(measured[other]) / coefficient
        names.append(name)
        weights.append(weight.ravel())
    W = np.array(weights).reshape(len(names), own.size)
    value = W @ np.nan_to_num([each.found.mean[0] for each in measured]).ravel()
    influence = W @ np.nan_to_num(effects).reshape(len(effects), own.size).T
    return Squareness(names, value, (W * np.nan_to_num(own).ravel()) @ W.T + influence @ influence.T, influence)


def _slope(each: Measured) -> Array:
    """Return the weights of the mean deviations in the slope of their least-squares line, (stop,), 1/m."""
    known = np.isfinite(each.found.mean[0])
    lever = np.where(known, each.distance - each.distance[known].mean(), 0.0)
    return np.asarray(lever / (lever @ lever))


def _extras(measured: list[Measured], square: Squareness, settings: Settings) -> dict[str, xr.DataArray]:
    figures = [
        extremes.figures(
            each.found.readings.x[0],
            each.found.spreads[0],
            np.array([source.effect[0] for source in each.found.systematic]).reshape(-1, each.distance.size),
            0.0,
            straight=False,
            trials=settings.trials,
        )
        for each in measured
    ]
    stated = [standard.statistics(each.found.readings.x[0]) for each in measured]
    over, of_mean = ("diagonal", "figure"), ("diagonal", "approach", "target")
    metre: Mapping[str, Any] = {"units": "m"}
    found: dict[str, tuple[Any, Any, Mapping[str, Any]]] = {
        "figure_value": (over, [each.value for each in figures], {**metre, "long_name": "ISO 230-6"}),
        "figure_bias": (
            over,
            [each.bias for each in figures],
            {**metre, "long_name": "excess of figure_value by scatter"},
        ),
        "figure_u": (over, [each.u for each in figures], {**metre, "long_name": "of figure_value less figure_bias"}),
        "deviations": (
            ("diagonal", "approach", "run", "target"),
            [each.found.readings.x[0] for each in measured],
            {**metre, "long_name": "readings, mean cosine error corrected"},
        ),
        "unidirectional_mean": (of_mean, [each.mean for each in stated], metre),
        "unidirectional_s": (of_mean, [each.s for each in stated], metre),
        "distance": (DIMS, [each.distance for each in measured], {**metre, "long_name": "from the first stop"}),
        "stop_point": ((*DIMS, "direction"), [each.points for each in measured], metre),
        "squareness": ("squareness_of", square.value, {"units": "rad"}),
        "squareness_covariance": (("squareness_of", "squareness_of_"), square.covariance, {"units": "rad^2"}),
        "squareness_influence": (("squareness_of", "source"), square.influence, {"units": "rad"}),
    }
    return {
        name: xr.DataArray(np.asarray(values, dtype=float), dims=dims, attrs=dict(attrs))
        for name, (dims, values, attrs) in found.items()
    }
