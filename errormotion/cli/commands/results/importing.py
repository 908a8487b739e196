"""``errormotion import``: logs become raw datasets, with a map that is stated or proposed."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from errormotion.cli.guard import UsageError
from errormotion.cli.output import show, show_json, table
from errormotion.cli.progress import Bars


def import_logs(
    logs: Sequence[Path], map_file: Path | None, out: Path | None, proposed: Path | None, as_json: bool
) -> None:
    """Convert logs with columns into a raw dataset, or write a proposed map for them."""
    if proposed is not None and map_file is None and out is None:
        _propose(logs, proposed, as_json)
    elif map_file is not None and out is not None and proposed is None:
        _import(logs, map_file, out, as_json)
    else:
        raise UsageError(
            "expected --map and --out to import, or --propose alone to write a proposed map", code="option.missing"
        )


def _import(logs: Sequence[Path], map_file: Path, out: Path, as_json: bool) -> None:
    from errormotion.datasets.importing import import_log

    with Bars(as_json) as bars:
        bars.stage("importing")
        raw = import_log(logs, map_file, out)
    sizes = {str(dim): size for dim, size in raw.sizes.items()}
    missing, notes = json.loads(raw.attrs["missing_values"]), json.loads(raw.attrs.get("import_notes", "[]"))
    if as_json:
        answer = {"schema": raw.attrs["schema"], "sizes": sizes, "missing": missing, "notes": notes}
        show_json({"ok": True, "raw": str(out), **answer})
    else:
        show(f"{out}: {raw.attrs['schema']}, " + ", ".join(f"{size} along {dim}" for dim, size in sizes.items()))
        for column, count in missing.items():
            show(f"  {column}: {count} empty cells, kept as NaN")
        for note in notes:
            show(f"  note: {note}")


def _propose(logs: Sequence[Path], file: Path, as_json: bool) -> None:
    from errormotion.datasets.maps.proposal import propose
    from errormotion.datasets.maps.writing import write_map

    with Bars(as_json) as bars:
        bars.stage("recognising")
        proposal = propose(logs)
    write_map(proposal, file)
    if as_json:
        tables = [
            {"file": str(each.path), "sheet": each.sheet, "titles": each.titles, "meanings": each.meanings}
            for each in proposal.tables
        ]
        questions = [
            {"key": each.key, "text": each.text, "proposed": each.proposed, "needed": each.needed}
            for each in proposal.questions
        ]
        answer = {"schema": proposal.schema, "variant": proposal.variant, "tables": tables, "questions": questions}
        show_json({"ok": True, "map": str(file), **answer, "notes": proposal.notes})
        return
    variant = f", {proposal.variant}" if proposal.variant else ""
    show(f"{file}: a map of {', '.join(path.name for path in logs)} for {proposal.schema}{variant}")
    for each in proposal.tables:
        used = zip(each.titles, each.units, each.rows[0] if each.rows else each.titles, each.meanings, strict=True)
        show(table(["column", "unit", "first", "is"], [[*cells[:3], cells[3] or "not used"] for cells in used]))
    for note in proposal.notes:
        show(f"  note: {note}")
    for question in proposal.questions:
        if question.needed:
            choices = f": {', '.join(choice.value for choice in question.choices)}" if question.choices else ""
            answer_ = f"proposed: {question.proposed}" if question.proposed else f"state it{choices}"
            show(f"  {question.key}: {question.text} ({answer_})")
