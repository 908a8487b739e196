"""``errormotion add``: files of other software become a run of the record.

The files are copied first, into a folder that gets its name when the raw data are complete. Then the raw data are
identified and reported, as those of a measured run. However that ends, the files are kept; the same command continues.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import uuid4

import xarray as xr

from errormotion import datasets, plugins
from errormotion.campaign.folder import RunFolder, first_entries, now
from errormotion.campaign.runner import identify_run, report_run, settings_hash
from errormotion.campaign.storage.journal import cause_of, journal
from errormotion.datasets import provenance
from errormotion.datasets.files.events import instant
from errormotion.datasets.files.reading import parse_json
from errormotion.datasets.files.tomlfile import read_toml
from errormotion.datasets.maps.questions import Question
from errormotion.errors import DatasetError, RunError, code_of
from errormotion.plugins import Method
from errormotion.record.adding.differences import differences
from errormotion.record.adding.exclusive import exclusive
from errormotion.record.adding.machines import remember
from errormotion.record.adding.mapping import MapOfFiles, map_of_files, of_machine
from errormotion.record.adding.originals import KEPT, MAP, Original, keep, originals_of, run_of
from errormotion.record.adding.questions import Ask
from errormotion.record.adding.reading import owner_of, read_raw
from errormotion.record.adding.request import Request
from errormotion.record.adding.statement import Statement, copy_logo, load_statement
from errormotion.record.runs.listing import list_runs
from errormotion.tolerances.table import load_tolerances

log = logging.getLogger(__name__)

MAX_NAME = 40
"""Longest part of the name of a run folder that comes from a file, characters."""


@dataclass(frozen=True)
class Added:
    """The run of added files; ``known`` states that it was in the record already, ``notes`` are those of the import."""

    folder: RunFolder
    known: bool
    notes: tuple[str, ...] = ()


def add(
    request: Request,
    ask: Ask,
    *,
    report: Callable[[Path], Path] | None = None,
    stage: Callable[[str], None] = lambda name: None,  # noqa: ARG005
) -> Added:
    """Add files as a run, identify and report it.

    Parameters
    ----------
    request : Request
        The files, and what is stated about them.
    ask : callable
        Answers questions; see `errormotion.record.adding.questions`.
    report : callable, optional
        Writes the report of a run folder, and returns its path.
    stage : callable, optional
        Called with the name of each stage.

    Returns
    -------
    Added
        The run; that of an earlier call if the files are in the record, and nothing else is stated about them.

    Raises
    ------
    DatasetError
        A file cannot be read, an answer is missing, or statements contradict the data, or a run of the same files:
        nothing was added.
    RunError
        The identification failed: the run folder with the files and the raw data is kept, and the message states how
        to continue.
    """
    originals = originals_of(request.files)
    before = None if request.again else run_of(originals.values(), request.record)
    if before is not None and before.finished:
        if stated := differences(request, before):
            names = ", ".join(path.name for path in request.files)
            raise DatasetError(
                f"{names}: in the record already, {before.path}; not applied to this run: {', '.join(stated)}. Omit "
                "these options, or add once more by --again",
                code="add.known.differs",
            )
        return Added(before, known=True)
    work = _Adding(request, originals, ask, stage)
    if before is None:
        folder = _created(request, work)
    else:
        folder = before
        with folder.locked():
            folder.save(**work.fill(folder.path))
    with folder.locked(), journal(folder.log), _failures(folder, request):
        if issubclass(work.owner, Method):
            stage("identifying")
            identify_run(folder, work.owner(), work.settings)
            if not request.test:
                folder.save(test=f"{work.owner.info.id}-{_component(folder)}")
        if report is not None:
            stage("writing the report")
            report_run(folder, report)
        folder.save(status="finished", reason="")
    remember(request.runs, str(folder.data["bench"]["machine"]), work.schema, work.map.answers)
    return Added(folder, known=False, notes=work.notes)


def _created(request: Request, work: _Adding) -> RunFolder:
    """Return the new run folder.

    Raises
    ------
    DatasetError
        Another process has added the files meanwhile.
    """
    with ExitStack() as last:

        def fill(folder: Path) -> dict[str, Any]:
            entries = work.fill(folder)
            last.enter_context(exclusive(request.runs))  # until the folder has its name
            if not request.again and (other := run_of(work.originals.values(), list_runs([request.runs]))) is not None:
                names = ", ".join(path.name for path in request.files)
                raise DatasetError(
                    f"{names}: was added by another process meanwhile, {other.path}; --again adds it once more",
                    code="add.known.meanwhile",
                )
            return entries

        return RunFolder.create(request.runs, _name(request.files[0].stem), uuid4().hex[:8], {}, fill)


class _Adding:
    """The import of files into a run folder: the copies, the map, the raw data, and the entries of ``run.json``."""

    def __init__(
        self, request: Request, originals: Mapping[Path, Original], ask: Ask, stage: Callable[[str], None]
    ) -> None:
        self.request, self.originals, self.ask, self.stage = request, originals, ask, stage
        self.statement = load_statement(request.head) if request.head else Statement.model_validate(_NOTHING)
        if request.map is not None:
            read_toml(request.map)
        self.limits = load_tolerances(request.tolerances) if request.tolerances else None
        self.owner: Any = None
        self.settings: Any = None
        self.schema = ""
        self.map = MapOfFiles()
        self.notes: tuple[str, ...] = ()

    def fill(self, folder: Path) -> dict[str, Any]:
        """Write copies, map and raw data into a folder, and return the entries of its ``run.json``."""
        self.stage("copying the files")
        copies = keep(self.originals, folder)
        self.stage("reading the files")
        with _about(self.request.files, folder):
            self.map = map_of_files(self.request, copies, folder, self.ask)
            raw = read_raw(copies, self.map.file)
            self.owner = owner_of(raw)
            raw = self._stated(raw)
            entries = self._entries(raw)
        self.schema = str(raw.attrs["schema"])
        self.notes = (*self.map.notes, *map(str, _listed(raw, "import_notes")))
        self.stage("storing the raw data")
        datasets.save(raw, folder / "raw.zarr", overwrite=True)
        raw.close()
        if self.request.head is not None:
            copy_logo(self.statement, self.request.head, folder)
        return entries

    def _stated(self, raw: xr.Dataset) -> xr.Dataset:
        """Return the raw data with what was stated about them.

        Raises
        ------
        DatasetError
            A statement contradicts the data.
        """
        request = self.request
        found = {"imported": ", ".join(each.name for each in self.originals.values())}
        stated = str(raw.attrs.get("machine", "")).replace("unknown", "")
        known = "" if self.map.file is not None else stated
        if request.machine and known and request.machine.casefold() != known.casefold():
            raise DatasetError(
                f"--machine {request.machine}: the data are of the machine '{known}'; omit the option",
                code="add.machine.contradiction",
            )
        found["machine"] = known or request.machine or stated
        if not found["machine"]:
            question = of_machine(Question("machine", "", (), "", True), request.record.machines)
            found["machine"] = self.ask([question])["machine"]
        if request.axis:
            axis = str(raw.attrs.get("axis", request.axis))
            if axis != request.axis:
                raise DatasetError(
                    f"--axis {request.axis}: the data are of the axis {axis}; omit the option",
                    code="add.axis.contradiction",
                )
            found["axis"] = request.axis
        if request.measured:
            start = str(raw.attrs.get("start", request.measured))
            if not _is_same_time(start, request.measured):
                raise DatasetError(
                    f"--measured {request.measured}: the data start at {start}; omit the option",
                    code="add.measured.contradiction",
                )
            found["start"] = start
        if self.statement.operator:
            found["operator"] = self.statement.operator
        if self.statement.instruments and "instruments" not in raw.attrs:
            found["instruments"] = json.dumps(self.statement.records(), ensure_ascii=False)
        return raw.assign_attrs(found)

    def _entries(self, raw: xr.Dataset) -> dict[str, Any]:
        request, owner = self.request, self.owner
        start, source = _start(raw, request.files)
        entries = first_entries() | {
            "acquired": True,
            "test": request.test or owner.info.id,
            "bench": {"machine": raw.attrs["machine"]},
            KEPT: {
                "files": [each.plain() for each in self.originals.values()],
                "map": self.map.file.name if self.map.file is not None else None,
                "answers": self.map.given,
            },
            "created": start,
            "created_from": source,
            "added": now(),
            "method": {"id": ""},
            "operator": str(raw.attrs.get("operator", "")),
            "head": self.statement.stated(),
            "instruments": _listed(raw, "instruments"),
            "tolerances": self.limits.model_dump(mode="json") if self.limits else None,
            "errors": None,
            "results": None,
            "conformity": None,
        }
        if not issubclass(owner, Method):
            return entries
        if request.method and plugins.get("methods", request.method) is not owner:
            raise DatasetError(
                f"--method {request.method}: the data are of the method '{owner.info.id}'; omit the option",
                code="add.method.contradiction",
            )
        self.settings = request.settings(owner.Settings)
        settings = provenance.plain(provenance.of_evaluation(self.settings, raw))
        return entries | {
            "method": {"id": owner.info.id, "version": owner.info.version, "status": owner.info.status},
            "settings": settings,
            "settings_hash": settings_hash(settings, owner.info.id, owner.info.version),
        }


_NOTHING = {"schema": "errormotion.head/1"}


def _name(stem: str) -> str:
    """Return a text for the name of a run folder."""
    return re.sub(r"[^\w-]+", "-", stem, flags=re.ASCII).strip("-")[:MAX_NAME] or "file"


def _listed(raw: xr.Dataset, name: str) -> list[Any]:
    """Return the list in an attribute of JSON; empty if there is none."""
    try:
        found = parse_json(str(raw.attrs.get(name) or "[]"))
    except ValueError:
        return []
    return found if isinstance(found, list) else []


def _component(folder: RunFolder) -> str:
    """Return the component to which the errors of a run belong, such as an axis."""
    with datasets.load(folder.errors or folder.path) as errors:
        return str(errors.attrs["component"])


def _start(raw: xr.Dataset, files: Sequence[Path]) -> tuple[str, str]:
    """Return the start of the measurement, and where it is from if nothing states it."""
    stated = str(raw.attrs.get("start", ""))
    if stated:
        return stated, ""
    changed = min(path.stat().st_mtime for path in files)
    return datetime.fromtimestamp(changed, UTC).isoformat(timespec="seconds"), "last change of the file"


def _is_same_time(one: str, other: str) -> bool:
    """Return whether two times are the same within a second."""
    first, second = instant(one), instant(other)
    if first is None or second is None:
        return one == other
    return abs((first - second).total_seconds()) < 1


@contextmanager
def _about(files: Sequence[Path], folder: Path) -> Iterator[None]:
    """Name the files in errors, instead of their copies in a folder."""
    try:
        yield
    except DatasetError as error:
        text = str(error)
        for path in files:
            text = text.replace(str(folder / KEPT / path.name), str(path))
        text = text.replace(str(folder / MAP), "the map")
        error.args = (text if text.startswith("--") or files[0].name in text else f"{files[0]}: {text}",)
        raise


@contextmanager
def _failures(folder: RunFolder, request: Request) -> Iterator[None]:
    """Record the failure of a run in its ``run.json`` and its log, and state how to continue."""
    again = "Add the same files again, with other options or answers if necessary, to continue this run."
    try:
        yield
    except KeyboardInterrupt as error:
        folder.step("stop", "interrupted")
        folder.save(status="interrupted", reason="stopped by the operator")
        raise KeyboardInterrupt(f"The files are kept in {folder.path}. {again}") from error
    except Exception as error:
        log.exception("failed")
        folder.step("stop", "failed", reason=cause_of(error))
        folder.save(status="failed", reason=cause_of(error))
        names = ", ".join(path.name for path in request.files)
        raise RunError(
            f"{names}: {cause_of(error)}\nThe files and the raw data are kept in {folder.path}; the log is "
            f"{folder.log}. {again}",
            code=code_of(error, "add.failed"),
        ) from error
