"""``run.json``, the description of a run; the types of its keys are checked when it is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from errormotion.datasets.files import tomlfile
from errormotion.datasets.files.reading import parse_json, read_bytes
from errormotion.errors import RunError

FILE = "run.json"
SCHEMA = "errormotion.run/1"
MAX_FILE = 16 << 20
"""Largest size of a run.json, bytes."""


class _Table(BaseModel):
    model_config = ConfigDict(extra="allow", strict=True, allow_inf_nan=False)


class _Campaign(_Table):
    name: str = ""
    file: str = ""
    folder: str = ""
    sha256: str = ""
    text: str = ""
    tests: list[str] = []


class _Bench(_Table):
    name: str = ""
    machine: str = ""
    file: str = ""
    text: str = ""


class _Method(_Table):
    id: str = ""


class _Event(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)
    time: float = Field(ge=0.0, le=1e10)
    spindle_speed: float | None = Field(default=None, ge=0.0)
    compensation: dict[str, bool] | None = None


class _Clock(_Table):
    start: str = ""
    time: float = Field(default=0.0, ge=0.0, le=1e10)
    schedule: list[_Event] = []


class _Step(_Table):
    step: str
    outcome: str
    time: str


class _Samples(_Table):
    dim: str = ""
    count: int = 0
    dropped: int = 0
    invalid: dict[str, int] = {}


class _File(_Table):
    name: str
    sha256: str


class _Imported(_Table):
    files: list[_File] = []


class _Run(_Table):
    id: str = ""
    test: str = ""
    created: str = ""
    status: str = ""
    reason: str = ""
    acquired: bool = False
    campaign: _Campaign = _Campaign()
    bench: _Bench = _Bench()
    method: _Method = _Method()
    settings: dict[str, Any] = {}
    inputs: dict[str, Any] = {}
    instruments: list[dict[str, Any]] = []
    software: dict[str, Any] = {}
    samples: _Samples | None = None
    errors: str | None = None
    report: str | None = None
    steps: list[_Step] = []
    clock: _Clock = _Clock()
    results: list[dict[str, Any]] | None = None
    tolerances: dict[str, Any] | None = None
    conformity: dict[str, Any] | None = None
    head: dict[str, Any] | None = None
    imported: _Imported | None = None


class State(dict[str, Any]):
    """An object of a ``run.json``; a missing key raises an error that names the file."""

    file: Path = Path(FILE)

    def __missing__(self, key: str) -> Any:
        raise RunError(f"{self.file}: expected the key '{key}'; found none", code="run.file.key.missing")


def _instead(folder: Path, error: OSError) -> str:
    """Return what is found instead of a ``run.json`` that cannot be read."""
    if not isinstance(error, FileNotFoundError):
        return str(error.strerror)
    if not folder.is_dir():
        return "there is no such folder"
    runs = sorted(each.parent.name for each in folder.glob(f"*/{FILE}"))
    return f"found the folders of runs {', '.join(runs[:3])}" + (" ..." if runs[3:] else "") if runs else "found none"


def read_run(folder: Path) -> State:
    """Return the content of the ``run.json`` of a folder.

    Raises
    ------
    RunError
        It cannot be read, is too large, is not JSON, has another schema, or keys of other types; all mistakes in one
        message.
    """
    file = folder / FILE
    try:
        content = parse_json(read_bytes(file, MAX_FILE))
    except OSError as error:
        raise RunError(
            f"{folder}: expected a run folder with a {FILE}; {_instead(folder, error)}", code="run.folder.not_found"
        ) from error
    except ValueError as error:
        raise RunError(
            f"{file}: is not valid JSON ({error}); restore it from a copy, "
            "or identify raw.zarr with 'errormotion identify'",
            code="run.file.no_json",
        ) from error
    if not isinstance(content, dict) or content.get("schema") != SCHEMA:
        what = content.get("schema") if isinstance(content, dict) else type(content).__name__
        raise RunError(f"{file}: expected schema '{SCHEMA}'; found {what!r:.100}", code="run.file.schema")
    mistakes = tomlfile.check(content, _Run, edge=False)[1]
    if mistakes:
        raise RunError(tomlfile.report(file, mistakes), code="run.file.mistakes")
    return _stated(content, file)


def _stated(table: dict[str, Any], file: Path) -> State:
    state = State({key: _stated(each, file) if isinstance(each, dict) else each for key, each in table.items()})
    state.file = file
    return state
