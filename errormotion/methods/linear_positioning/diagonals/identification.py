"""From displacements along diagonals to the figures of ISO 230-6, the errors along them, and squareness.

Each diagonal is evaluated like an axis: means, scatter, drift, figures with bias and uncertainty. The scale error of
the instrument is the same for all diagonals; errors of alignment and drift are independent.
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
from errormotion.methods.linear_positioning.identification import budget, standard
from errormotion.methods.linear_positioning.identification.identify import Evaluated, evaluate, stated_limits
from errormotion.methods.linear_positioning.identification.reading import labels, point_of
from errormotion.methods.linear_positioning.identification.standard import FIGURES
from errormotion.methods.linear_positioning.schema import APPROACHES, READINGS, SCHEMA, STOPS
from errormotion.methods.linear_positioning.settings import Settings, Side, TrialSettings
from errormotion.plugins import replaced

if TYPE_CHECKING:
    from errormotion.plugins import MethodInfo

DIMS = ("diagonal", "target")
MAX_OFF_LINE = 2e-6
"""Largest distance of a stop from the line of its diagonal, m: positions are commanded to 1 um."""
REFERENCE = "first stop of each diagonal, approached forward, at the temperature of the test"


@dataclass(frozen=True)
class EvaluatedDiagonal:
    """One diagonal with its evaluated readings.

    Attributes
    ----------
    name : str
    unit : ndarray, (3,)
    points : ndarray, (stop, 3)
        Commanded positions, m.
    distance : ndarray, (stop,)
        From the first stop, along the diagonal, m.
    evaluated : Evaluated
        As an axis, with the distance as its position.
    """

    name: str
    unit: Array
    points: Array
    distance: Array
    evaluated: Evaluated


def identify_diagonals(raw: xr.Dataset, settings: Settings, info: MethodInfo, *, planned: bool = False) -> xr.Dataset:
    """Return the errors along each diagonal over its stops, with figures and squareness.

    With ``planned``, scatter and drift are those of the settings.

    Raises
    ------
    MethodError
        Stops that are not on a line, diagonals of the same name, readings that do not determine the result.
    """
    notes: list[str] = []
    diagonals = evaluate_diagonals(raw, settings, notes, planned=planned)
    notes += budget.assumptions(raw, settings)
    sources, groups, effects = shared_sources(diagonals)
    value = np.array([each.evaluated.mean[0] for each in diagonals])
    own = np.array([each.evaluated.variance[0] for each in diagonals])
    sensitivity = np.array([np.tile([*each.unit, 0.0, 0.0, 0.0], (each.distance.size, 1)) for each in diagonals])
    square = squareness(diagonals, own, effects)
    if all(np.abs(each.unit).min() > 0.0 for each in diagonals):
        notes.append(
            "Body diagonals alone do not separate linear errors, straightness, angles and squareness of the axes: "
            "different combinations of errors result in the same four diagonals. Face diagonals show squareness."
        )
    errors = build_deviations(
        value,
        own + (effects**2).sum(axis=0),
        sensitivity,
        dims=DIMS,
        coords={
            "diagonal": ("diagonal", [each.name for each in diagonals], {"long_name": "diagonal of the volume"}),
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
        provenance=provenance.make(settings, raw, None, steps=[]),
        influence=effects,
        sources=sources,
        source_groups=groups,
        source_ids=certified(raw.attrs, {budget.LENGTH: ("tracker", "scale")} if budget.LENGTH in sources else {}),
        extras={} if isinstance(settings, TrialSettings) else _extras(diagonals, square, settings),
        start=start_of(raw),
        measured=raw.attrs,
    )
    return errors.assign_attrs(notes=notes or [""], **stated_limits(settings))


def evaluate_diagonals(
    raw: xr.Dataset, settings: Settings, notes: list[str], *, planned: bool = False
) -> list[EvaluatedDiagonal]:
    """Return every diagonal of a raw dataset that follows its schema; remarks are appended to ``notes``."""
    names = labels(raw, "diagonal")
    if not names or len(set(names)) < len(names):
        raise MethodError(f"diagonal: expected a different name for each diagonal; found {', '.join(names) or 'none'}")
    points = np.asarray(raw["stop_point"].transpose("diagonal", "stop", "direction").values, dtype=float)
    if "direction" in raw.coords:
        points = points[..., [labels(raw, "direction").index(axis) for axis in "xyz"]]
    readings = raw["diagonal_deviation"].transpose(*STOPS).values
    stated = [each for each in ("length_uncertainty", "alignment_uncertainty") if each in raw]
    axis = xr.Dataset(
        {
            "deviation": (READINGS, readings[:1]),
            "target_position": ("target", points[0, :, 0], {"units": "m"}),
            **{each: raw.variables[each] for each in stated},
        },
        {"freedom": ["EXX"], "approach": labels(raw, "approach")},
        {"schema": SCHEMA, "axis": "X"},
    )
    without_expansion = settings.model_copy(
        update={
            "machine": Side(),
            "workpiece": Side(expansion=0.0, expansion_uncertainty=0.0),
            "functional_point": (0.0, 0.0, 0.0),
        }
    )
    return [
        _evaluate(name, replaced(axis, {"deviation": read[None]}), stops, without_expansion, notes, planned)
        for name, read, stops in zip(names, readings, points, strict=True)
    ]


def _evaluate(
    name: str, axis: xr.Dataset, points: Array, settings: Settings, notes: list[str], planned: bool
) -> EvaluatedDiagonal:
    """Return a diagonal with its readings as those of an axis, whose positions follow from the stops (stop, 3)."""
    span = points[-1] - points[0]
    length = float(np.linalg.norm(span))
    if not (np.isfinite(points).all() and length > 0.0):
        raise MethodError(
            f"stop_point of {name}: expected positions on a line; found NaN, or a last stop that is the first one"
        )
    unit = span / length
    distance = (points - points[0]) @ unit
    off = np.linalg.norm(points - points[0] - distance[:, None] * unit, axis=1).max()
    if off > MAX_OFF_LINE or (np.diff(distance) <= 0.0).any():
        raise MethodError(
            f"stop_point of {name}: expected positions on a line, in order; found one {off * 1e6:.1f} um off the line, "
            "or out of order"
        )
    remarks: list[str] = []
    try:
        evaluated = evaluate(replaced(axis, {"target_position": distance}), settings, remarks, planned=planned)
    except MethodError as error:
        raise MethodError(f"Diagonal {name}: {error}") from None
    notes += [f"Diagonal {name}: {remark}" for remark in remarks if "readings are missing" in remark]
    return EvaluatedDiagonal(name, unit, points, distance, evaluated)


def shared_sources(diagonals: list[EvaluatedDiagonal]) -> tuple[list[str], list[str], Array]:
    """Return sources, their groups, and the effect of one standard uncertainty of each, (source, diagonal, target)."""
    shape = (len(diagonals), diagonals[0].distance.size)
    groups: dict[str, str] = {}
    effects: dict[str, Array] = {}
    for k, each in enumerate(diagonals):
        for source in each.evaluated.sources:
            own = f"{source.name.removesuffix(', EXX')}, {each.name}"
            name = source.name if source.name == budget.LENGTH else own  # the scale is common to all diagonals
            groups[name] = source.group
            effects.setdefault(name, np.zeros(shape))[k] = source.effect[0]
    return list(groups), list(groups.values()), np.array(list(effects.values())).reshape(-1, *shape)


@dataclass(frozen=True)
class Squareness:
    """Squareness of axes from pairs of face diagonals.

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


