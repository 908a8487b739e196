"""Assemble a report and write it: one self-contained file, replaced in one step."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import xarray as xr

from errormotion import plugins
from errormotion.datasets.files.reading import leaves, visible
from errormotion.datasets.files.writing import whole
from errormotion.datasets.validation import validate
from errormotion.errors import DatasetError, RunError
from errormotion.report import provenance
from errormotion.report.budget import FREEDOMS
from errormotion.report.document import Part, Section, Source, Table
from errormotion.report.exports import pdf, xlsx
from errormotion.report.exports.tables import sheet, write_csv
from errormotion.report.page import logo
from errormotion.report.page.assemble import Page, page
from errormotion.report.page.head import Head, head_of, moment
from errormotion.report.page.language import Catalogue
from errormotion.report.page.verdict import verdict
from errormotion.report.parts import beams, generic
from errormotion.report.text import DASH, written_in
from errormotion.tolerances.conformity import Conformity, judge
from errormotion.tolerances.table import Tolerances, from_run


@dataclass(frozen=True)
class Form:
    """Form of a report.

    ``language`` and ``paper`` replace those of the campaign; ``also`` lists further forms: ``pdf``, ``csv`` (a
    folder), ``xlsx``.
    """

    language: str = ""
    paper: str = ""
    also: tuple[str, ...] = ()

    def of(self, head: Head) -> Head:
        """Return a head in this language and for this paper."""
        return replace(head, language=self.language or head.language, paper=self.paper or head.paper)

    def beside(self, page: Path) -> list[Path]:
        """Return the files and folders that are written in addition to a page."""
        return [
            page.with_name(f"{page.stem}-tables") if kind == "csv" else page.with_suffix(f".{kind}")
            for kind in self.also
        ]


PLAIN = Form()
"""Only the page."""

#: Chapters of components that several methods measure, for methods without their own chapters.
COMPONENTS = {"beam": beams.part}

#: Exceptions of a chapter if a dataset lacks contents that the chapter shows.
_DO_NOT_FIT = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)


def write_report(
    errors: xr.Dataset | Sequence[xr.Dataset],
    out: Path,
    *,
    raw: xr.Dataset | None = None,
    title: str | None = None,
    run: Mapping[str, Any] | None = None,
    form: Form = PLAIN,
) -> Path:
    """Write the report of one or several error datasets as one HTML file.

    Parameters
    ----------
    errors : Dataset or sequence of Dataset
        Error datasets, one chapter each, or logs of a monitor.
    out : Path
        The file, ``*.html``; an older one is replaced in one step.
    raw : Dataset, optional
        The raw dataset that they come from, for the counts of lost samples; its samples are not read.
    title : str, optional
        Title of the report; by default made from the machine and the test.
    run : mapping, optional
        Further data of the measurement, such as the content of ``run.json``: machine, test, operator, start.
    form : Form, optional
        Language, paper and further files.

    Returns
    -------
    Path
        ``out``.

    Raises
    ------
    DatasetError
        There is no dataset, one is not an error dataset, or the name of the file is not that of a page.
    RunError
        The page was written, but its PDF could not be.
    """
    target = page_file(Path(out))
    datasets = [errors] if isinstance(errors, xr.Dataset) else list(errors)
    if not datasets:
        raise DatasetError("Expected at least one error dataset for a report; found none.", code="report.no_datasets")
    sources, tolerances = [], from_run(run or {})
    for i, dataset in enumerate(datasets):
        _check_reportable(dataset)
        validate(dataset)
        sources.append(
            Source(dataset, raw, dict(run or {}), _provenance(dataset, run or {}), f"p{i + 1}", _limits(tolerances))
        )
    head = form.of(head_of(run or {}))
    texts = [catalogue_of(source, head.language) for source in sources]
    with written_in(head.language, Catalogue(head.language, texts).word):
        parts = [part for source in sources for part in chapters(source)]
        parts[:1] = [_noted(part, run or {}) for part in parts[:1]]
        decision = verdict(_judged(sources, tolerances)) if tolerances is not None else None
        found = page(sources, parts, title, head=head, decision=decision, texts=texts)
    return _finished(found, target, form, head)


def page_file(path: Path) -> Path:
    """Return the file of a page, whose further forms stand beside it under the same name.

    Raises
    ------
    DatasetError
        The name does not end in .html: the PDF or the workbook of a page would replace the page.
    """
    if path.suffix.lower() not in (".html", ".htm"):
        raise DatasetError(
            f"{path}: expected a name that ends in .html, that of the page; its PDF (--pdf), workbook and tables are "
            "written beside it under the same name",
            code="report.name.ending",
        )
    return path


def _finished(found: Page, out: Path, form: Form, head: Head) -> Path:
    """Write a page and its further files."""
    target = _write(found.html, out)
    sheets = [sheet(table, k, section) for k, (section, table) in enumerate(found.tables, 1)]
    for path in form.beside(target):
        if path.suffix == ".pdf":
            pdf.write(target, path)
        elif path.suffix == ".xlsx":
            xlsx.write(sheets, path)
        else:
            write_csv(sheets, path, comma=head.language == "de")
    return target


def catalogue_of(source: Source, language: str) -> Mapping[str, str]:
    """Return the catalogue of the plugin that made a dataset; empty if it has none."""
    owner = _owner(source.errors)
    return owner().texts(language) if language and owner is not None else {}


def _limits(tolerances: Tolerances | None) -> dict[str, tuple[float, float]]:
    stated = {} if tolerances is None else {**tolerances.figures, **tolerances.freedoms}
    return {name: limit.interval for name, limit in stated.items()}


def _judged(sources: Sequence[Source], tolerances: Tolerances) -> list[Conformity]:
    """Return the decision on each error dataset."""
    stated = [source.errors for source in sources if str(source.errors.attrs.get("schema")) == plugins.ERRORS_SCHEMA]
    return [judge(errors, tolerances) for errors in stated]


def _noted(part: Part, run: Mapping[str, Any]) -> Part:
    """Return a chapter with the notes on its run as its last section."""
    notes, damaged = run.get("events") or ((), ())
    if not notes and not damaged:
        return part
    rows = [
        [moment(each.at or str(run.get("created", DASH))), each.text, each.by, moment(each.noted)] for each in notes
    ]
    head = ["time of the event", "note", "by", "noted"]
    table = Table("Notes on this run", head, rows, numeric=False, notes=damaged)
    return replace(part, sections=[*part.sections, Section("notes", "Notes", [table])])


def chapters(source: Source) -> list[Part]:
    """Return the chapters of one dataset: those of the plugin that made it, else the generic one."""
    owner = _owner(source.errors)
    try:
        own = [] if owner is None else list(owner().chapters(source))
        if own:
            return own
        return [COMPONENTS.get(str(source.errors.attrs.get("component")), generic.part)(source, source.key)]
    except _DO_NOT_FIT as error:
        file = Path(str(source.errors.encoding.get("source", ""))).name
        by = f"method '{source.errors.attrs['method']}'" if "method" in source.errors.attrs else "the plugin"
        raise DatasetError(
            f"The chapter of {by} cannot be written from {file or 'this dataset'} ({type(error).__name__}: {error}). "
            "The dataset conforms to its schema, but contents that the plugin adds are missing or have another form. "
            "If the dataset was not changed, this is a defect of the plugin: the traceback is in the log.",
            code="report.chapter.failed",
        ) from error


def write_page(
    sources: Sequence[Source],
    make: Callable[[], Sequence[Part]],
    out: Path,
    title: str | None = None,
    *,
    form: Form = PLAIN,
    texts: Callable[[str], Mapping[str, str]] | None = None,
) -> Path:
    """Write chapters as one page.

    Parameters
    ----------
    sources : sequence of Source
        Sources of the chapters; the head of the page is that of the first one.
    make : callable
        Returns the chapters; called once, while numbers are written in the language of the page.
    out : Path
        The file, ``*.html``; an older one is replaced in one step.
    title : str, optional
        By default made from the machine and the title of the first chapter.
    form : Form, optional
        Language, paper and further files.
    texts : callable, optional
        ``texts(language)``: a catalogue of the chapters in addition to those of the plugins of the datasets.

    Returns
    -------
    Path
        ``out``.

    Raises
    ------
    DatasetError
        The name of the file is not that of a page.
    RunError
        The page was written, but its PDF could not be.
    """
    target = page_file(Path(out))
    head = form.of(Head())
    catalogues = [catalogue_of(source, head.language) for source in sources]
    catalogues += [texts(head.language)] if texts is not None else []
    with written_in(head.language, Catalogue(head.language, catalogues).word):
        found = page(sources, make(), title, head=head, texts=catalogues)
    return _finished(found, target, form, head)


def _owner(dataset: xr.Dataset) -> Any:
    """Return the plugin that made a dataset; None if it is unknown."""
    schema = str(dataset.attrs.get("schema"))
    if schema == plugins.ERRORS_SCHEMA:
        return plugins.owner_of_method(str(dataset.attrs.get("method")))
    return plugins.owner_of_schema(schema)


def _is_log(dataset: xr.Dataset) -> bool:
    """Return whether a dataset without errors has its own chapters, such as a log; raw data of a method have none."""
    owner = _owner(dataset)
    return _is_dataset_plugin(owner) and plugins.states(owner, "chapters")


def _is_dataset_plugin(owner: Any) -> bool:
    return owner is not None and issubclass(owner, plugins.DatasetPlugin)


def _kind_without_errors(dataset: xr.Dataset) -> str:
    """Return the kind of a dataset without report, and the command for it; empty for others."""
    owner = plugins.owner_of_schema(str(dataset.attrs.get("schema")))
    if not _is_dataset_plugin(owner):
        return ""
    if plugins.states(owner, "predictor"):
        return (
            "a model, which contains no errors. Compare it with a measured campaign: errormotion model check MODEL "
            "ERRORS --report page.html; or predict errors and report these: errormotion model predict MODEL DATA"
        )
    if plugins.states(owner, "chapters"):
        return ""
    return f"another kind of data: {owner.info.summary.rstrip('.')} ({dataset.attrs['schema']})"


def _check_reportable(dataset: xr.Dataset) -> None:
    missing = [name for name in (*FREEDOMS, "covariance") if name not in dataset]
    if missing and (kind := _kind_without_errors(dataset)):
        raise DatasetError(
            f"A report is made from error datasets, or from a log; this is {kind}", code="report.dataset.kind"
        )
    if missing and not _is_log(dataset):
        raise DatasetError(
            f"A report is made from error datasets, or from a log; this dataset lacks {', '.join(missing)}. "
            "Identify the raw dataset first.",
            code="report.dataset.variables",
        )


def _write(text: str, out: Path) -> Path:
    """Write a page; an older one is replaced in one step."""
    with whole(out) as beside:
        beside.write_text(text, encoding="utf-8")
    return out


def write_run_report(run_folder: Path, out: Path | None = None, *, form: Form = PLAIN) -> Path:
    """Write the report of a run folder from its error datasets, its raw dataset and ``run.json``.

    Parameters
    ----------
    run_folder : Path
        Of a test, or of a monitor.
    out : Path, optional
        The file; by default ``report.html`` in the folder.
    form : Form, optional
        Language, paper and further files.

    Raises
    ------
    RunError
        The folder does not exist, or contains no ``errors/*/errors.nc``.
    DatasetError
        A result cannot be read.
    """
    from errormotion.datasets import load
    from errormotion.datasets.files import events
    from errormotion.datasets.files.runfile import read_run

    folder = Path(run_folder)
    if not folder.is_dir():
        raise RunError(f"Expected a run folder at {folder}; found none.", code="run.folder.not_found")
    files = [file for file in visible(folder, "errors/*/errors.nc") if not leaves(folder, file)]
    stored = folder / "raw.zarr"
    raw = load(stored) if stored.exists() and not leaves(folder, stored) else None
    log = raw if raw is not None and not files and _is_log(raw) else None
    if not files and log is None:
        raise RunError(
            f"{folder} contains no errors/*/errors.nc. Run 'errormotion identify' first.", code="run.no_errors"
        )
    run: dict[str, Any] = {}
    if os.path.lexists(folder / "run.json"):
        run = dict(read_run(folder))
    run["events"] = events.read(folder)
    run["logo"] = logo.of_folder(folder)
    target = Path(out) if out is not None else folder / "report.html"
    if log is not None:
        return write_report(log, target, run=run, form=form)
    parts = []
    for path in files:
        errors = load(path)
        parts += [errors, *belonging(errors, path)]
    return write_report(parts, target, raw=raw, run=run, form=form)


def belonging(errors: xr.Dataset, file: Path) -> list[xr.Dataset]:
    """Return the datasets in the folder of a file of errors with its hash (`errors_hash`), such as its evaluation."""
    from errormotion.datasets import hash_dataset, load
    from errormotion.datasets.storage.disk import reading

    files = sorted(file.parent.glob(f"{glob.escape(file.stem)}.*.nc"))
    beside = {path: load(path) for path in files if not leaves(file.parent, path)}
    stated = {path: ds for path, ds in beside.items() if "errors_hash" in ds.attrs}
    own = hash_dataset(errors) if stated else ""
    found = {path: ds for path, ds in stated.items() if ds.attrs["errors_hash"] == own}
    for path, ds in found.items():
        with reading(path):
            validate(ds)
    return list(found.values())


def _provenance(dataset: xr.Dataset, run: Mapping[str, Any]) -> dict[str, Any]:
    """Return the provenance of a dataset; if it has none, that of its run."""
    if "provenance" not in dataset.attrs:
        return {name: run[name] for name in ("instruments", "settings", "software") if run.get(name)}
    return provenance.read(dataset)
