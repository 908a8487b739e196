"""Put a report together and write it: one file, no network, written beside and renamed."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any

import xarray as xr
from jinja2 import Environment, PackageLoader, StrictUndefined

import errormotion
from errormotion.campaign.monitor.report import chapter as monitor
from errormotion.compensation.thermal_model.report import chapter as thermal_model
from errormotion.compensation.thermal_model.report import check as thermal_model_check
from errormotion.errors import DatasetError, RunError
from errormotion.methods.beam_direction.report import chapter as beam_direction
from errormotion.methods.crossbeam_scan.report import chapter as crossbeam
from errormotion.methods.crossbeam_scan.report import pose as crossbeam_pose
from errormotion.methods.multilateration.report import chapter as multilateration
from errormotion.methods.normal_vector.report import chapter as normal_vector
from errormotion.methods.spindle_drift.report import beams as beam
from errormotion.methods.spindle_drift.report import chapter as spindle
from errormotion.report import generic, provenance
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import Cell, Part, Source, Table
from errormotion.report.text import DASH

Builder = Callable[[Source, str], Part]

#: Who writes the chapter of a component; every other component gets the generic one.
BUILDERS: dict[str, Builder] = {"spindle": spindle.part, "beam": beam.part}


def write_report(
    errors: xr.Dataset | Sequence[xr.Dataset],
    out: Path,
    *,
    raw: xr.Dataset | None = None,
    title: str | None = None,
    run: Mapping[str, Any] | None = None,
) -> Path:
    """Write the report of one or several error datasets as one HTML file.

    Parameters
    ----------
    errors : Dataset or sequence of Dataset
        Error datasets, one chapter each; the log of a monitor is a chapter too.
    out : Path
        The file; an older one is replaced in one step.
    raw : Dataset, optional
        The raw dataset that they come from: for counts of lost samples; its samples are not read.
    title : str, optional
        Title of the report; without it, made of the machine and what was tested.
    run : mapping, optional
        What else is known of the measurement, such as the content of ``run.json``: machine, test, operator, start.

    Returns
    -------
    Path
        ``out``.

    Raises
    ------
    DatasetError
        No dataset, or one that is no error dataset.
    """
    datasets = [errors] if isinstance(errors, xr.Dataset) else list(errors)
    if not datasets:
        raise DatasetError("A report needs at least one error dataset, and none was given.")
    for dataset in datasets:
        if monitor.is_log(dataset):
            continue
        missing = [name for name in (*FREEDOMS, "covariance") if name not in dataset]
        if missing:
            raise DatasetError(
                f"A report is made from error datasets, or from a monitor's log; this one lacks {', '.join(missing)}. "
                "Identify the raw dataset first."
            )
    sources = [Source(dataset, raw, dict(run or {}), _provenance(dataset, run or {})) for dataset in datasets]
    parts = [_builder(source.errors)(source, f"p{i + 1}") for i, source in enumerate(sources)]
    return _write(_page(sources, parts, title), Path(out))


def write_model_report(
    model: xr.Dataset, measured: xr.Dataset, out: Path, *, predicted: xr.Dataset, figures: Mapping[str, Any]
) -> Path:
    """Write a page that lays a thermal model against a measured campaign.

    Parameters
    ----------
    model : Dataset
        Schema ``errormotion.model.thermal/1``.
    measured : Dataset
        Error dataset of a campaign that the model was not made of.
    out : Path
        The file; an older one is replaced in one step.
    predicted : Dataset
        What the model predicts of that campaign.
    figures : mapping
        What the comparison found: ``rms``, ``remaining``, ``removed`` and ``held``, six numbers each.

    Returns
    -------
    Path
        ``out``.
    """
    source = Source(predicted, None, {}, provenance.read(model))
    made = thermal_model_check.part(source, "p1", model, measured, figures)
    known = [Source(measured, None, {}, provenance.read(measured)), source]
    return _write(_page(known, [made], None), Path(out))


def _write(page: str, out: Path) -> Path:
    """Write a page beside its place, and rename it."""
    beside = out.with_name(out.name + ".part")
    try:
        beside.write_text(page, encoding="utf-8")
        os.replace(beside, out)
    finally:
        beside.unlink(missing_ok=True)
    return out


def write_run_report(run_folder: Path, out: Path | None = None) -> Path:
    """Write the report of a run folder from its error datasets, its raw dataset and ``run.json``.

    Parameters
    ----------
    run_folder : Path
        Of a test, or of a monitor.
    out : Path, optional
        The file; without it, ``report.html`` in the folder.

    Raises
    ------
    RunError
        The folder does not exist, or holds no ``errors/*/errors.nc``.
    DatasetError
        A result cannot be read.
    """
    from errormotion.datasets import load

    folder = Path(run_folder)
    if not folder.is_dir():
        raise RunError(f"Expected a run folder, and there is none at {folder}.")
    files = sorted(folder.glob("errors/*/errors.nc"))
    raw = load(folder / "raw.zarr") if (folder / "raw.zarr").exists() else None
    log = raw if raw is not None and not files and monitor.is_log(raw) else None
    if not files and log is None:
        raise RunError(
            f"{folder} holds no errors/*/errors.nc: nothing was identified yet. Run 'errormotion identify' first."
        )
    run: dict[str, Any] = {}
    if (folder / "run.json").is_file():
        try:
            run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        except ValueError as error:
            raise RunError(
                f"{folder / 'run.json'} is no JSON: {error}. Restore it, or remove it to report without."
            ) from error
    target = Path(out) if out is not None else folder / "report.html"
    if log is not None:
        return write_report(log, target, run=run)
    return write_report([load(path) for path in files], target, raw=raw, run=run)


