"""Chapter of the prediction of a thermal model: errors with uncertainty, and times outside the training range."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr

from errormotion.report import budget, provenance, quality
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import Block, Cell, Figure, KeyFigure, Part, Section, Source, Table, Text, estimate
from errormotion.report.drawings import timeline
from errormotion.report.elements import sensors
from errormotion.report.fields import unit_of
from errormotion.report.text import fixed, integer, listed, percent

_PREDICTED = (
    "Predicted from temperatures and working parameters, not measured. The uncertainty is valid as long as the machine "
    "behaves as in the campaigns of the fit."
)
_UNKNOWN = "not in the model: unknown in all campaigns of the fit"


def is_prediction(errors: xr.Dataset) -> bool:
    """Return whether a dataset is a prediction of a thermal model over time."""
    return errors.attrs.get("method") == "thermal_model" and errors["EX"].dims == ("time",)


def part(source: Source, key: str) -> Part:
    """Return the chapter of one prediction; ``key`` makes the identifiers of its figures unique."""
    errors = source.errors
    found = sensors.of_dataset(errors, source)
    return Part(
        "Errors predicted by a thermal model",
        _key_figures(errors),
        _summary(errors, found),
        [
            Section("errors", "Prediction", [Text(_PREDICTED, "note"), *_over_time(errors, f"{key}-errors")]),
            Section("outside", "Outside the training range", outside(errors)),
            Section("sensors", "Temperature sensors", sensors.blocks(found, f"{key}-sensors")),
            Section("uncertainty", "Uncertainty", _uncertainty(errors)),
            Section("quality", "Data quality", notes(errors)),
            Section("provenance", "Provenance", provenance.blocks(source)),
        ],
    )


def is_outside(errors: xr.Dataset) -> np.ndarray:
    """Return whether an input lies outside the training range, (time,) of bool."""
    if "outside" not in errors or errors["outside"].dims != ("time",):
        return np.zeros(errors.sizes["time"], dtype=bool)
    return np.asarray(np.nan_to_num(np.asarray(errors["outside"].values, float)) > 0)


def inputs(errors: xr.Dataset) -> list[timeline.Panel]:
    """Return the panels of the inputs of the prediction."""
    names = timeline.sensor_names(errors)
    values = np.asarray(errors["temperature"].transpose("time", "sensor").values, float) if names else np.empty((0, 0))
    return [*timeline.temperatures(names, values), *timeline.working(errors, held=True)]


def _last(errors: xr.Dataset) -> int | None:
    known = np.flatnonzero(np.any([np.isfinite(errors[name].values) for name in FREEDOMS], axis=0))
    return int(known[-1]) if known.size else None


def _key_figures(errors: xr.Dataset) -> list[KeyFigure]:
    last = _last(errors)
    if last is None:
        return []
    found = []
    when = f"after {fixed(float(errors['time'].values[last]) / 60, 1)} min"
    for i, name in enumerate(FREEDOMS):
        unit, size = unit_of(i)
        value, sigma = float(errors[name].values[last]), timeline.sigma(errors, i)[last]
        if math.isfinite(value):
            found.append(KeyFigure(name, estimate(value / size, 2 * sigma / size), unit, when))
    share = percent(float(is_outside(errors).mean())).removesuffix(" %")
    found.append(KeyFigure("outside training", Cell(share), "%", "of the instants"))
    return found


def _summary(errors: xr.Dataset, found: list[sensors.Sensor]) -> list[str]:
    n = errors.sizes["time"]
    unknown = n - int(np.any([np.isfinite(errors[name].values) for name in FREEDOMS], axis=0).sum())
    words = [f"Predicted at {integer(n)} instants; not measured."]
    if unknown:
        words.append(f"{integer(unknown)} instants have no prediction: an input is unknown there.")
    out = int(is_outside(errors).sum())
    words.append(
        f"{integer(out)} of {integer(n)} instants lie outside the training range: the prediction is not reliable there."
        if out
        else "All instants lie within the training range."
    )
    if found:
        words.append(sensors.warmest(found))
    unknown_errors = [name for name in FREEDOMS if not np.isfinite(errors[name].values).any()]
    if unknown_errors:
        words.append(f"Not predicted: {listed(unknown_errors)}. Reported as unknown, not as zero.")
    return words


def _over_time(errors: xr.Dataset, key: str) -> list[Block]:
    reasons = dict.fromkeys(FREEDOMS, _UNKNOWN)
    table = timeline.table(errors, "The six errors as predicted.", reasons)
    panels = [*timeline.errors(errors), *inputs(errors)]
    if not panels:
        return [Text("No errors are predicted.", "warning"), table]
    out = is_outside(errors)
    shaded = " Coloured background: outside the training range." if out.any() else ""
    caption = (
        "Predicted errors, and the temperatures and working parameters of the prediction, on one time axis. Bands: "
        f"expanded uncertainty, k = 2 (about 95 %).{shaded}"
    )
    words = ". ".join(panel.in_words() for panel in panels)
    drawn = timeline.draw(np.asarray(errors["time"].values, float), panels, key, (), out)
    return [Figure(drawn, caption, f"Over time: {words}."), table]


def outside(errors: xr.Dataset) -> list[Block]:
    """Return the inputs outside the training range, and their times."""
    if "outside" not in errors:
        return [Text("The result does not state the training range.", "warning")]
    out = is_outside(errors)
    if not out.any():
        return [Text("All inputs lie within the training range.")]
    minutes = np.asarray(errors["time"].values, float) / 60
    found: list[Block] = [
        Text(
            f"At {integer(int(out.sum()))} of {integer(out.size)} instants an input lies outside the training range by "
            "more than a tenth of this range. The stated uncertainty is not valid there.",
            "warning",
        )
    ]
    if "outside_feature" not in errors or set(errors["outside_feature"].dims) != {"time", "feature"}:
        return found
    where = np.asarray(errors["outside_feature"].transpose("time", "feature").values) > 0
    rows: list[list[Cell | str]] = [
        [
            str(name),
            integer(int(own.sum())),
            fixed(float(minutes[own][0]), 1),
            fixed(float(minutes[own][-1]), 1),
        ]
        for name, own in zip(errors["feature"].values, where.T, strict=True)
        if own.any()
    ]
    caption = "Inputs outside the training range."
    return [*found, Table(caption, ["input", "instants", "first at / min", "last at / min"], rows)]


def _uncertainty(errors: xr.Dataset) -> list[Block]:
    last = _last(errors)
    if last is None:
        return [Text("There is no prediction.", "warning")]
    when = f"at the last predicted instant, {fixed(float(errors['time'].values[last]) / 60, 1)} min"
    return [
        budget.table(errors.isel(time=last), when),
        Text(
            "The misfit is the residual at campaigns that were left out of the fit; the coefficients are uncertain "
            "because of the data of the fit. Both are fully correlated over the whole prediction.",
            "note",
        ),
    ]


def notes(errors: xr.Dataset) -> list[Block]:
    """Return the notes on a dataset, and its completeness."""
    return [*quality.notes(errors), *quality.sentences(errors, None)]
