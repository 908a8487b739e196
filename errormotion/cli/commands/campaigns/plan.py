"""``errormotion plan``: the uncertainty to expect of the tests of a campaign."""

from __future__ import annotations

from pathlib import Path

from errormotion import datasets
from errormotion.campaign.files import load_campaign
from errormotion.campaign.planning.expected import expected, planned
from errormotion.cli.output import show, show_json, table, working
from errormotion.cli.summary import notes_of
from errormotion.errors import BenchError


def expect(campaign: Path, test: str | None, out: Path | None, as_json: bool) -> None:
    """Print the largest uncertainty to expect of every freedom, and the notes of the method, test by test.

    Raises
    ------
    BenchError
        No such test, or one file for the plans of several tests.
    """
    plan = load_campaign(campaign)
    chosen = [entry for entry in plan.tests if test is None or entry.name == test]
    if not chosen:
        raise BenchError(
            f"{campaign}: expected one of the tests {', '.join(entry.name for entry in plan.tests)}; found '{test}'"
        )
    if out is not None and len(chosen) > 1:
        raise BenchError(f"{campaign}: one file holds the plan of one test; name it with --test")
    with working("Computing the uncertainty to expect"):
        found = [(entry, planned(plan, entry)) for entry in chosen]
    if out is not None:
        datasets.save(found[0][1], out)
    plans = [
        {"test": entry.name, "method": entry.method.info.id, "expected": expected(ds), "notes": notes_of(ds)}
        for entry, ds in found
    ]
    if as_json:
        show_json({"ok": True, "plans": plans, "out": str(out) if out else None})
        return
    for part in plans:
        show(f"\n{part['test']} ({part['method']}):")
        rows = [[row["name"], f"{row['expanded_uncertainty']:.3g}", row["unit"]] for row in part["expected"]]
        show(table(["", "U (k=2)", ""], rows))
        for note in part["notes"]:
            show(f"note: {note}")
