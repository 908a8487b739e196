"""Put a report together and write it: one file, no network, written beside and renamed."""

from __future__ import annotations

import glob
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Any

import xarray as xr
from jinja2 import Environment, PackageLoader, StrictUndefined

import errormotion
from errormotion import plugins
from errormotion.datasets.validation import validate
from errormotion.errors import DatasetError, RunError
from errormotion.report import generic, provenance
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import Cell, Part, Section, Source, Table
from errormotion.report.parts import beams
from errormotion.report.text import DASH
from errormotion.tolerances.conformity import judge
from errormotion.tolerances.table import Tolerances, from_run

#: Chapters of components that several methods measure; used where the method brings no chapter of its own.
COMPONENTS = {"beam": beams.part}

#: What a chapter raises where a dataset has not what the chapter shows.
_DO_NOT_FIT = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)


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
    sources = []
    for i, dataset in enumerate(datasets):
        _check_reportable(dataset)
        validate(dataset)
        sources.append(Source(dataset, raw, dict(run or {}), _provenance(dataset, run or {}), f"p{i + 1}"))
    tolerances = from_run(run or {})
    parts = [part for source in sources for part in _judged(chapters(source), source, tolerances)]
    parts[:1] = [_noted(part, run or {}) for part in parts[:1]]
    return write_page(sources, parts, Path(out), title)


def _judged(parts: list[Part], source: Source, tolerances: Tolerances | None) -> list[Part]:
    """Return the chapters of a source; the summary of the first one starts with the decision on the tolerances."""
    if tolerances is None or not parts or str(source.errors.attrs.get("schema")) != plugins.ERRORS_SCHEMA:
        return parts
    lines = judge(source.errors, tolerances).lines()
    return [replace(parts[0], summary=[*lines, *parts[0].summary]), *parts[1:]]


def _noted(part: Part, run: Mapping[str, Any]) -> Part:
    """Return a chapter that ends with the notes on its run."""
    notes, damaged = run.get("events") or ((), ())
    if not notes and not damaged:
        return part
    rows = [
        [_moment(each.at or str(run.get("created", DASH))), each.text, each.by, _moment(each.noted)] for each in notes
    ]
    head = ["time of the event", "note", "by", "noted"]
    table = Table("Notes on this run", head, rows, numeric=False, notes=damaged)
    return replace(part, sections=[*part.sections, Section("notes", "Notes", [table])])


def chapters(source: Source) -> list[Part]:
    """Return the chapters of one dataset: those of the plugin that made it, else the generic one."""
    owner = _owner(source.errors)
    try:
        own = list(owner.chapters(source)) if hasattr(owner, "chapters") else []
        if own:
            return own
        return [COMPONENTS.get(str(source.errors.attrs.get("component")), generic.part)(source, source.key)]
    except _DO_NOT_FIT as error:
        by = f"method '{source.errors.attrs['method']}'" if "method" in source.errors.attrs else "the plugin"
        raise DatasetError(
            f"The chapter of {by} cannot be written from this dataset ({type(error).__name__}: {error}). Its schema is "
            "followed; what the plugin adds to it is missing or has another form. If nobody changed the dataset, this "
            "is a defect of the plugin: the traceback is in the log."
        ) from error


def write_page(sources: Sequence[Source], parts: Sequence[Part], out: Path, title: str | None = None) -> Path:
    """Write chapters as one page.

    Parameters
    ----------
    sources : sequence of Source
        What the chapters were made from; the first one heads the page.
    parts : sequence of Part
    out : Path
        The file; an older one is replaced in one step.
    title : str, optional

    Returns
    -------
    Path
        ``out``.
    """
    return _write(_page(sources, parts, title), out)


def _owner(dataset: xr.Dataset) -> Any:
    """Return the plugin that a dataset comes from; None where there is none."""
    schema = str(dataset.attrs.get("schema"))
    if schema == plugins.ERRORS_SCHEMA:
        return plugins.owner_of_method(str(dataset.attrs.get("method")))
    return plugins.owner_of_schema(schema)


