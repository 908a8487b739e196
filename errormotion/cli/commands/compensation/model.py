"""``errormotion model``: fits a thermal model, predicts errors, and checks a model with other measurements."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import xarray as xr

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.cli.options import read_settings
from errormotion.cli.output import show, show_json, table
from errormotion.cli.page import Page, new_dataset
from errormotion.cli.progress import Bars
from errormotion.compensation.thermal_model import SCHEMA as MODEL_SCHEMA
from errormotion.compensation.thermal_model import Check, ThermalModel, ThermalModelSettings, check, fit
from errormotion.datasets.schemas import DOF, SCHEMA
from errormotion.datasets.storage.disk import reading
from errormotion.datasets.validation import explained
from errormotion.errors import DatasetError, RunError

SHOWN = (1e6, "um"), (1e6, "um"), (1e6, "um"), (1e6, "urad"), (1e6, "urad"), (1e6, "urad")


def make(campaigns: list[Path], out: Path, assignments: list[str], settings_file: Path | None, as_json: bool) -> None:
    """Fit a model to the errors of campaigns, and write it.

    Raises
    ------
    DatasetError
        The errors cannot be read or do not determine a model, or the file already exists.
    """
    new_dataset(out)
    settings = read_settings(ThermalModelSettings, settings_file, assignments)
    with Bars(as_json) as bars:
        bars.stage("fitting")
        with reading(", ".join(map(str, campaigns))):
            model = fit([errors_of(path) for path in campaigns], settings)
    model.save(out)
    ds = model.dataset
    removed = {name: float(value) for name, value in zip(DOF, ds["removed"].values, strict=True)}
    misfit = ds["misfit"].values
    if as_json:
        features = [feature.name for feature in model.features]
        answer = {"model": str(out), "variant": ds.attrs["variant"], "sensors": list(model.sensors)}
        show_json({"ok": True, **answer, "features": features, "removed": removed, "misfit": misfit.tolist()})
        return
    show(f"{out}: {ds.attrs['variant']} model of {ds.attrs['component']} from {ds.attrs['campaigns']} campaigns")
    show(f"  sensors: {', '.join(model.sensors) or 'none'}; {len(model.features)} features")
    rows = [
        [name, f"{100 * removed[name]:.0f}", f"{1.96 * factor * misfit[k]:.2g}", unit]
        for k, (name, (factor, unit)) in enumerate(zip(DOF, SHOWN, strict=True))
        if np.isfinite(misfit[k])
    ]
    show(f"  At {ds.attrs['validated']}:")
    show(table(["error", "removed/%", "interval 95 %: +-", "unit"], rows))


def predict(model: Path, data: Path, out: Path, as_json: bool) -> None:
    """Predict errors from temperatures and working parameters, and write them.

    Raises
    ------
    DatasetError
        The model or the data cannot be read, an input is missing, or the file already exists.
    """
    new_dataset(out)
    used, inputs = ThermalModel.load(model), dataset_of(data)
    with reading(f"{data} with {model}"), explained(data, inputs):
        predicted = used.predict(inputs)
    datasets.save(predicted, out)
    notes = predicted.em.notes
    if as_json:
        outside = float(predicted["outside"].mean())
        show_json(
            {"ok": True, "errors": str(out), "times": predicted.sizes["time"], "outside": outside, "notes": notes}
        )
        return
    component, method = predicted.attrs["component"], predicted.attrs["method"]
    show(f"{out}: errors of {component} at {predicted.sizes['time']} times by {method}")
    for note in notes:
        show(f"  note: {note}")


def check_model(model: Path, errors: Path, page: Page | None, as_json: bool) -> None:
    """Compare the errors that a model predicts with measured errors.

    Raises
    ------
    DatasetError
        The model or the errors cannot be read, or do not belong together.
    """
    used, measured = ThermalModel.load(model), errors_of(errors)
    with reading(f"{errors} with {model}"):
        found = check(used, measured)
    figures = {name: getattr(found, name) for name in ("rms", "remaining", "removed", "held")}
    if page is not None:
        from errormotion.compensation.thermal_model.report import write_model_report

        write_model_report(
            used.dataset, measured, page.file, predicted=found.predicted, figures=figures, form=page.form
        )
    if as_json:
        numbers = {name: dict(zip(DOF, values.tolist(), strict=True)) for name, values in figures.items()}
        written = {"report": str(page.file), "files": [str(each) for each in page.files]} if page is not None else {}
        show_json({"ok": True, "outside": found.outside, **numbers, **written})
        return
    show(text(found))
    for path in page.files if page is not None else ():
        show(str(path))


def text(found: Check) -> str:
    """Return a check as text."""
    rows = [
        [
            name,
            f"{factor * found.rms[k]:.2f}",
            f"{factor * found.remaining[k]:.2f}",
            f"{100 * found.removed[k]:.0f}",
            f"{100 * found.held[k]:.0f}",
            unit,
        ]
        for k, (name, (factor, unit)) in enumerate(zip(DOF, SHOWN, strict=True))
        if np.isfinite(found.rms[k])
    ]
    lines = [table(["error", "RMS", "remaining", "removed/%", "95 % held/%", "unit"], rows)]
    if found.outside:
        lines.append(f"{100 * found.outside:.0f} % of the times are outside the range of the training data.")
    return "\n".join(lines)


def errors_of(path: Path) -> xr.Dataset:
    """Return the error dataset of a file or of a run folder."""
    ds = dataset_of(path)
    if ds.attrs.get("schema") != SCHEMA:
        raise DatasetError(
            f"{path}: expected schema {SCHEMA}; found {ds.attrs.get('schema', 'none')}", code="schema.other"
        )
    return ds


def source_of(path: Path) -> xr.Dataset | ThermalModel:
    """Return the thermal model of a file, or the error dataset of a file or a run folder."""
    ds = dataset_of(path)
    with reading(path):
        return ThermalModel(ds) if ds.attrs.get("schema") == MODEL_SCHEMA else ds


def dataset_of(path: Path) -> xr.Dataset:
    """Return the dataset of a file; of a run folder, its errors, or its raw data if it has no error dataset."""
    if (path / "run.json").exists():
        folder = RunFolder.open(path)
        path = folder.errors or folder.raw
        if not path.exists():
            raise RunError(f"{folder.path}: the run has neither errors nor raw data yet", code="run.no_errors")
    with reading(path), datasets.load(path) as ds:
        if ds.attrs.get("schema") == SCHEMA:
            datasets.validate(ds)
        return ds.load()
