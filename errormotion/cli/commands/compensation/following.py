"""``errormotion compensate status`` and ``stop``: compensations that run in other processes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from errormotion.campaign.compensation.following import AUDIT, compensations, is_working, read_status, request_stop
from errormotion.cli.output import failure, show, show_json, table
from errormotion.compensation.online.audit import Verdict, check
from errormotion.errors import CompensationError


def status(path: Path, as_json: bool) -> int:
    """Print the state of one compensation, or of those of a folder of runs, and check their audit logs.

    Return the exit code: 1 if an audit log was altered, cut or emptied, else 0.
    """
    folders = [path] if (path / AUDIT).is_file() else list(compensations(path))
    if not folders:
        raise CompensationError(
            f"{path}: expected the run folder of a compensation, or a folder of such runs",
            code="compensation.folder.other",
        )
    found = [_state_of(folder) for folder in folders]
    if as_json:
        broken = [each["broken"] for each in found if each["broken"]]
        error = failure("\n".join(broken), code="audit.broken") if broken else {}
        show_json({"ok": not broken, "compensations": found, **error})
    else:
        show(
            table(
                ["run", "machine", "mode", "state", "offset X Y Z/um", "in effect/um", "audit log"],
                [_row(each) for each in found],
            )
        )
    for each in found:
        if each["broken"] and not as_json:
            show(each["broken"])
    return int(any(each["broken"] for each in found))


def stop(folder: Path, as_json: bool) -> None:
    """Request a compensation to ramp to zero and end."""
    request_stop(folder)
    if as_json:
        show_json({"ok": True, "folder": str(folder)})
    else:
        show(f"{folder.name}: stop requested; it ramps to zero and ends. State: errormotion compensate status {folder}")


def _state_of(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = {"folder": str(folder), "working": is_working(folder), "broken": "", "entries": None}
    found |= {"verdict": None, "complete": None}
    try:
        found["status"] = read_status(folder).model_dump(mode="json")
    except CompensationError as error:
        found["status"], found["reason"] = None, str(error)
    try:
        audit = check(folder / AUDIT)
        found |= {"broken": audit.message, "verdict": str(audit.verdict), "complete": audit.ended}
        found["entries"] = None if audit.message else audit.entries
    except CompensationError as error:
        found["broken"] = str(error)
    return found


def _row(each: dict[str, Any]) -> list[str]:
    name, log = Path(each["folder"]).name, _log(each)
    last = each["status"]
    if last is None:
        return [name, "unknown", "", "running" if each["working"] else "unknown", "", "", log]
    state = last["state"] if each["working"] else f"ended: {last['state']}"
    mode = "armed" if last["armed"] else "shadow"
    return [name, last["machine"], mode, state, _um(last["offset"]), _um(last["applied"]), log]


def _log(each: dict[str, Any]) -> str:
    if each["broken"]:
        return f"broken: {each['verdict'] or 'cannot be read'}"
    text = f"{each['entries']} entries, unbroken"
    if each["verdict"] == Verdict.WITHOUT_KEY:
        text += ", without key"
    return text if each["working"] or each["complete"] else f"{text}, without end"


def _um(values: list[float | None] | None) -> str:
    return "-" if values is None else " ".join("-" if each is None else f"{1e6 * each + 0.0:.2f}" for each in values)
