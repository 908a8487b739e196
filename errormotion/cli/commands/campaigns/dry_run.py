"""``errormotion run --dry-run``: path and duration of a campaign, without any motion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from errormotion.campaign.files import CampaignPlan, load_campaign
from errormotion.campaign.planning.motions import Motions, beside_limits, headline, motions, picture
from errormotion.cli.output import show, show_json, table
from errormotion.errors import BenchError


def run(campaign: Path, out: Path | None, as_json: bool) -> None:
    """Print path and duration of every test, and draw the paths into a folder.

    Raises
    ------
    BenchError
        The campaign cannot be read, exceeds the limits of its bench, or a method does not state its motions.
    """
    plan = load_campaign(campaign)
    found_tests: list[dict[str, Any]] = []
    for test in plan.tests:
        found = motions(plan, test)
        drawn = None if out is None else _drawn(plan, found, out)
        found_tests.append(
            {"test": test.name, "motions": found.extent.__dict__, "picture": None if drawn is None else str(drawn)}
        )
        if not as_json:
            show(f"{test.name}: {headline(found)}")
            show(table(["", "planned", "limits"], beside_limits(found.extent, plan.bench.limits)))
            if drawn is not None:
                show(f"  drawn in {drawn}")
    if as_json:
        show_json({"ok": True, "tests": found_tests})
        return
    show("Nothing has moved.")


def _drawn(plan: CampaignPlan, found: Motions, out: Path) -> Path:
    """Draw the motions of a test, and return the file."""
    path = out / f"{found.test}-dry-run.png"
    if path.exists():
        raise BenchError(f"{path}: already exists; choose another folder, or remove the file", code="file.exists")
    out.mkdir(parents=True, exist_ok=True)
    picture(plan, found).savefig(path, dpi=110)
    return path
