"""``errormotion run``: runs a campaign with progress bars, requests to the operator, and a final summary."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from errormotion import datasets
from errormotion.campaign import runner
from errormotion.campaign.background import processes
from errormotion.campaign.background.publishing import Published, released_in
from errormotion.campaign.files import CampaignPlan, load_campaign
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.planning.release import Release, refuse, released
from errormotion.cli.commands.campaigns import background as command
from errormotion.cli.guard import UsageError
from errormotion.cli.output import show, show_json
from errormotion.cli.progress import Bars, on_terminal
from errormotion.cli.summary import as_printed, figure_table, notes_of
from errormotion.cli.tolerances import end_with, remarks
from errormotion.datasets.results.merit import figures_of
from errormotion.tolerances.conformity import judge
from errormotion.tolerances.table import from_run, load_tolerances


def run(
    campaign: Path | None,
    *,
    resume: bool,
    runs: Path | None,
    yes: bool,
    move: bool,
    with_report: bool,
    tolerances: Path | None,
    as_json: bool,
    publish: Path | None = None,
) -> None:
    """Run or resume a campaign and print its results."""
    if campaign is None and not resume:
        raise UsageError(
            "Expected a campaign file, or --resume to continue the newest unfinished campaign.", code="option.missing"
        )
    if tolerances is not None and (resume or campaign is None):
        raise UsageError(
            "--tolerances is not allowed with --resume. Resume first, then: errormotion report RUN --tolerances FILE",
            code="option.not_allowed",
        )
    limits = load_tolerances(tolerances) if tolerances else None
    run_id = ""
    if resume and campaign is not None and campaign.is_dir():
        run_id, runs, campaign = str(RunFolder.open(campaign).data["id"]), runs or campaign.parent, None
    plan = load_campaign(campaign) if campaign else None
    if plan is not None and limits is not None:
        plan = replace(plan, tolerances=limits)
    folders = work(
        plan, resume=resume, runs=runs, yes=yes, move=move, with_report=with_report, quiet=as_json, announcing=True,
        run_id=run_id, publish=publish,
    )  # fmt: skip
    decisions = [folder.data["conformity"] for folder in folders if folder.data.get("conformity")]
    if as_json:
        show_json({"ok": True, "tests": [describe(folder) for folder in folders]})
        end_with(decisions)
        return
    for folder in folders:
        show(f"\n{folder.data['test']} ({folder.data['method']['id']}): {folder.data['status']} in {folder.path}")
        for line in result_lines(folder):
            show(f"  {line}")
    for line in remarks(decisions):
        show(line)
    end_with(decisions)


def work(
    plan: CampaignPlan | None,
    *,
    resume: bool = False,
    runs: Path | None = None,
    yes: bool = False,
    move: bool = False,
    with_report: bool = True,
    quiet: bool = False,
    announcing: bool = False,
    run_id: str = "",
    publish: Path | None = None,
) -> list[RunFolder]:
    """Run or resume a campaign with progress bars on a terminal; without a plan, the newest unfinished one.

    ``yes`` treats every request to the operator as done, and ``move`` releases the motions of the machine; neither
    includes the other.
    """
    with Bars(quiet, announcing=announcing) if publish is None else Published(publish) as bars:
        ask = _assume_done if yes else bars.ask if publish is not None or on_terminal() else None
        release: Release = released if move else bars.release if isinstance(bars, Bars) and on_terminal() else refuse
        if publish is not None and not move:
            release = released_in(publish, "" if plan is None else plan.sha256)
        report = report_of_run if with_report else None
        if resume or plan is None:
            return runner.resume(plan, run_id=run_id, runs=runs, progress=bars, ask=ask, report=report, release=release)
        return runner.run(plan, runs=runs, progress=bars, ask=ask, report=report, release=release)


def detach(campaign: Path | None, *, resume: bool, runs: Path | None, move: bool, as_json: bool) -> None:
    """Start or resume a campaign in a separate process, and print the name of the process."""
    if campaign is None:
        raise UsageError("--detach: expected a campaign file, or a run folder with --resume.", code="option.missing")
    release = released if move else Bars(quiet=True).release if on_terminal() else refuse
    if resume:
        command.started(processes.resume(campaign, release), campaign.parent, as_json)
        return
    runs = runs or load_campaign(campaign).runs
    command.started(processes.start(campaign, runs, release), runs, as_json)


def report_of_run(folder: Path) -> Path:
    """Write the report of a run folder."""
    from errormotion.report import write_run_report

    return write_run_report(folder)


def describe(folder: RunFolder) -> dict[str, Any]:
    """Return the state and the results of a run, for JSON output."""
    data = folder.data
    errors = folder.errors
    result = datasets.load(errors) if errors else None
    return {
        "test": data["test"],
        "method": data["method"]["id"],
        "status": data["status"],
        "folder": str(folder.path),
        "samples": data["samples"],
        "raw": str(folder.raw),
        "errors": str(errors) if errors else None,
        "report": str(folder.path / data["report"]) if data["report"] else None,
        "report_error": report_error(folder),
        "results": [as_printed(figure) for figure in figures_of(result)] if result is not None else [],
        "notes": notes_of(result) if result is not None else [],
        "conformity": data.get("conformity"),
    }


def report_error(folder: RunFolder) -> str | None:
    """Return why the last report could not be written; None where it was written or not requested."""
    reports = [step for step in folder.data["steps"] if step["step"] == "report"]
    return str(reports[-1]["reason"]) if reports and reports[-1]["outcome"] == "failed" else None


def result_lines(folder: RunFolder) -> list[str]:
    """Return the results of a run as printed: decision, files, figures and notes."""
    found = describe(folder)
    table = from_run(folder.data)
    lines = judge(datasets.load(found["errors"]), table).lines() if table is not None and found["errors"] else []
    lines += [f"report  {found['report']}"] if found["report"] else []
    if found["report_error"]:
        lines.append(f"no report: {found['report_error']}; when corrected, run: errormotion report {folder.path}")
    lines += [f"errors  {found['errors']}"] if found["errors"] else []
    if found["results"]:
        lines += figure_table(found["results"]).splitlines()
    samples = found["samples"] or {}
    lost = {"dropped": samples.get("dropped", 0)} | (samples.get("invalid") or {})
    if any(lost.values()):
        lines.append("lost samples: " + ", ".join(f"{count} {reason}" for reason, count in lost.items() if count))
    return lines + [f"note: {note}" for note in found["notes"]]


def _assume_done(message: str) -> None:
    """Print a request to the operator, and continue as if it were done."""
    show(f"assumed done (--yes): {message}", err=True)
