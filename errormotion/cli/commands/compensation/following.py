"""``errormotion compensate status`` and ``stop``: compensations that other processes work on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from errormotion.campaign.compensation.following import AUDIT, compensations, is_working, read_status, request_stop
from errormotion.cli.output import show, show_json, table
from errormotion.compensation.online.audit import verify
from errormotion.errors import CompensationError


def status(place: Path, as_json: bool) -> int:
    """Print what the compensations of a folder of runs, or one of them, do now; check their audit logs.

    Return 1 where the chain of hashes of one of them is broken.
    """
    folders = [place] if (place / AUDIT).is_file() else list(compensations(place))
    if not folders:
        raise CompensationError(f"{place}: expected a run folder of a compensation, or a folder of such runs")
    found = [_of(folder) for folder in folders]
    if as_json:
        show_json({"ok": not any(each["broken"] for each in found), "compensations": found})
    else:
        show(table(["run", "machine", "mode", "state", "offset X Y Z/um", "in effect/um", "audit log"], _rows(found)))
    for each in found:
        if each["broken"] and not as_json:
            show(each["broken"])
    return int(any(each["broken"] for each in found))


def stop(folder: Path, as_json: bool) -> None:
    """Ask a compensation to ramp to zero and end."""
    request_stop(folder)
    if as_json:
        show_json({"ok": True, "folder": str(folder)})
    else:
        show(f"Asked: {folder.name} ramps to zero and ends. 'errormotion compensate status {folder}' shows it.")


def _of(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = {"folder": str(folder), "working": is_working(folder), "broken": "", "entries": None}
    try:
        found["status"] = read_status(folder).model_dump(mode="json")
    except CompensationError as error:
        found["status"], found["reason"] = None, str(error)
    try:
        found["entries"] = verify(folder / AUDIT)[0]
    except CompensationError as error:
        found["broken"] = str(error)
    return found


def _rows(found: list[dict[str, Any]]) -> list[list[str]]:
    return [_row(each) for each in found]


def _row(each: dict[str, Any]) -> list[str]:
    name, log = Path(each["folder"]).name, "broken" if each["broken"] else f"{each['entries']} entries, unbroken"
    said = each["status"]
    if said is None:
        return [name, "unknown", "", "at work" if each["working"] else "unknown", "", "", log]
    state = said["state"] if each["working"] else f"ended: {said['state']}"
    mode = "armed" if said["armed"] else "shadow"
    return [name, said["machine"], mode, state, _um(said["offset"]), _um(said["applied"]), log]


def _um(values: list[float | None] | None) -> str:
    return "-" if values is None else " ".join("-" if each is None else f"{1e6 * each + 0.0:.2f}" for each in values)
