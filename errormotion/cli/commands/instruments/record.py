"""``errormotion record`` and ``errormotion replay``: record a session with an instrument, and replay it."""

from __future__ import annotations

import glob
import json
from datetime import datetime
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from errormotion import __version__, plugins
from errormotion.campaign.claims import claimed, uses
from errormotion.campaign.files import BenchInstrument, load_bench
from errormotion.cli import options
from errormotion.cli.output import failure, show, show_json
from errormotion.errors import BenchError, InstrumentError, ReplayError
from errormotion.instruments.sessions.masking import holds, mask, words_of
from errormotion.instruments.sessions.session import Session, differences, repeat, run_live
from errormotion.instruments.simulators.virtual_world.described import describe
from errormotion.instruments.transports.recording import add_note, parts_of, read_note, read_recording

LONGEST = 3600.0
"""Longest duration of a session, s."""
MAX_RECORDING = 50_000_000
"""Size of a recording at which the session ends, bytes."""
MAX_REPLAY = 10 * MAX_RECORDING
"""Largest size of a recording that is replayed, bytes."""


def record(bench: Path, name: str, duration: str, out: Path | None, mask_serial: bool, as_json: bool) -> bool:
    """Record a session, print the files, and return whether it ended without an error."""
    seconds = options.duration("--for", duration, LONGEST)
    instrument = _instrument(bench, name)
    path = out or Path(f"{name}-{datetime.now().astimezone():%Y%m%d-%H%M%S}.rec")
    if path.exists():
        raise InstrumentError(
            f"The recording {path} already exists; choose another file or remove it", code="recording.exists"
        )
    early: dict[Path, int] = {}  # number of frames before the identity was known
    with claimed(uses(load_bench(bench), only=name), "a recording"):
        session = run_live(
            instrument.driver(instrument.address, instrument.settings, record=path),
            seconds,
            lambda: sum(each.stat().st_size for each in _files(path)) > MAX_RECORDING,
            lambda: early.update({each: len(each.read_bytes().splitlines()) - 1 for each in _files(path)}),
        )
    if not path.is_file():
        raise InstrumentError(
            session.message or f"Nothing was recorded from the instrument '{name}'", code="recording.nothing"
        )
    note = _note(instrument, session)
    add_note(path, note)
    if mask_serial:
        _mask(path, session, early)
    files = [path, *(part for part in parts_of(path) if part != path)]
    if as_json:
        found = read_note(path)
        error = failure(session.message, code="recording.incomplete") if session.step else {}
        show_json({"ok": not session.step, "files": [str(each) for each in files], "note": found, **error})
        return not session.step
    if session.step:
        show(f"The session ended in the step '{session.step}' with {session.error}: {session.message}")
    frames, size = sum(len(read_recording(part)[1]) for part in parts_of(path)), sum(f.stat().st_size for f in files)
    show(f"{frames} frames, {size / 1e3:.0f} kB, {session.readings.count} readings, {session.stream.count} blocks:")
    for each in files:
        show(f"  {each}")
    return not session.step


def replay(path: Path, as_json: bool) -> bool:
    """Run the driver on a recording, print its readings, and return whether the session was reproduced."""
    if (size := sum(part.stat().st_size for part in {path, *parts_of(path)})) > MAX_REPLAY:
        raise ReplayError(
            f"The recording {path} has {size / 1e6:.0f} MB; expected at most {MAX_REPLAY / 1e6:.0f} MB",
            code="recording.too_large",
        )
    note, session, found = _played(path)
    frames = sum(len(read_recording(part)[1]) for part in parts_of(path))
    if as_json:
        about = {name: note.get(name) for name in ("plugin", "plugin_version", "distribution", "errormotion", "masked")}
        show_json(
            {
                "ok": not found,
                "file": str(path),
                "frames": frames,
                "reproduced": not found,
                "differences": found,
                **about,
                **session.record(),
                **(failure("\n".join(found), code="recording.not_reproduced") if found else {}),
            }
        )
        return not found
    identity = session.identity
    device = " ".join(str(identity.get(key, "")) for key in ("manufacturer", "model", "serial_number", "firmware"))
    show(f"{note['plugin']} {note.get('plugin_version', '')}: {device.strip() or 'no identity'}")
    show(f"recorded with errormotion {note.get('errormotion', '?')}, {note.get('distribution', '?')}")
    for name, summary in (("reading", session.readings), ("block of the stream", session.stream)):
        if summary.count:
            show(
                f"{summary.count} x {name}: {summary.values} values, {summary.unknown} unknown, {summary.dropped} lost"
            )
            show(f"  first {_short(summary.first)}, last {_short(summary.last)}")
    if session.step and not found:
        show(f"As in the recording, the session ended in the step '{session.step}' with an error: {session.message}")
    show(f"{frames} frames: " + ("reproduced frame by frame" if not found else "NOT reproduced"))
    for difference in found:
        show(f"  - {difference}")
    return not found


