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
from errormotion.estimation.extremes import Extremes
from errormotion.kinematics.iso import direction_of, iso_names
from errormotion.methods.linear_positioning.identification import budget, extremes, standard
from errormotion.methods.linear_positioning.identification.expansion import Shared, expansion
from errormotion.methods.linear_positioning.identification.reading import Readings, per_freedom, read
from errormotion.methods.linear_positioning.identification.scatter import Scatter, scatter
from errormotion.methods.linear_positioning.identification.standard import FIGURES, MEANINGS
from errormotion.methods.linear_positioning.schema import APPROACHES
from errormotion.methods.linear_positioning.settings import LIMITS, Settings, TrialSettings

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from errormotion.plugins import MethodInfo

LENGTHS = ("EX", "EY", "EZ")
ONE_VARIANCE = {True: "one variance for all targets", False: "a variance for each target"}


@dataclass(frozen=True)
class Evaluated:
    """Means, variances and sources of a test, from which its result is built.

    Attributes
    ----------
    readings : Readings
        ``x`` corrected for expansion.
    mean : ndarray, (freedom, target)
        Mean bidirectional deviations; of a straightness relative to the line through its ends.
    variance : ndarray, (freedom, target)
        Of the means, independent from target to target.
    spreads : list of Scatter
    sources, systematic : list of Shared
        All sources, and those that are not estimated from the scatter of the readings.
    at_target : ndarray, (freedom,)
        Standard uncertainty that is independent from target to target, of the instrument.
    cosine : ndarray, (target,), or None
        Mean by which the readings along the axis are too small by a stated alignment, m.
    reference : str
    """

    readings: Readings
    mean: Array
    variance: Array
    spreads: list[Scatter]
    sources: list[Shared]
    systematic: list[Shared]
    at_target: Array
    cosine: Array | None
    reference: str

    def straight(self, k: int) -> bool:
        """Return whether freedom ``k`` is a straightness, whose reference line depends on the instrument."""
        name = self.readings.freedoms[k]
        return name in LENGTHS and name != self.readings.along

    def figures(self, k: int, trials: int) -> Extremes:
        """Return the figures of freedom ``k`` with bias and uncertainty."""
        effects = np.array([source.effect[k] for source in self.systematic])
        return extremes.figures(
            self.readings.x[k],
            self.spreads[k],
            effects.reshape(-1, self.readings.position.size),
            float(self.at_target[k]),
            straight=self.straight(k),
            trials=trials,
        )

    def aligned_figures(self, trials: int) -> Extremes | None:
        """Return the figures along the axis, corrected for the mean cosine error; None if no alignment is stated."""
        if self.cosine is None:
            return None
        k = self.readings.freedoms.index(self.readings.along)
        x = self.readings.x.copy()
        x[k] += self.cosine
        of_angle = [
            replace(each, effect=each.effect / np.sqrt(2.0)) if each.group == budget.ALIGNMENT else each
            for each in self.systematic
        ]
        return replace(self, readings=replace(self.readings, x=x), systematic=of_angle).figures(k, trials)

    def scatter_of_means(self) -> Array:
        """Return the standard deviations of the means by the scatter of the readings, (freedom, approach, target)."""
        return np.array(
            [
                np.sqrt(spread.own_factor * spread.own / np.maximum(np.isfinite(x).sum(axis=1), 1))
                for x, spread in zip(self.readings.x, self.spreads, strict=True)
            ]
        )


def identify(raw: xr.Dataset, settings: Settings, info: MethodInfo) -> xr.Dataset:
    """Return the errors of the axis over ``position``, with the figures of ISO 230-2.

    Raises
    ------
    MethodError
        The data do not determine the result.
    """
    notes: list[str] = []
    evaluated = evaluate(raw, settings, notes)
    origin = provenance.make(settings, raw, None, steps=_steps(evaluated))
    extras = {} if isinstance(settings, TrialSettings) else _extras(evaluated, settings)
    errors = build(evaluated, raw, info, origin, extras)
    return errors.assign_attrs(notes=notes or [""], **stated_limits(settings))


def stated_limits(settings: Settings) -> dict[str, float]:
    """Return the limits of the figures that the settings state, m, by the name of the setting."""
    return {name: limit for name in LIMITS.values() if (limit := getattr(settings, name)) is not None}


