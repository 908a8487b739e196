"""``errormotion plan``: the expected uncertainty of the tests of a campaign."""

from __future__ import annotations

from pathlib import Path

from errormotion import datasets
from errormotion.campaign.files import load_campaign
from errormotion.campaign.planning.expected import expected, planned
from errormotion.cli.output import show, show_json, table, working
from errormotion.cli.summary import notes_of
from errormotion.errors import BenchError


def expect(campaign: Path, test: str | None, out: Path | None, as_json: bool) -> None:
    """Print the largest expected uncertainty of every freedom, and the notes of the method, for each test.

    Raises
    ------
    BenchError
        The test does not exist, or several plans are to be written into one file.
    """
    plan = load_campaign(campaign)
    chosen = [entry for entry in plan.tests if test is None or entry.name == test]
    if not chosen:
        raise BenchError(
            f"{campaign}: expected one of the tests {', '.join(entry.name for entry in plan.tests)}; found '{test}'",
            code="campaign.test.unknown",
        )
    if out is not None and len(chosen) > 1:
        raise BenchError(
            f"{campaign}: --out writes the plan of one test; choose it with --test", code="campaign.test.ambiguous"
        )
    with working("Computing the expected uncertainty"):
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