def _provenance(dataset: xr.Dataset, run: Mapping[str, Any]) -> dict[str, Any]:
    """Return where a dataset comes from; of a log, what its run says."""
    if monitor.is_log(dataset):
        return {name: run[name] for name in ("instruments", "settings", "software") if run.get(name)}
    return provenance.read(dataset)


def _builder(errors: xr.Dataset) -> Builder:
    if monitor.is_log(errors):
        return monitor.part
    if crossbeam.is_campaign(errors):
        return crossbeam.part
    if crossbeam_pose.is_pose(errors):
        return crossbeam_pose.part
    if beam_direction.is_direction(errors):
        return beam_direction.part
    if multilateration.is_multilateration(errors):
        return multilateration.part
    if normal_vector.is_normal_vector(errors):
        return normal_vector.part
    if thermal_model.is_prediction(errors):
        return thermal_model.part
    return BUILDERS.get(str(errors.attrs.get("component")), generic.part)


def _page(sources: Sequence[Source], parts: Sequence[Part], title: str | None) -> str:
    first = sources[0]
    attributes = first.errors.attrs
    everything = [(s.provenance, s.run, dict(s.raw.attrs) if s.raw is not None else {}) for s in sources]
    machine = str(attributes.get("machine", "unknown machine"))
    templates = Environment(
        loader=PackageLoader("errormotion.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.tests["table"] = lambda block: isinstance(block, Table)
    templates.tests["cell"] = lambda value: isinstance(value, Cell)
    templates.filters["kind"] = lambda block: type(block).__name__.lower()
    identity = sha256("".join(map(_identity, sources)).encode()).hexdigest()[:12]
    logs = all(monitor.is_log(source.errors) for source in sources)
    return templates.get_template("report.html.j2").render(
        title=title or f"{machine}: {parts[0].title[0].lower()}{parts[0].title[1:]}",
        heading=title or parts[0].title,
        facts=_facts(first, machine),
        simulated=provenance.simulated(everything) or (_truth(sources)),
        replayed=provenance.replayed(everything),
        parts=parts,
        several=len(parts) > 1,
        kind="Log" if logs else "Test report",
        stated=not logs,
        identity=identity,
        version=errormotion.__version__,
        written=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    )


def _identity(source: Source) -> str:
    if monitor.is_log(source.errors):
        attributes = source.errors.attrs
        return f"{source.run.get('id')} {attributes.get('start')} {source.errors.sizes['time']}"
    return str(source.errors.attrs.get("provenance", ""))


def _truth(sources: Sequence[Source]) -> str:
    if any(source.errors.attrs.get("method") == "twin" for source in sources):
        return "the values are the truth of a virtual machine"
    return ""


def _facts(source: Source, machine: str) -> list[tuple[str, str]]:
    """Return what heads the report: who measured what, where and when, as far as it is known."""
    errors, run = source.errors, source.run

    def known(*names: str) -> str:
        for holder in (run, source.provenance, errors.attrs, errors["time"].attrs if "time" in errors.coords else {}):
            for name in names:
                if name in holder and not isinstance(holder[name], (Mapping, list)) and holder[name] not in (None, ""):
                    return provenance.text(holder[name])
        return DASH

    attributes, test = errors.attrs, known("test", "name")
    method = [
        ("Method", f"{attributes.get('method', DASH)}, version {attributes.get('method_version', DASH)}"),
        ("Reference state", str(attributes.get("reference", DASH))),
    ]
    instruments = provenance.instruments(source.provenance)
    return [
        ("Machine", machine),
        ("Test", test if test != DASH else str(attributes.get("iso_test", DASH))),
        ("Measured", _moment(known("started", "start", "created"))),
        ("Operator", known("operator")),
        *([] if monitor.is_log(errors) else method),
        ("Run", known("id", "run")),
        ("Instruments", "; ".join(_instrument(row) for row in instruments) or DASH),
    ]


def _instrument(row: Mapping[str, str]) -> str:
    made = f"{row['manufacturer']} {row['model'] or row['name']}".strip()
    return f"{made}, serial number {row['serial_number']}" if row["serial_number"] else made


def _moment(text: str) -> str:
    """Return an ISO 8601 time as people read it; any other text as it is."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return text
    if moment.tzinfo is None:
        return moment.strftime("%Y-%m-%d %H:%M")
    return moment.astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")