def build(
    evaluated: Evaluated,
    raw: xr.Dataset,
    info: MethodInfo,
    origin: Mapping[str, Any],
    extras: Mapping[str, xr.DataArray],
) -> xr.Dataset:
    """Return the error dataset of an evaluated test; ``origin`` is its provenance."""
    readings = evaluated.readings
    names = [source.name for source in evaluated.sources]
    m = readings.position.size
    values, influence = np.full((m, 6), np.nan), np.zeros((len(names), m, 6))
    own = np.zeros((m, 6))
    for k, column in enumerate(readings.columns):
        values[:, column], own[:, column] = evaluated.mean[k], evaluated.variance[k]
        for s, source in enumerate(evaluated.sources):
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
        reference=evaluated.reference,
        method=info.id,
        method_version=info.version,
        provenance=origin,
        influence=influence,
        sources=names,
        source_groups=[source.group for source in evaluated.sources],
        source_ids=_identities(raw, axis, names),
        extras=extras,
        start=start_of(raw),
        measured=raw.attrs,
    )


def evaluate(raw: xr.Dataset, settings: Settings, notes: list[str], *, planned: bool = False) -> Evaluated:
    """Return means, variances and sources of a raw dataset that follows its schema; remarks are appended to ``notes``.

    With ``planned``, scatter and drift are those of the settings, for every freedom.
    """
    recorded = read(raw, settings, notes)
    correction = expansion(raw, recorded, settings, notes)
    x = recorded.x.copy()
    cosine = None
    if recorded.along in recorded.freedoms:
        x[recorded.freedoms.index(recorded.along)] -= correction.along
        cosine = budget.cosine_error(raw, recorded, settings)
        notes += budget.assumptions(raw, settings)
    readings = replace(recorded, x=x)
    stated_u = settings.uncertainty
    drift = None if stated_u.drift is None else stated_u.drift / np.sqrt(12.0)
    spreads = []
    for k, name in enumerate(readings.freedoms):
        stated = planned or name == readings.along
        spreads.append(
            scatter(
                x[k],
                readings.position,
                kind="stated" if planned else settings.scatter,
                drift=drift if stated else None,
                stated=stated_u.scatter if stated else None,
            )
        )
    notes += _unequal(readings.freedoms, spreads)
    mean = np.array([_bidirectional(each) for each in x])
    systematic = [*budget.instrument_sources(raw, readings, settings, mean), *correction.sources]
    temperature = f"{settings.reference_temperature:g} degC" if correction.complete else "the temperature of the test"
    evaluated = Evaluated(
        readings=readings,
        mean=mean,
        variance=budget.independent(raw, readings, spreads),
        spreads=spreads,
        sources=[*budget.drift_sources(readings, spreads), *systematic],
        systematic=systematic,
        at_target=per_freedom(raw, "target_uncertainty", len(spreads)),
        cosine=cosine,
        reference=f"zero of the instrument with the axis at {recorded.zero * 1e3:.6g} mm, at {temperature}",
    )
    if any(evaluated.straight(k) for k in range(len(spreads))):
        return _straightness_from_ends(evaluated)
    return evaluated


def _unequal(freedoms: Sequence[str], spreads: list[Scatter]) -> list[str]:
    """Return a note if the scatter differs from target to target, and there are too few runs to state each."""
    names = [name for name, spread in zip(freedoms, spreads, strict=True) if spread.unequal]
    if not names:
        return []
    return [
        f"The scatter of {', '.join(names)} differs from target to target, and there are too few runs to state it for "
        "each: where it is smaller than the common one, the common one is used. Measure more runs or targets."
    ]


def _bidirectional(x: Array) -> Array:
    """Return the mean of both approaches, or of the one that was measured."""
    measured = np.isfinite(x).any(axis=(1, 2))
    return np.asarray(standard.statistics(x).mean[measured].mean(axis=0))


def _straightness_from_ends(evaluated: Evaluated) -> Evaluated:
    """Return each straightness minus the line through its first and its last target; the ends become sources."""
    mean, variance, ends = evaluated.mean.copy(), evaluated.variance.copy(), list[Shared]()
    effects = [source.effect.copy() for source in evaluated.sources]
    names = iso_names(evaluated.readings.axis)
    for k in range(len(mean)):
        if not evaluated.straight(k):
            continue
        known = np.flatnonzero(np.isfinite(mean[k]))
        first, last = int(known[0]), int(known[-1])
        p = evaluated.readings.position
        t = (p - p[first]) / (p[last] - p[first])
        for values in (mean, *effects):
            values[k] -= (1.0 - t) * values[k, first] + t * values[k, last]
        for end, i, weight in (("first", first, 1.0 - t), ("last", last, t)):
            effect = np.zeros_like(mean)
            effect[k] = -weight * np.sqrt(evaluated.variance[k, i])
            effect[k, [first, last]] = 0.0
            ends.append(Shared(f"{end} end of the line, {names[evaluated.readings.freedoms[k]]}", budget.END, effect))
        mean[k, [first, last]] = 0.0
        variance[k, [first, last]] = 0.0
    moved = [replace(source, effect=effect) for source, effect in zip(evaluated.sources, effects, strict=True)]
    kept = [source for source in (*moved, *ends) if np.nanmax(np.abs(source.effect)) > 1e-15]
    line = "; straightness from the line through the first and the last target"
    return replace(evaluated, mean=mean, variance=variance, sources=kept, reference=evaluated.reference + line)


