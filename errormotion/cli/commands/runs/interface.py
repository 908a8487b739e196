"""Arguments of the commands on the record of a machine; imports of a command are inside its function."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from errormotion.cli import options
from errormotion.cli.page import page_of
from errormotion.cli.root import app


@app.command()
def runs(
    folders: Annotated[
        list[Path] | None, typer.Argument(help="Run folders, or folders of runs; default: runs.", show_default=False)
    ] = None,
    machine: Annotated[str | None, typer.Option(help="Only the runs of this machine.")] = None,
    method: Annotated[str | None, typer.Option(help="Only the runs of this method.")] = None,
    since: Annotated[str | None, typer.Option(metavar="DATE", help="Only the runs since this date, UTC.")] = None,
    tolerances: Annotated[
        Path | None, typer.Option("--tolerances", help="A TOML file of limits, in place of those of the runs.")
    ] = None,
    json_: options.Json = False,
) -> None:
    """List runs, newest first, each with its figure of merit."""
    from errormotion.cli.commands.runs import listing as command

    command.runs(folders or [], machine, method, since, tolerances, json_)


@app.command()
def add(
    files: Annotated[list[Path], typer.Argument(help="Files of one measurement: tables, logs, datasets.")],
    machine: Annotated[str, typer.Option(help="Name of the machine.")] = "",
    method: Annotated[str, typer.Option(help="Id of a method plugin; default: that of the data.")] = "",
    axis: Annotated[str, typer.Option(help="Axis that moved, such as X.")] = "",
    map_: Annotated[Path | None, typer.Option("--map", help="A TOML file that describes the columns.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="One setting, or the answer to a question; may be repeated."),
    ] = None,
    head: Annotated[
        Path | None, typer.Option(help="A TOML file for the head of the report: laboratory, customer, instruments.")
    ] = None,
    measured: Annotated[
        str | None, typer.Option(metavar="DATE", help="Start of the measurement, if the files do not state it.")
    ] = None,
    test: Annotated[str, typer.Option(help="Name of the test; default: method and axis.")] = "",
    tolerances: options.Limits = None,
    runs: Annotated[Path, typer.Option(help="Folder for run folders.")] = Path("runs"),
    yes: Annotated[bool, typer.Option("--yes", help="Take the proposed answers to all questions.")] = False,
    again: Annotated[bool, typer.Option("--again", help="Add files once more that are in the record.")] = False,
    json_: options.Json = False,
) -> None:
    """Add files of other software: import, identify, report."""
    from errormotion.cli.commands.runs import add as command
    from errormotion.record.adding.request import Request

    start = options.date("--measured", measured)
    request = Request(
        tuple(files),
        runs,
        machine=machine,
        method=method,
        axis=axis,
        measured=start.isoformat() if start is not None else "",
        test=test,
        map=map_,
        head=head,
        tolerances=tolerances,
        again=again,
    )
    command.add(request, set_ or [], yes, json_)


@app.command()
def truth(
    run: Annotated[Path, typer.Argument(help="Run folder of a campaign with a [timeline] on a virtual machine.")],
    out: Annotated[Path, typer.Option(help="File of the error dataset (.nc).")],
) -> None:
    """Write the true errors during a run on a virtual machine as an error dataset."""
    from errormotion.cli.commands.runs import truth as command

    command.truth(run, out)


@app.command()
def note(
    folder: Annotated[Path, typer.Argument(help="A run folder, or a folder of runs with --machine and --at.")],
    text: Annotated[str, typer.Argument(help="What happened, on one line.")],
    machine: Annotated[str | None, typer.Option(help="Name of the machine, for a note without a run.")] = None,
    at: Annotated[str | None, typer.Option(metavar="DATE", help="Time of the event, UTC; default: of the run.")] = None,
    by: Annotated[str, typer.Option(metavar="NAME", help="Author of the note.")] = "",
    json_: options.Json = False,
) -> None:
    """Note an event of a machine, such as a collision or a repair."""
    from errormotion.cli.commands.runs import note as command

    command.note(folder, text, machine, at, by, json_)


@app.command()
def history(
    machine: Annotated[str, typer.Option(help="Name of the machine.")],
    figure: Annotated[str, typer.Option(help="A figure of merit (* replaces any characters), or a freedom.")],
    folders: Annotated[list[Path] | None, typer.Argument(help="Folders; default: runs.", show_default=False)] = None,
    at: Annotated[str | None, typer.Option(help="Functional point of the freedom 'x,y,z', mm.")] = None,
    method: Annotated[str | None, typer.Option(help="Only the runs of this method.")] = None,
    test: Annotated[str | None, typer.Option(help="Only the runs of this test.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write the history as a dataset (.nc).")] = None,
    report: options.Report = None,
    pdf: options.Pdf = False,
    paper: options.Paper = None,
    language: options.Language = None,
    json_: options.Json = False,
) -> None:
    """Show a figure of merit over time: trend, steps, limits.

    Control limits follow from the runs; notes on the machine stand beside them.
    """
    from errormotion.cli.commands.runs import history as command

    page = page_of(report, pdf, paper, language)
    command.history(folders or [], machine, figure, options.optional_point("--at", at), method, test, out, page, json_)