def _played(path: Path) -> tuple[dict[str, Any], Session, list[str]]:
    note = read_note(path)
    if note is None or "session" not in note or "plugin" not in note:
        raise ReplayError(
            f"The recording {path} states no instrument; 'errormotion record' did not make it. Open replay://{path} "
            "with its driver instead",
            code="recording.no_instrument",
        )
    cls = plugins.get("instruments", str(note["plugin"]))
    try:
        settings = cls.Settings.model_validate(note.get("settings"))
    except ValidationError as error:
        raise ReplayError(
            f"The settings in the recording {path} are not those of '{note['plugin']}': {error}",
            code="recording.settings",
        ) from None
    session = repeat(cls(f"replay://{path}", settings), note["session"])
    return note, session, differences(note["session"], session)


def _note(instrument: BenchInstrument, session: Session) -> dict[str, Any]:
    info = instrument.driver.info
    found = [plugin for plugin in plugins.available("instruments") if plugin.id == info.id]
    return {
        "plugin": info.id,
        "plugin_version": info.version,
        "kind": info.kind,
        "status": info.status,
        "distribution": found[0].distribution if found else "",
        "errormotion": __version__,
        "settings": json.loads(instrument.settings.model_dump_json()),
        "masked": False,
        "session": session.record(),
    }


def _mask(path: Path, session: Session, early: dict[Path, int]) -> None:
    """Mask the serial number; if that fails, remove the recording, so that it cannot be sent by mistake."""
    try:
        if not session.identity:
            raise InstrumentError("The instrument did not state a serial number", code="recording.mask.no_serial")
        words = words_of(str(session.identity["serial_number"]))
        mask(path, words, early)
        add_note(path, (read_note(path) or {}) | {"masked": True})
        found = _played(path)[2]
        if found:
            raise InstrumentError(
                f"The masked recording cannot be replayed ({found[0]})", code="recording.mask.not_replayed"
            )
        if holds(path, words):
            raise InstrumentError(
                "The masked recording still contains the serial number", code="recording.mask.serial_left"
            )
    except InstrumentError as error:
        for each in {path, *parts_of(path)}:
            each.unlink(missing_ok=True)
        raise InstrumentError(
            f"{error}. The recording was removed. Record without --mask-serial, and send the recording only to persons "
            "who may know the serial number",
            code=error.code,
        ) from None


def _instrument(bench: Path, name: str) -> BenchInstrument:
    plan = load_bench(bench)
    describe(plan.description)
    found = [each for each in plan.instruments if each.name == name]
    if not found:
        names = ", ".join(each.name for each in plan.instruments)
        raise BenchError(
            f"{bench}: expected one of the instruments {names}; found '{name}'", code="bench.instrument.unknown"
        )
    return found[0]


def _files(path: Path) -> set[Path]:
    """Return the files of a recording that is being written."""
    parts = path.parent.glob(f"{glob.escape(path.stem)}.*{glob.escape(path.suffix)}")
    return {each for each in (path, *parts) if each.is_file()}


def _short(values: tuple[float | None, ...]) -> str:
    return ", ".join("unknown" if value is None else f"{value:.6g}" for value in values)