def _is_log(dataset: xr.Dataset) -> bool:
    """Return whether a dataset that is no error dataset has chapters of its own; raw data of a method have none."""
    owner = _owner(dataset)
    return isinstance(getattr(owner, "info", None), plugins.DatasetInfo) and hasattr(owner, "chapters")


def _kind_without_errors(dataset: xr.Dataset) -> str:
    """Return what a stored dataset is that has no report, and the command that shows it; empty for others."""
    owner = plugins.owner_of_schema(str(dataset.attrs.get("schema")))
    if not isinstance(getattr(owner, "info", None), plugins.DatasetInfo):
        return ""
    if hasattr(owner, "predictor"):
        return (
            "a model, which states no errors. Compare it with a measured campaign: errormotion model check MODEL "
            "ERRORS --report page.html; or predict errors and report these: errormotion model predict MODEL DATA"
        )
    if hasattr(owner, "chapters"):
        return ""
    return f"another kind of data: {owner.info.summary.rstrip('.')} ({dataset.attrs['schema']})"


def _check_reportable(dataset: xr.Dataset) -> None:
    missing = [name for name in (*FREEDOMS, "covariance") if name not in dataset]
    if missing and (kind := _kind_without_errors(dataset)):
        raise DatasetError(f"A report is made from error datasets, or from a log; this is {kind}")
    if missing and not _is_log(dataset):
        raise DatasetError(
            f"A report is made from error datasets, or from a log; this dataset lacks {', '.join(missing)}. "
            "Identify the raw dataset first."
        )


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
    from errormotion.datasets.files import events
    from errormotion.datasets.files.runfile import read_run

    folder = Path(run_folder)
    if not folder.is_dir():
        raise RunError(f"Expected a run folder, and there is none at {folder}.")
    files = sorted(folder.glob("errors/*/errors.nc"))
    raw = load(folder / "raw.zarr") if (folder / "raw.zarr").exists() else None
    log = raw if raw is not None and not files and _is_log(raw) else None
    if not files and log is None:
        raise RunError(
            f"{folder} holds no errors/*/errors.nc: nothing was identified yet. Run 'errormotion identify' first."
        )
    run: dict[str, Any] = {}
    if os.path.lexists(folder / "run.json"):
        run = dict(read_run(folder))
    run["events"] = events.read(folder)
    target = Path(out) if out is not None else folder / "report.html"
    if log is not None:
        return write_report(log, target, run=run)
    parts = []
    for path in files:
        errors = load(path)
        parts += [errors, *belonging(errors, path)]
    return write_report(parts, target, raw=raw, run=run)


def belonging(errors: xr.Dataset, file: Path) -> list[xr.Dataset]:
    """Return the datasets beside a file of errors that state its hash (`errors_hash`), such as an evaluation of it."""
    from errormotion.datasets import hash_dataset, load

    beside = [load(path) for path in sorted(file.parent.glob(f"{glob.escape(file.stem)}.*.nc"))]
    stated = [ds for ds in beside if "errors_hash" in ds.attrs]
    own = hash_dataset(errors) if stated else ""
    return [ds for ds in stated if ds.attrs["errors_hash"] == own]


def _provenance(dataset: xr.Dataset, run: Mapping[str, Any]) -> dict[str, Any]:
    """Return the provenance of a dataset; where it carries none, what its run says."""
    if "provenance" not in dataset.attrs:
        return {name: run[name] for name in ("instruments", "settings", "software") if run.get(name)}
    return provenance.read(dataset)


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
    return templates.get_template("report.html.j2").render(
        title=title or f"{machine}: {parts[0].title[0].lower()}{parts[0].title[1:]}",
        heading=title or parts[0].title,
        facts=_facts(first, machine),
        simulated=provenance.simulated(everything) or (_truth(sources)),
        replayed=provenance.replayed(everything),
        parts=parts,
        several=len(parts) > 1,
        kind=parts[0].kind,
        stated=any(part.stated for part in parts),
        identity=identity,
        version=errormotion.__version__,
        written=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    )


def _identity(source: Source) -> str:
    attributes = source.errors.attrs
    if "provenance" in attributes:
        return str(attributes["provenance"])
    return f"{source.run.get('id')} {attributes.get('start')} {dict(source.errors.sizes)}"


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
        *(method if "method" in attributes else []),
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
