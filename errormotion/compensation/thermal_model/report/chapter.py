"""The chapter of a thermal model's prediction: errors with their interval, and where it is beyond what was trained."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr

from errormotion.report import budget, provenance, quality, sensors, timeline
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import Block, Cell, Figure, KeyFigure, Part, Section, Source, Table, Text, estimate
from errormotion.report.fields import remarks
from errormotion.report.generic import unit_at
from errormotion.report.text import fixed, integer, listed, percent

_PREDICTED = (
    "Predicted from temperatures and working parameters, and not measured. The interval holds as far as the machine "
    "behaves as it did in the campaigns that the model was made of."
)
_UNSEEN = "not in the model: no campaign that it was made of saw it"


def is_prediction(errors: xr.Dataset) -> bool:
    """Return whether a dataset is what a thermal model predicts over time."""
    return errors.attrs.get("method") == "thermal_model" and errors["EX"].dims == ("time",)


def part(source: Source, key: str) -> Part:
    """Return the chapter of one prediction; ``key`` keeps its figures' identifiers apart."""
    errors = source.errors
    found = sensors.of_dataset(errors, source)
    return Part(
        "Errors predicted by a thermal model",
        _key_figures(errors),
        _summary(errors, found),
        [
            Section("errors", "Prediction", [Text(_PREDICTED, "note"), *_over_time(errors, f"{key}-errors")]),
            Section("outside", "Beyond what was trained", outside(errors)),
            Section("sensors", "Temperature sensors", sensors.blocks(found, f"{key}-sensors")),
            Section("uncertainty", "Uncertainty", _uncertainty(errors)),
            Section("quality", "Data quality", notes(errors)),
            Section("provenance", "Provenance", provenance.blocks(source)),
        ],
    )


def beyond(errors: xr.Dataset) -> np.ndarray:
    """Return at which instants an input lies beyond what the model was trained on, (time,) of bool."""
    if "outside" not in errors or errors["outside"].dims != ("time",):
        return np.zeros(errors.sizes["time"], dtype=bool)
    return np.asarray(np.nan_to_num(np.asarray(errors["outside"].values, float)) > 0)


def inputs(errors: xr.Dataset) -> list[timeline.Panel]:
    """Return the panels of what the prediction was made from."""
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
        unit, size = unit_at(i)
        value, sigma = float(errors[name].values[last]), timeline.sigma(errors, i)[last]
        if math.isfinite(value):
            found.append(KeyFigure(name, estimate(value / size, 2 * sigma / size), unit, when))
    share = percent(float(beyond(errors).mean())).removesuffix(" %")
    found.append(KeyFigure("beyond training", Cell(share), "%", "of the instants"))
    return found


def _summary(errors: xr.Dataset, found: list[sensors.Sensor]) -> list[str]:
    n = errors.sizes["time"]
    unknown = n - int(np.any([np.isfinite(errors[name].values) for name in FREEDOMS], axis=0).sum())
    words = [f"Predicted at {integer(n)} instants; nothing of this was measured."]
    if unknown:
        words.append(f"{integer(unknown)} instants have no prediction: an input is unknown there.")
    out = int(beyond(errors).sum())
    words.append(
        f"{integer(out)} of {integer(n)} instants lie beyond what the model was trained on: do not rely on it there."
        if out
        else "All instants lie within what the model was trained on."
    )
    if found:
        words.append(sensors.warmest(found))
    unseen = [name for name in FREEDOMS if not np.isfinite(errors[name].values).any()]
    if unseen:
        words.append(f"Not predicted: {listed(unseen)}. Reported as unknown, not as zero.")
    return words


def _over_time(errors: xr.Dataset, key: str) -> list[Block]:
    reasons = dict.fromkeys(FREEDOMS, _UNSEEN)
    table = timeline.table(errors, "The six errors as predicted.", reasons)
    panels = [*timeline.errors(errors), *inputs(errors)]
    if not panels:
        return [Text("No error is predicted at any time.", "warning"), table]
    out = beyond(errors)
    shaded = " Coloured ground: beyond what the model was trained on." if out.any() else ""
    caption = (
        "Predicted errors, and on the same time axis the temperatures and working parameters that they follow from. "
        f"Bands: expanded uncertainty, k = 2 (about 95 %).{shaded}"
    )
    words = ". ".join(panel.in_words() for panel in panels)
    drawn = timeline.draw(np.asarray(errors["time"].values, float), panels, key, (), out)
    return [Figure(drawn, caption, f"Over time: {words}."), table]


def outside(errors: xr.Dataset) -> list[Block]:
    """Return which input is beyond what the model was trained on, and when."""
    if "outside" not in errors:
        return [Text("The result does not say what the model was trained on.", "warning")]
    out = beyond(errors)
    if not out.any():
        return [Text("No input lies beyond what the model was trained on.")]
    minutes = np.asarray(errors["time"].values, float) / 60
    found: list[Block] = [
        Text(
            f"At {integer(int(out.sum()))} of {integer(out.size)} instants an input lies beyond what the model was "
            "trained on, by more than a tenth of its range. The interval is not made for that.",
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
    caption = "Inputs beyond what the model was trained on."
    return [*found, Table(caption, ["input", "instants", "first at / min", "last at / min"], rows)]


def _uncertainty(errors: xr.Dataset) -> list[Block]:
    last = _last(errors)
    if last is None:
        return [Text("There is no prediction, and no uncertainty to part.", "warning")]
    when = f"at the last predicted instant, {fixed(float(errors['time'].values[last]) / 60, 1)} min"
    return [
        budget.table(errors.isel(time=last), when),
        Text(
            "The misfit is what the model left of campaigns that it had not seen; the coefficients are "
            "uncertain by what they were fitted to. Both are one draw for the whole prediction.",
            "note",
        ),
    ]


def notes(errors: xr.Dataset) -> list[Block]:
    """Return what was remarked of a dataset, and how complete it is."""
    found: list[Block] = [Text(note, "warning") for note in remarks(errors)]
    return [*found, *quality.sentences(errors, None)]
