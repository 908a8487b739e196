"""From readings of an axis to its errors over ``position``, and to the figures of ISO 230-2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from errormotion.arrays import Array
from errormotion.errors import MethodError
from errormotion.estimation.checks.series import Trend
from errormotion.estimation.extremes import Extremes
from errormotion.kinematics.iso import direction_of, iso_names
from errormotion.measurement import Datum, Observed, Places
from errormotion.methods.linear_positioning.identification import extremes, model, standard
from errormotion.methods.linear_positioning.identification.reading import LENGTHS, Readings, point_of, read, zero_of
from errormotion.methods.linear_positioning.identification.scatter import Scatter
from errormotion.methods.linear_positioning.identification.standard import FIGURES, MEANINGS
from errormotion.methods.linear_positioning.schema import APPROACHES
from errormotion.methods.linear_positioning.settings import LinearPositioningSettings

if TYPE_CHECKING:
    from errormotion.measurement.observed import Solved

ONE_VARIANCE = {True: "one variance for all targets", False: "a variance for each target"}


@dataclass(frozen=True, eq=False)
class Evaluated:
    """Readings along lines with their variances, and what was noticed."""

    readings: Readings
    spreads: list[Scatter]
    notes: list[str]
    trends: list[Trend | None]
    cycle: str = "linear"

    @property
    def steps(self) -> list[str]:
        """What was done, for the provenance."""
        corrected = ["corrected for expansion"] if self.readings.sides else []
        named = zip(self.readings.names, self.spreads, strict=True)
        return [*corrected, *(f"{name}: {ONE_VARIANCE[spread.pooled]}" for name, spread in named)]


def evaluate(raw: xr.Dataset, settings: LinearPositioningSettings) -> Evaluated:
    """Return the readings of an axis that follow their schema, and their variances.

    Raises
    ------
    MethodError
        The data do not determine the result.
    """
    notes: list[str] = []
    readings = read(raw, settings, notes)
    spreads = model.spreads_of(readings, settings)
    names = [name for name, spread in zip(readings.names, spreads, strict=True) if spread.unequal]
    if names:
        notes.append(
            f"The scatter of {', '.join(names)} differs from target to target, and there are too few runs to state it "
            "for each: where it is smaller than the common one, the common one is used. Measure more runs or targets."
        )
    trends = model.trends_of(readings)
    return Evaluated(readings, spreads, [*notes, *model.trend_notes(readings, trends)], trends, settings.cycle)


def observe(raw: xr.Dataset, evaluated: Evaluated, settings: LinearPositioningSettings) -> Observed:
    """Return the readings of an axis as a measurement model, with its errors over ``position``."""
    readings, notes = evaluated.readings, [*evaluated.notes]
    axis, names, position = readings.axis, readings.names, readings.position[0]
    by_name = {name: dof for dof, name in iso_names(axis).items()}
    known = model.known_of(readings).T  # (target, freedom)
    count, zero = len(names), zero_of(raw) * 1e3
    warm = any(side.name == "machine" for side in readings.sides)
    temperature = f"{settings.reference_temperature:g} degC" if warm else "the temperature of the test"
    line = "; straightness from the line through the first and the last target" if readings.straight.any() else ""
    return model.observed(
        readings,
        model.problem_of(readings, evaluated.spreads),
        names,
        evaluated.trends,
        places=Places(lambda x, _: x.target[:, :count] + known, position.size),
        datum=_ends(position, known, readings.straight) if readings.straight.any() else None,
        recorded=("deviation", ("run", "approach", "target", "freedom")),
        freedoms=[by_name[name] for name in names],
        unit="m" if set(map(by_name.get, names)) & set(LENGTHS) else "rad",
        dims=("position",),
        coords={
            "xyz"[direction_of(axis)]: ("position", position, {"units": "m"}),
            "approach": list(APPROACHES),
            "freedom": list(names),
            "figure": list(FIGURES),
        },
        component=axis,
        functional_point=point_of(raw, settings, notes).tolist(),
        reference=f"zero of the instrument with the axis at {zero:.6g} mm, at {temperature}{line}",
        notes=notes,
    )


def _ends(position: Array, known: Array, straight: Any) -> Datum:
    """Return the line through the first and the last known target of each straightness."""
    columns, weight = [], np.zeros(known.shape)
    for k in np.flatnonzero(straight):
        there = np.flatnonzero(known[:, k] == 0)
        if there.size < 2:
            raise MethodError(
                "deviation: expected means of a straightness at two targets or more; found fewer",
                code="position.straightness.too_few",
            )
        ends = there[[0, -1]]
        t = (position - position[ends[0]]) / (position[ends[1]] - position[ends[0]])
        for values in (1.0 - t, t):
            columns.append(np.zeros(known.shape))
            columns[-1][:, k] = values
        weight[ends, k] = 1.0
    return Datum(np.stack(columns, axis=2), weight, model.END)


# ---------------------------------------------------------------------- figures and statistics


def _figures(evaluated: Evaluated, solved: Solved, k: int, trials: int, *, aligned: bool = False) -> Extremes:
    """Return the figures of line ``k``; with ``aligned`` those corrected for the mean of a stated cosine error."""
    readings = evaluated.readings
    x, count, m = readings.corrected[k], *readings.position.shape
    effects = []
    for source in solved.relative.errors.sources:
        if source.group in (model.DRIFT, model.NOISE, model.END):
            continue
        e = source.effect
        one = (e.T if e.shape == (m, count) else e.reshape(count, m))[k]
        effects.append(one / np.sqrt(2.0) if aligned and source.group == model.ALIGNMENT else one)
    if aligned and readings.stated_alignment is not None:
        x = x + readings.lever[k] * readings.stated_alignment**2
    return extremes.figures(
        x,
        readings.z[k],
        evaluated.spreads[k],
        np.nan_to_num(effects).reshape(-1, m),
        float(readings.at_target[k]),
        model.reversal_by_trend(readings, evaluated.trends, evaluated.cycle)[k],
        straight=bool(readings.straight[k]),
        trials=trials,
    )


def statistics_of(
    evaluated: Evaluated,
    solved: Solved,
    settings: LinearPositioningSettings,
    dims: tuple[str, str],
    attrs: dict[str, str],
) -> tuple[list[Extremes], dict[str, xr.DataArray]]:
    """Return the figures of each line, and with them the statistics of the standard and the corrected readings.

    ``dims`` are those of lines and targets in the result; ``attrs`` those of all variables.
    """
    line, target = dims
    x = evaluated.readings.corrected
    statistics = standard.statistics(x)
    figures = [_figures(evaluated, solved, k, settings.trials) for k in range(len(evaluated.spreads))]
    variables: dict[str, tuple[tuple[str, ...], Any, str]] = {
        "deviations": ((line, "approach", "run", target), x, "readings, corrected"),
        "unidirectional_mean": ((line, "approach", target), statistics.mean, "mean unidirectional deviation"),
        "unidirectional_s": (
            (line, "approach", target),
            statistics.s,
            "estimator of the unidirectional standard deviation",
        ),
        "figure_value": ((line, "figure"), [each.value for each in figures], "as the standard defines it"),
        "figure_bias": (
            (line, "figure"),
            [each.bias for each in figures],
            "mean excess of figure_value over the true figure, by scatter",
        ),
        "figure_u": (
            (line, "figure"),
            [each.u for each in figures],
            "standard uncertainty of figure_value less figure_bias",
        ),
    }
    return figures, {
        name: xr.DataArray(np.asarray(values), dims=its, attrs={"long_name": meaning, **attrs})
        for name, (its, values, meaning) in variables.items()
    }


def extras(evaluated: Evaluated, solved: Solved, settings: LinearPositioningSettings) -> dict[str, xr.DataArray]:
    """Return statistics and figures of an axis, its reversal, and the figures of the positioning by name."""
    readings, dims = evaluated.readings, ("freedom", "position")
    attrs = {"comment": "m, rad"}
    figures, arrays = statistics_of(evaluated, solved, settings, dims, attrs)
    reversal = {"reversal": standard.statistics(readings.corrected).reversal, "reversal_u": reversal_u(evaluated)}
    meanings = ("mean forward minus mean backward", "standard uncertainty of reversal")
    for (name, values), meaning in zip(reversal.items(), meanings, strict=True):
        arrays[name] = xr.DataArray(values, dims=dims, attrs={"long_name": meaning, **attrs})
    for k in np.flatnonzero([name[1] == name[2] for name in readings.names]):  # the positioning
        of_axis = figures[k]
        for i, name in enumerate(FIGURES):
            for ending, values in (("", of_axis.value), ("_bias", of_axis.bias), ("_u", of_axis.u)):
                attrs = {"units": "m", "long_name": MEANINGS[name] if not ending else f"of {name}"}
                arrays[name + ending] = xr.DataArray(float(values[i]), attrs=attrs)
        if readings.stated_alignment:
            aligned = _figures(evaluated, solved, int(k), settings.trials, aligned=True)
            for part, values in (("value", aligned.value), ("bias", aligned.bias), ("u", aligned.u)):
                attrs = {"units": "m", "long_name": f"figure_{part}, corrected for the mean cosine error"}
                arrays[f"aligned_{part}"] = xr.DataArray(values, dims="figure", attrs=attrs)
    return arrays


def reversal_u(evaluated: Evaluated) -> Array:
    """Return the standard uncertainties of the reversal at each target, (line, target)."""
    rows, readings = [], evaluated.readings
    by_trend = model.reversal_by_trend(readings, evaluated.trends, evaluated.cycle)
    for x, z, spread, more in zip(readings.x, readings.z, evaluated.spreads, by_trend, strict=True):
        n = np.isfinite(x).sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            own = (spread.own_stated / n).sum(axis=0)
            drift = 4.0 * (spread.run_stated[2] + spread.run_stated[3] * z**2) / n.max(axis=0)
        rows.append(np.sqrt(own + drift + np.square(more)))
    return np.array(rows)
