"""Chapter of the comparison of a thermal model with a campaign that was not used for its fit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from errormotion.compensation.thermal_model.report import chapter as thermal_model
from errormotion.report import canvas, provenance
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import (
    Block,
    Cell,
    Figure,
    KeyFigure,
    Part,
    Section,
    Source,
    Table,
    Text,
    estimate,
    or_dash,
)
from errormotion.report.drawings import timeline
from errormotion.report.elements import sensors
from errormotion.report.fields import remarks, unit_of
from errormotion.report.text import DASH, fixed, integer, listed, significant

COVERAGE_FACTOR = 1.96
"""For 95 % of a normal distribution."""

_FIGURES = ("rms", "remaining", "removed", "held")
_UNKNOWN = "unknown in the model or in this campaign"
_UNITS = {("temperature", 1): "K", ("spindle_speed", 1): "1000/min", ("spindle_speed", 2): "(1000/min)²"}


def part(source: Source, key: str, model: xr.Dataset, measured: xr.Dataset, figures: Mapping[str, Any]) -> Part:
    """Return the chapter.

    Parameters
    ----------
    source : Source
        Source of the prediction.
    key : str
        Makes the identifiers of its figures unique.
    model : Dataset
        Schema ``errormotion.model.thermal/1``.
    measured : Dataset
        Measured errors, at the instants of the prediction.
    figures : mapping
        ``rms``, ``remaining``, ``removed`` and ``held``, six each: results of the check.
    """
    predicted = source.errors
    found = sensors.of_dataset(predicted, source)
    numbers = {name: np.asarray(figures[name], float) for name in _FIGURES}
    panels = thermal_model.inputs(predicted)
    out = thermal_model.is_outside(predicted)
    given = _inputs(predicted, panels, out, f"{key}-inputs")
    return Part(
        "Thermal model compared with measurement",
        _key_figures(numbers),
        _summary(numbers, model, out),
        [
            Section(
                "check",
                "Predicted and measured",
                [_curves(predicted, measured, f"{key}-check"), _table(numbers, model)],
            ),
            Section("residuals", "Residuals", [_residuals(predicted, measured, numbers, f"{key}-residuals")]),
            Section("inputs", "Temperatures and working parameters", [*given, *thermal_model.outside(predicted)]),
            Section("model", "The model", _model(model, source.provenance)),
            Section("sensors", "Temperature sensors", sensors.blocks(found, f"{key}-sensors")),
            Section("quality", "Data quality", [*thermal_model.notes(predicted), *_of_measurement(measured)]),
            Section("provenance", "Provenance of the model", provenance.blocks(source)),
        ],
    )


def _share(value: float) -> str:
    return fixed(100 * value, 0)


def _seen(numbers: Mapping[str, np.ndarray]) -> list[int]:
    return [i for i in range(6) if math.isfinite(numbers["rms"][i])]


def _key_figures(numbers: Mapping[str, np.ndarray]) -> list[KeyFigure]:
    found = []
    for i in _seen(numbers):
        unit, size = unit_of(i)
        spans = [fixed(numbers[name][i] / size, 2) for name in ("rms", "remaining")]
        note = f"removed; rms {spans[0]} to {spans[1]} {unit}"
        found.append(KeyFigure(FREEDOMS[i], Cell(_share(numbers["removed"][i])), "%", note))
    return found


def _summary(numbers: Mapping[str, np.ndarray], model: xr.Dataset, out: np.ndarray) -> list[str]:
    seen = _seen(numbers)
    if not seen:
        return ["No error was both predicted and measured."]
    removed, held = numbers["removed"], numbers["held"]
    least, fewest = (min(seen, key=lambda i: float(v[i])) for v in (removed, held))
    words = [
        f"The model removes at least {_share(removed[least])} % of the RMS of an error (lowest: {FREEDOMS[least]}).",
        f"Its 95 % intervals cover at least {_share(held[fewest])} % of the instants (lowest: {FREEDOMS[fewest]}).",
        f"It was fitted to {integer(float(model.attrs.get('campaigns', math.nan)))} campaigns, variant "
        f"'{model.attrs.get('variant', DASH)}', from {listed(_sources(model)) or 'no sensor'}.",
    ]
    if out.any():
        words.append(f"{integer(int(out.sum()))} of {integer(out.size)} instants lie outside the training range.")
    unseen = [name for i, name in enumerate(FREEDOMS) if i not in seen]
    if unseen:
        words.append(f"Not compared because unknown: {listed(unseen)}.")
    return words


def _sources(model: xr.Dataset) -> list[str]:
    if "feature_source" not in model.coords:
        return []
    return list(dict.fromkeys(str(name) for name in model["feature_source"].values))


def _series(predicted: xr.Dataset, measured: xr.Dataset, i: int) -> tuple[np.ndarray, ...]:
    """Return predicted, its standard uncertainty, measured and its standard uncertainty, in the unit of the page."""
    size, name = unit_of(i)[1], FREEDOMS[i]
    pairs = [(np.asarray(ds[name].values, float), timeline.sigma(ds, i)) for ds in (predicted, measured)]
    return tuple(values / size for pair in pairs for values in pair)


def _six(predicted: xr.Dataset, paint: Any, key: str) -> Any:
    time = timeline.clock(np.asarray(predicted["time"].values, float))

    def draw(figure: Canvas) -> None:
        panels = figure.subplots(3, 2, sharex=True)
        figure.subplots_adjust(left=0.075, right=0.985, top=0.95, bottom=0.09, wspace=0.19, hspace=0.3)
        out = thermal_model.is_outside(predicted)
        for i, name in enumerate(FREEDOMS):
            axes: Axes = panels[i % 3, i // 3]
            axes.set_title(f"{name} / {unit_of(i)[0]}")
            if not paint(axes, time.values, i):
                axes.text(0.5, 0.5, "not compared", transform=axes.transAxes, ha="center", va="center", color="#555555")
                axes.set_yticks([])
            timeline.shade(axes, time.values, out)
        for axes in panels[-1]:
            timeline.time_axis(axes, time)

    return canvas.draw(draw, key, 5.0)


def _curves(predicted: xr.Dataset, measured: xr.Dataset, key: str) -> Block:
    def paint(axes: Axes, time: np.ndarray, i: int) -> bool:
        p, u, m, v = _series(predicted, measured, i)
        if not (np.isfinite(p).any() and np.isfinite(m).any()):
            return False
        canvas.curve(axes, time, p, COVERAGE_FACTOR * u, colour=canvas.BLUE)
        if m.size <= 4 * timeline.DOTTED:
            axes.errorbar(
                time, m, COVERAGE_FACTOR * np.nan_to_num(v), fmt="o", markersize=2.4, color=canvas.BLACK, elinewidth=0.6
            )
        else:
            canvas.curve(axes, time, m, None, colour=canvas.BLACK, width=0.7)
        axes.axhline(0, color="#888888", linewidth=0.6)
        return True

    caption = (
        "Predicted (blue, with band) and measured (black, with bars) errors since the reference state. Band and bars: "
        f"95 % intervals.{_background(predicted)}"
    )
    words = []
    for i, name in enumerate(FREEDOMS):
        p, _, m, _ = _series(predicted, measured, i)
        both = np.flatnonzero(np.isfinite(p) & np.isfinite(m))
        if both.size:
            k = both[-1]
            words.append(f"{name} last {fixed(p[k], 2)} predicted, {fixed(m[k], 2)} measured {unit_of(i)[0]}")
    return Figure(_six(predicted, paint, key), caption, f"Predicted and measured over time: {'; '.join(words)}.")


def _background(predicted: xr.Dataset) -> str:
    any_out = thermal_model.is_outside(predicted).any()
    return " Coloured background: outside the training range." if any_out else ""


def _residuals(predicted: xr.Dataset, measured: xr.Dataset, numbers: Mapping[str, np.ndarray], key: str) -> Block:
    def paint(axes: Axes, time: np.ndarray, i: int) -> bool:
        p, u, m, v = _series(predicted, measured, i)
        remaining = m - p
        if not np.isfinite(remaining).any():
            return False
        reach = COVERAGE_FACTOR * np.hypot(u, v)
        canvas.curve(axes, time, np.zeros_like(remaining), reach, colour=canvas.SKY, width=0.0)
        axes.plot(time, remaining, "-", color=canvas.BLACK, linewidth=0.6)
        inside = np.abs(remaining) <= reach
        for where, colour in ((inside, canvas.BLACK), (~inside, timeline.UNKNOWN)):
            axes.plot(time[where], remaining[where], "o", color=colour, markersize=2.6, markeredgewidth=0)
        axes.axhline(0, color="#888888", linewidth=0.6)
        return True

    caption = (
        "Measured minus predicted: the errors that remain after compensation by the prediction. Band: 95 % interval of "
        f"the difference; red: outside.{_background(predicted)}"
    )
    words = "; ".join(
        f"{FREEDOMS[i]} {fixed(numbers['remaining'][i] / unit_of(i)[1], 2)} {unit_of(i)[0]}" for i in _seen(numbers)
    )
    return Figure(_six(predicted, paint, key), caption, f"Residuals over time; root mean squares: {words}.")


def _table(numbers: Mapping[str, np.ndarray], model: xr.Dataset) -> Table:
    own = np.asarray(model["removed"].values, float)
    misfit = np.asarray(model["misfit"].values, float)
    rows: list[list[Cell | str]] = []
    for i, name in enumerate(FREEDOMS):
        unit, size = unit_of(i)
        spans = [fixed(numbers[what][i] / size, 2) for what in ("rms", "remaining")]
        shares = [_share(numbers[what][i]) for what in ("removed", "held")]
        stated = [_share(own[i]), fixed(COVERAGE_FACTOR * misfit[i] / size, 2)]
        rows.append([name, unit, *(or_dash(text, _UNKNOWN) for text in (*spans, *shares, *stated))])
    validated = str(model.attrs.get("validated", "campaigns left out"))
    return Table(
        "Root mean square of the measured errors and of measured minus predicted; removed fraction; fraction of the "
        "instants at which the 95 % interval of the difference contains zero. For comparison the values stated by the "
        f"model, from {validated}.",
        ["error", "unit", "measured", "remaining", "removed / %", "covered / %", "removed / %", "half interval"],
        rows,
        [("", 2), ("root mean square", 2), ("this campaign", 2), ("stated by the model", 2)],
    )


def _inputs(predicted: xr.Dataset, panels: Sequence[timeline.Panel], out: np.ndarray, key: str) -> list[Block]:
    if not panels:
        return [Text("All inputs are unknown.", "warning")]
    words = ". ".join(panel.in_words() for panel in panels)
    drawn = timeline.draw(np.asarray(predicted["time"].values, float), panels, key, (), out)
    caption = f"Inputs of the prediction.{_background(predicted)}"
    return [Figure(drawn, caption, f"Over time: {words}.")]


def _model(model: xr.Dataset, found: Mapping[str, Any]) -> list[Block]:
    blocks: list[Block] = [
        Text(
            f"Variant '{model.attrs.get('variant', DASH)}', from {listed(_sources(model)) or 'no sensor'}. "
            "Temperatures are changes since the start in K; there is no constant."
        ),
        *_coefficients(model),
    ]
    tried = _tried(found)
    if tried is None:
        return [*blocks, Text("The model does not state the other candidates.", "note")]
    return [*blocks, tried]


def _unit(model: xr.Dataset, k: int) -> str:
    """Return the unit of a feature."""
    source, power = str(model["feature_source"].values[k]), int(model["feature_power"].values[k])
    if not int(model["feature_parameter"].values[k]):
        return "K"
    if source == "feed":
        return "m/min" if power == 1 else "(m/min)²"
    return _UNITS.get((source, power), "")


def _coefficients(model: xr.Dataset) -> list[Block]:
    if not model.sizes.get("feature", 0):
        return [Text("The model has no inputs.", "warning")]
    return [_coefficients_of(model, range(3), "displacements"), _coefficients_of(model, range(3, 6), "rotations")]


def _coefficients_of(model: xr.Dataset, freedoms: range, what: str) -> Table:
    coefficient = np.asarray(model["coefficient"].transpose("dof", "feature").values, float)
    C = np.asarray(model["coefficient_covariance"].transpose("dof", "feature", "feature_").values, float)
    variance = np.diagonal(C, axis1=1, axis2=2)
    rows: list[list[Cell | str]] = []
    for k, name in enumerate(model["feature"].values):
        cells = []
        for i in freedoms:
            size = unit_of(i)[1]
            sigma = math.sqrt(variance[i, k]) if variance[i, k] >= 0 else math.nan
            cells.append(estimate(coefficient[i, k] / size, 2 * sigma / size, reason=_UNKNOWN))
        low, high = (significant(float(model[side].values[k]), 3) for side in ("feature_low", "feature_high"))
        rows.append([str(name), _unit(model, k), f"{low} to {high}", *cells])
    return Table(
        f"Coefficients of the {what}: error per unit of each input. After ±: expanded uncertainty, k = 2; the "
        "coefficients of one error are correlated. Range: of the input in training.",
        ["input", "unit", "range", *(f"{FREEDOMS[i]} / {unit_of(i)[0]}" for i in freedoms)],
        rows,
    )


def _tried(found: Mapping[str, Any]) -> Table | None:
    """Return the candidates and their scores from the provenance of the model."""
    steps = found.get("steps")
    for step in steps if isinstance(steps, (list, tuple)) else []:
        tried = step.get("tried") if isinstance(step, Mapping) else None
        if not isinstance(tried, (list, tuple)) or not tried:
            continue
        rows: list[list[Cell | str]] = []
        for place, each in enumerate(tried):
            minutes = ", ".join(f"{float(value) / 60:g}" for value in each.get("constants", [])) or "none"
            names = listed([str(name) for name in each.get("sensors", [])]) or "none"
            score = float(each.get("score", math.nan))
            rows.append(
                [str(each.get("variant", DASH)), minutes, names, significant(score, 3), "" if place else "selected"]
            )
        return Table(
            "Candidates: the best of each variant and set of constants. Score: mean square residual at campaigns that "
            "were left out, relative to the mean square error, summed over the errors; the lowest was selected.",
            ["variant", "lags or time constants / min", "sensors", "score", ""],
            rows,
            numeric=False,
        )
    return None


def _of_measurement(measured: xr.Dataset) -> list[Block]:
    own = remarks(measured)
    return [Text(f"Of the measurement: {note}", "warning") for note in own]
