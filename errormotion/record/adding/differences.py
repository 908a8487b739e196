"""What is stated about files that are in the record already, otherwise than for the run that they have there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from errormotion import datasets, plugins
from errormotion.campaign.folder import RunFolder
from errormotion.datasets import provenance
from errormotion.datasets.files.events import instant
from errormotion.datasets.files.tomlfile import read_toml
from errormotion.datasets.files.tomltext import value_of
from errormotion.errors import DatasetError
from errormotion.record.adding.originals import KEPT, MAP
from errormotion.record.adding.request import Request
from errormotion.record.adding.statement import load_statement
from errormotion.tolerances.table import load_tolerances


def differences(request: Request, folder: RunFolder) -> list[str]:
    """Return the options of a request that do not hold for a run, with what holds for it, where that is known."""
    data = folder.data
    machine, method = str(data["bench"].get("machine", "")), str(data["method"].get("id", ""))
    found = []
    if request.machine and request.machine != machine:
        found.append(f"--machine {request.machine} (there {machine})")
    if request.axis and request.axis != (axis := _axis(folder)):
        found.append(f"--axis {request.axis} (there {axis or 'none'})")
    if request.method and request.method != method:
        found.append(f"--method {request.method} (there {method or 'none'})")
    if request.test and request.test != data["test"]:
        found.append(f"--test {request.test} (there {data['test']})")
    if request.measured and instant(request.measured) != instant(str(data.get("created", ""))):
        found.append(f"--measured {request.measured} (there {data.get('created')})")
    found += _files(request, folder)
    found += [f"--set {key}={text}" for key, text in request.answers.items() if not _holds(folder, key, text)]
    return found + _settings(request, data, method)


def _axis(folder: RunFolder) -> str:
    if folder.raw is None:
        return ""
    with datasets.load(folder.raw) as raw:
        return str(raw.attrs.get("axis", ""))


def _files(request: Request, folder: RunFolder) -> list[str]:
    """Return the files of a request with another content than that in a run."""
    found = []
    kept = folder.path / MAP
    if request.map is not None and (not kept.is_file() or kept.read_bytes() != request.map.read_bytes()):
        found.append(f"--map {request.map}")
    if request.head is not None:
        statement = load_statement(request.head)
        head = provenance.plain(statement.stated()) == provenance.plain(folder.data.get("head") or {})
        if not head or statement.operator != folder.data.get("operator", ""):
            found.append(f"--head {request.head}")
    if request.tolerances is not None:
        limits = load_tolerances(request.tolerances).model_dump(mode="json")
        if limits != folder.data.get("tolerances"):
            found.append(f"--tolerances {request.tolerances}")
    return found


def _holds(folder: RunFolder, key: str, text: str) -> bool:
    """Return whether an answer was given for a run, or stands in its map."""
    kept = folder.data.get(KEPT)
    given = kept.get("answers") if isinstance(kept, Mapping) else None
    if isinstance(given, Mapping) and key in given:
        return bool(given[key] == text)
    if not text:
        return True
    try:
        content: Any = read_toml(folder.path / MAP)
    except DatasetError:
        return False
    head, _, name = key.partition(".")
    own = content.get(head)
    return isinstance(own, Mapping) and name in own and own[name] in (text, value_of(text))


def _settings(request: Request, data: Mapping[str, Any], method: str) -> list[str]:
    """Return the settings that are stated with other values than those of a run."""
    if not method:
        return []
    owner: Any = plugins.get("methods", method)
    settings = request.settings(owner.Settings)
    plain, there = settings.model_dump(mode="json"), data.get("settings", {})
    return [f"--set {name}=..." for name in sorted(settings.model_fields_set) if plain[name] != there.get(name)]