def _extras(evaluated: Evaluated, settings: Settings) -> dict[str, xr.DataArray]:
    """Return the statistics of the standard at each target, the figures, and the corrected readings."""
    readings = evaluated.readings
    statistics = standard.statistics(readings.x)
    figures = [evaluated.figures(k, settings.trials) for k in range(len(readings.x))]
    dims = ("freedom", "approach", "position")
    extras: dict[str, tuple[Any, Array, str]] = {
        "deviations": (("freedom", "approach", "run", "position"), readings.x, "readings, corrected; m, rad"),
        "unidirectional_mean": (dims, statistics.mean, "mean unidirectional deviation; m, rad"),
        "unidirectional_s": (dims, statistics.s, "estimator of the unidirectional standard deviation; m, rad"),
        "reversal": (("freedom", "position"), statistics.reversal, "mean forward minus mean backward; m, rad"),
        "reversal_u": (("freedom", "position"), _reversal_u(evaluated), "standard uncertainty of reversal; m, rad"),
        "figure_value": (("freedom", "figure"), np.array([each.value for each in figures]), "ISO 230-2; m, rad"),
        "figure_bias": (
            ("freedom", "figure"),
            np.array([each.bias for each in figures]),
            "mean excess of figure_value over the true figure, by scatter; m, rad",
        ),
        "figure_u": (
            ("freedom", "figure"),
            np.array([each.u for each in figures]),
            "standard uncertainty of figure_value less figure_bias; m, rad",
        ),
    }
    arrays = {
        name: xr.DataArray(values, dims=dims, attrs={"long_name": meaning})
        for name, (dims, values, meaning) in extras.items()
    }
    if readings.along in readings.freedoms:
        of_axis = figures[readings.freedoms.index(readings.along)]
        for k, name in enumerate(FIGURES):
            for ending, values in (("", of_axis.value), ("_bias", of_axis.bias), ("_u", of_axis.u)):
                attrs = {"units": "m", "long_name": MEANINGS[name] if not ending else f"of {name}"}
                arrays[name + ending] = xr.DataArray(float(values[k]), attrs=attrs)
        if (aligned := evaluated.aligned_figures(settings.trials)) is not None:
            for part, values in (("value", aligned.value), ("bias", aligned.bias), ("u", aligned.u)):
                attrs = {"units": "m", "long_name": f"figure_{part}, corrected for the mean cosine error"}
                arrays[f"aligned_{part}"] = xr.DataArray(values, dims="figure", attrs=attrs)
    return arrays


def _reversal_u(evaluated: Evaluated) -> Array:
    rows = []
    for x, spread in zip(evaluated.readings.x, evaluated.spreads, strict=True):
        n = np.isfinite(x).sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            own = (spread.own_factor * spread.own / n).sum(axis=0)
            drift = 4.0 * (spread.opposite_mean[0] + spread.opposite_mean[1] * spread.z**2) / n.max(axis=0)
        rows.append(np.sqrt(own + drift))
    return np.array(rows)


def _identities(raw: xr.Dataset, axis: str, names: list[str]) -> dict[str, str]:
    items = {
        budget.LENGTH: ("tracker", "scale"),
        "coefficient of expansion, machine": ("scales", "coefficient of expansion"),
        "temperature, machine": ("scale_thermometer", f"offset at {axis}"),
    }
    return certified(raw.attrs, {name: item for name, item in items.items() if name in names})


def _steps(evaluated: Evaluated) -> list[str]:
    readings = evaluated.readings
    steps = ["corrected for expansion"] if any(source.group == "expansion" for source in evaluated.systematic) else []
    names = iso_names(readings.axis)
    for name, spread in zip(readings.freedoms, evaluated.spreads, strict=True):
        steps.append(f"{names[name]}: {ONE_VARIANCE[spread.pooled]}")
    return steps
