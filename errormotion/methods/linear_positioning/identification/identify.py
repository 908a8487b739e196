"""From deviations at targets to the error dataset of an axis over ``position``, and to its figures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.datasets import build_errors, provenance
from errormotion.datasets.certificates import certified
from errormotion.datasets.timing import start_of
from errormotion.kinematics.iso import direction_of, iso_names
from errormotion.methods.linear_positioning.identification import budget, extremes, standard
from errormotion.methods.linear_positioning.identification.expansion import Shared, expansion
from errormotion.methods.linear_positioning.identification.reading import Readings, per_freedom, read
from errormotion.methods.linear_positioning.identification.scatter import Scatter, scatter
from errormotion.methods.linear_positioning.identification.standard import FIGURES, MEANINGS
from errormotion.methods.linear_positioning.schema import APPROACHES
from errormotion.methods.linear_positioning.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Mapping

    from errormotion.plugins import MethodInfo

LENGTHS = ("EX", "EY", "EZ")
LIMITS = {"A": "accuracy_limit", "R": "repeatability_limit", "B": "reversal_limit"}
ONE_VARIANCE = {True: "one variance for all targets", False: "a variance for each target"}


@dataclass(frozen=True)
class Evaluated:
    """Everything that a result is made of.

    Attributes
    ----------
    readings : Readings
        ``x`` corrected for expansion and alignment.
    mean : ndarray, (freedom, target)
        Mean bidirectional deviations; a straightness less the line through its ends.
    variance : ndarray, (freedom, target)
        What is independent from target to target.
    spreads : list of Scatter
    sources, systematic : list of Shared
        All sources, and those that do not come from the scatter of the readings.
    at_target : ndarray, (freedom,)
        Standard uncertainty that is independent from target to target, of the instrument.
    reference : str
    """

    readings: Readings
    mean: Array
    variance: Array
    spreads: list[Scatter]
    sources: list[Shared]
    systematic: list[Shared]
    at_target: Array
    reference: str

    def straight(self, k: int) -> bool:
        """Return whether a freedom is a straightness, whose line is that of the instrument."""
        name = self.readings.freedoms[k]
        return name in LENGTHS and name != self.readings.along


def identify(raw: xr.Dataset, settings: Settings, info: MethodInfo) -> xr.Dataset:
    """Return the errors of the axis over ``position``, with the figures of ISO 230-2.

    Raises
    ------
    MethodError
        The data do not determine the result.
    """
    notes: list[str] = []
    found = evaluate(raw, settings, notes)
    ds = build(found, raw, info, provenance.make(settings, raw, None, steps=_steps(found)), _extras(found, settings))
    stated = {name: getattr(settings, name) for name in LIMITS.values() if getattr(settings, name) is not None}
    return ds.assign_attrs(notes=notes or [""], **stated)


def build(
    found: Evaluated,
    raw: xr.Dataset,
    info: MethodInfo,
    origin: Mapping[str, Any],
    extras: Mapping[str, xr.DataArray],
) -> xr.Dataset:
    """Return the error dataset of what was evaluated; ``origin`` is its provenance."""
    readings = found.readings
    names = [source.name for source in found.sources]
    m = readings.position.size
    values, influence = np.full((m, 6), np.nan), np.zeros((len(names), m, 6))
    own = np.zeros((m, 6))
    for k, column in enumerate(readings.columns):
        values[:, column], own[:, column] = found.mean[k], found.variance[k]
        for s, source in enumerate(found.sources):
            influence[s, :, column] = source.effect[k]
    covariance = np.einsum("smi,smj->mij", influence, influence)
    covariance[:, range(6), range(6)] += own
    axis = readings.axis
    return build_errors(
        values,
        covariance,
        dims=("position",),
        coords={
            "xyz"[direction_of(axis)]: ("position", readings.position, {"units": "m"}),
            "approach": list(APPROACHES),
            "freedom": [iso_names(axis)[name] for name in readings.freedoms],
            "figure": list(FIGURES),
        },
        component=axis,
        machine=str(raw.attrs.get("machine", "unknown")),
        frame=str(raw.attrs.get("frame", "machine")),
        functional_point=readings.point,
        reference=found.reference,
        method=info.id,
        method_version=info.version,
        provenance=origin,
        influence=influence,
        sources=names,
        source_groups=[source.group for source in found.sources],
        source_ids=_identities(raw, axis, names),
        extras=extras,
        start=start_of(raw),
        measured=raw.attrs,
    )


def evaluate(raw: xr.Dataset, settings: Settings, notes: list[str], *, planned: bool = False) -> Evaluated:
    """Return means, variances and sources of a raw dataset that follows its schema; remarks go to ``notes``.

    ``planned`` takes scatter and drift from the settings, for every freedom.
    """
    recorded = read(raw, settings, notes)
    warm = expansion(raw, recorded, settings, notes)
    x = recorded.x.copy()
    if recorded.along in recorded.freedoms:
        bias = budget.alignment_bias(raw, recorded, settings)
        x[recorded.freedoms.index(recorded.along)] -= warm.along + bias
    readings = replace(recorded, x=x)
    limits = settings.uncertainty
    drift = None if limits.drift is None else limits.drift / np.sqrt(12.0)
    spreads = []
    for k, name in enumerate(readings.freedoms):
        stated = planned or name == readings.along
        spreads.append(
            scatter(
                x[k],
                readings.position,
                kind="stated" if planned else settings.scatter,
                drift=drift if stated else None,
                stated=limits.scatter if stated else None,
            )
        )
    mean = np.array([_bidirectional(each) for each in x])
    variance = budget.independent(raw, readings, spreads)
    systematic = [*budget.instrument_sources(raw, readings, settings, mean), *warm.sources]
    sources = [*budget.drift_sources(readings, spreads), *systematic]
    at_target = per_freedom(raw, "target_uncertainty", len(spreads))
    temperature = f"{settings.reference_temperature:g} degC" if warm.complete else "the temperature of the test"
    found = Evaluated(
        readings=readings,
        mean=mean,
        variance=variance,
        spreads=spreads,
        sources=sources,
        systematic=systematic,
        at_target=at_target,
        reference=f"zero of the instrument with the axis at {recorded.zero * 1e3:.6g} mm, at {temperature}",
    )
    if any(found.straight(k) for k in range(len(spreads))):
        found = _from_ends(found)
    return found


def _bidirectional(x: Array) -> Array:
    """Return the mean of both approaches, or of the one that was measured."""
    found = standard.statistics(x)
    measured = np.isfinite(x).any(axis=(1, 2))
    return np.asarray(found.mean[measured].mean(axis=0))


def _from_ends(found: Evaluated) -> Evaluated:
    """Return each straightness less the line through its first and its last target; the ends become sources."""
    mean, variance, ends = found.mean.copy(), found.variance.copy(), list[Shared]()
    effects = [source.effect.copy() for source in found.sources]
    names = iso_names(found.readings.axis)
    for k in range(len(mean)):
        if not found.straight(k):
            continue
        known = np.flatnonzero(np.isfinite(mean[k]))
        first, last = int(known[0]), int(known[-1])
        p = found.readings.position
        t = (p - p[first]) / (p[last] - p[first])
        for values in (mean, *effects):
            values[k] -= (1.0 - t) * values[k, first] + t * values[k, last]
        for what, i, weight in (("first", first, 1.0 - t), ("last", last, t)):
            effect = np.zeros_like(mean)
            effect[k] = -weight * np.sqrt(found.variance[k, i])
            effect[k, [first, last]] = 0.0
            ends.append(Shared(f"{what} end of the line, {names[found.readings.freedoms[k]]}", budget.END, effect))
        mean[k, [first, last]] = 0.0
        variance[k, [first, last]] = 0.0
    moved = [replace(source, effect=effect) for source, effect in zip(found.sources, effects, strict=True)]
    kept = [source for source in (*moved, *ends) if np.nanmax(np.abs(source.effect)) > 1e-15]
    line = "; straightness from the line through the first and the last target"
    return replace(found, mean=mean, variance=variance, sources=kept, reference=found.reference + line)


def _extras(found: Evaluated, settings: Settings) -> dict[str, xr.DataArray]:
    """Return what the standard computes at each target, the figures, and the corrected readings."""
    readings = found.readings
    stated = standard.statistics(readings.x)
    evaluated = [
        extremes.figures(
            x,
            spread,
            np.array([source.effect[k] for source in found.systematic]).reshape(-1, readings.position.size),
            float(found.at_target[k]),
            straight=found.straight(k),
            trials=settings.trials,
        )
        for k, (x, spread) in enumerate(zip(readings.x, found.spreads, strict=True))
    ]
    over = ("freedom", "approach", "position")
    extras: dict[str, tuple[Any, Array, str]] = {
        "deviations": (("freedom", "approach", "run", "position"), readings.x, "readings, corrected; m, rad"),
        "unidirectional_mean": (over, stated.mean, "mean unidirectional deviation; m, rad"),
        "unidirectional_s": (over, stated.s, "estimator of the unidirectional standard deviation; m, rad"),
        "reversal": (("freedom", "position"), stated.reversal, "mean forward less mean backward; m, rad"),
        "reversal_u": (("freedom", "position"), _reversal_u(found), "standard uncertainty of reversal; m, rad"),
        "figure_value": (("freedom", "figure"), np.array([each.value for each in evaluated]), "ISO 230-2; m, rad"),
        "figure_bias": (
            ("freedom", "figure"),
            np.array([each.bias for each in evaluated]),
            "mean excess of figure_value over the true figure, by scatter; m, rad",
        ),
        "figure_u": (
            ("freedom", "figure"),
            np.array([each.u for each in evaluated]),
            "standard uncertainty of figure_value less figure_bias; m, rad",
        ),
    }
    arrays = {
        name: xr.DataArray(values, dims=dims, attrs={"long_name": meaning})
        for name, (dims, values, meaning) in extras.items()
    }
    if readings.along in readings.freedoms:
        of_axis = evaluated[readings.freedoms.index(readings.along)]
        for k, name in enumerate(FIGURES):
            for ending, number in (("", of_axis.value), ("_bias", of_axis.bias), ("_u", of_axis.u)):
                attrs = {"units": "m", "long_name": MEANINGS[name] if not ending else f"of {name}"}
                arrays[name + ending] = xr.DataArray(float(number[k]), attrs=attrs)
    return arrays


def _reversal_u(found: Evaluated) -> Array:
    rows = []
    for x, spread in zip(found.readings.x, found.spreads, strict=True):
        n = np.isfinite(x).sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            own = (spread.own_factor * spread.own / n).sum(axis=0)
            drift = 4.0 * (spread.opposite_mean[0] + spread.opposite_mean[1] * spread.z**2) / n.max(axis=0)
        rows.append(np.sqrt(own + drift))
    return np.array(rows)


def _identities(raw: xr.Dataset, axis: str, names: list[str]) -> dict[str, str]:
    items = {
        "scale of the lengths": ("tracker", "scale"),
        "coefficient of expansion, machine": ("scales", "coefficient of expansion"),
        "temperature, machine": ("scale_thermometer", f"offset at {axis}"),
    }
    return certified(raw.attrs, {name: item for name, item in items.items() if name in names})


def _steps(found: Evaluated) -> list[str]:
    steps = ["mean cosine error of the alignment corrected"] if found.readings.along in found.readings.freedoms else []
    steps += ["corrected for expansion"] if any(source.group == "expansion" for source in found.systematic) else []
    names = iso_names(found.readings.axis)
    for name, spread in zip(found.readings.freedoms, found.spreads, strict=True):
        steps.append(f"{names[name]}: {ONE_VARIANCE[spread.pooled]}")
    return steps
