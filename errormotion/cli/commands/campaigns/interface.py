"""Arguments of the commands on campaigns; imports of a command are inside its function."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from errormotion.cli import options
from errormotion.cli.guard import UsageError
from errormotion.cli.root import app, background_app

Move = Annotated[bool, typer.Option("--move", help="Release the motions of the machine without a question.")]
Process = Annotated[str | None, typer.Option(help="Name of the process; needed if there are several.")]
OfRuns = Annotated[Path, typer.Argument(help="The folder of runs.")]


@app.command()
def init(
    folder: Annotated[Path, typer.Argument(help="The folder for bench.toml and campaign.toml.")] = Path(),
    machine: Annotated[str, typer.Option(help="Name of the machine.")] = "",
    chain: Annotated[str, typer.Option(help="Kinematic chain, such as workpiece-X-Y-bed-Z-spindle-tool.")] = "",
    travel: Annotated[
        list[str] | None,
        typer.Option(metavar="AXIS=LOW,HIGH", help="Travel of an axis of the chain, such as X=-300mm,300mm."),
    ] = None,
    instrument: Annotated[
        list[str] | None, typer.Option(metavar="NAME=ID@ADDRESS", help="An instrument of the bench; may be repeated.")
    ] = None,
    test: Annotated[list[str] | None, typer.Option(metavar="NAME=ID", help="A test; may be repeated.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME.KEY=VALUE", help="One setting of an instrument or of a test."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files that exist.")] = False,
    json_: options.Json = False,
) -> None:
    """Write a bench and a campaign file; ask for what is open.

    Questions are asked on a terminal only.
    """
    from errormotion.cli.commands.campaigns.init import command

    command.init(
        folder, machine, chain, travel or [], instrument or [], test or [], set_ or [], force=force, as_json=json_
    )


@app.command()
def run(
    campaign: Annotated[
        Path | None,
        typer.Argument(
            help="A campaign file; with --resume it is optional and may be a run folder.", show_default=False
        ),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the newest unfinished campaign.")] = False,
    runs: options.Runs = None,
    yes: Annotated[
        bool, typer.Option("--yes", help="Treat every request to the operator as done; releases no motion.")
    ] = False,
    move: Move = False,
    report: Annotated[bool, typer.Option(help="Write a report for each test.")] = True,
    tolerances: options.Tolerances = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only report path and duration, without motion.")] = False,
    out: Annotated[Path | None, typer.Option(help="With --dry-run: folder for drawings of the path.")] = None,
    detach: Annotated[
        bool, typer.Option("--detach", help="Run in a separate process, which continues after this terminal is closed.")
    ] = False,
    publish: Annotated[
        Path | None, typer.Option(help="Write the progress into this folder, and read answers to requests from it.")
    ] = None,
    json_: options.Json = False,
) -> None:
    """Run the tests of a campaign: acquire, identify, report."""
    if dry_run:
        from errormotion.cli.commands.campaigns import dry_run as dry

        if campaign is None or resume or campaign.is_dir():
            raise UsageError("--dry-run: expected a campaign file and no --resume.", code="option.not_allowed")
        dry.run(campaign, out, json_)
        return
    if out is not None:
        raise UsageError("--out is allowed with --dry-run only.", code="option.not_allowed")
    from errormotion.cli.commands.campaigns import run as command

    if detach:
        command.detach(campaign, resume=resume, runs=runs, move=move, as_json=json_)
        return
    command.run(
        campaign, resume=resume, runs=runs, yes=yes, move=move, with_report=report, tolerances=tolerances,
        as_json=json_, publish=publish,
    )  # fmt: skip


@background_app.command("list")
def background_list(runs: OfRuns = Path("runs"), json_: options.Json = False) -> None:
    """List the processes of a folder of runs with their progress and their requests to the operator."""
    from errormotion.cli.commands.campaigns import background as command

    command.listed(runs, json_)


@background_app.command("answer")
def background_answer(runs: OfRuns = Path("runs"), process: Process = None) -> None:
    """State that the open request to the operator is done."""
    from errormotion.cli.commands.campaigns import background as command

    command.answer(runs, process)


@background_app.command("stop")
def background_stop(runs: OfRuns = Path("runs"), process: Process = None) -> None:
    """Stop a campaign, as Ctrl-C does; it can be resumed."""
    from errormotion.cli.commands.campaigns import background as command

    command.stop(runs, process)


@app.command()
def plan(
    campaign: Annotated[Path, typer.Argument(help="A campaign file.")],
    test: Annotated[str | None, typer.Option(help="One test; default: every test.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="A file for the plan of one test.")] = None,
    json_: options.Json = False,
) -> None:
    """Report expected uncertainties, and how to reduce them."""
    from errormotion.cli.commands.campaigns import plan as command

    command.expect(campaign, test, out, json_)


@app.command()
def program(
    campaign: Annotated[Path, typer.Argument(help="A campaign file.")],
    out: Annotated[Path, typer.Option(help="The folder for the programs; existing files are not replaced.")],
    test: Annotated[str | None, typer.Option(help="One test; default: every test that has programs.")] = None,
    move: Move = False,
    json_: options.Json = False,
) -> None:
    """Write the NC programs of the tests of a campaign."""
    from errormotion.cli.commands.campaigns import program as command

    command.write(campaign, test, out, move=move, as_json=json_)