def squareness(diagonals: list[EvaluatedDiagonal], own: Array, effects: Array) -> Squareness:
    """Return each squareness that the diagonals determine.

    The slopes are those of least-squares lines through the mean bidirectional deviations.
    """
    names, weights = [], []
    for name, k, other, coefficient in squareness_of([each.unit for each in diagonals]):
        weight = np.zeros(own.shape)
        weight[k], weight[other] = _slope(diagonals[k]) / coefficient, -_slope(diagonals[other]) / coefficient
        names.append(name)
        weights.append(weight.ravel())
    W = np.array(weights).reshape(len(names), own.size)
    value = W @ np.nan_to_num([each.evaluated.mean[0] for each in diagonals]).ravel()
    influence = W @ np.nan_to_num(effects).reshape(len(effects), own.size).T
    return Squareness(names, value, (W * np.nan_to_num(own).ravel()) @ W.T + influence @ influence.T, influence)


def _slope(diagonal: EvaluatedDiagonal) -> Array:
    """Return the weights of the mean deviations in the slope of their least-squares line, (stop,), 1/m."""
    known = np.isfinite(diagonal.evaluated.mean[0])
    lever = np.where(known, diagonal.distance - diagonal.distance[known].mean(), 0.0)
    return np.asarray(lever / (lever @ lever))


def _extras(diagonals: list[EvaluatedDiagonal], square: Squareness, settings: Settings) -> dict[str, xr.DataArray]:
    figures = [each.evaluated.figures(0, settings.trials) for each in diagonals]
    statistics = [standard.statistics(each.evaluated.readings.x[0]) for each in diagonals]
    figure_dims, mean_dims = ("diagonal", "figure"), ("diagonal", "approach", "target")
    metre: Mapping[str, Any] = {"units": "m"}
    extras: dict[str, tuple[Any, Any, Mapping[str, Any]]] = {
        "figure_value": (figure_dims, [each.value for each in figures], {**metre, "long_name": "ISO 230-6"}),
        "figure_bias": (
            figure_dims,
            [each.bias for each in figures],
            {**metre, "long_name": "excess of figure_value by scatter"},
        ),
        "figure_u": (
            figure_dims,
            [each.u for each in figures],
            {**metre, "long_name": "of figure_value less figure_bias"},
        ),
        "deviations": (
            ("diagonal", "approach", "run", "target"),
            [each.evaluated.readings.x[0] for each in diagonals],
            {**metre, "long_name": "readings"},
        ),
        "unidirectional_mean": (mean_dims, [each.mean for each in statistics], metre),
        "unidirectional_s": (mean_dims, [each.s for each in statistics], metre),
        "distance": (DIMS, [each.distance for each in diagonals], {**metre, "long_name": "from the first stop"}),
        "stop_point": ((*DIMS, "direction"), [each.points for each in diagonals], metre),
        "squareness": ("squareness_of", square.value, {"units": "rad"}),
        "squareness_covariance": (("squareness_of", "squareness_of_"), square.covariance, {"units": "rad^2"}),
        "squareness_influence": (("squareness_of", "source"), square.influence, {"units": "rad"}),
    }
    return {
        name: xr.DataArray(np.asarray(values, dtype=float), dims=dims, attrs=dict(attrs))
        for name, (dims, values, attrs) in extras.items()
    }
