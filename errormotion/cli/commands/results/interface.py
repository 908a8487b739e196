"""Arguments of the commands on stored data and results; imports of a command are inside its function."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from errormotion.cli import options
from errormotion.cli.guard import INVALID
from errormotion.cli.output import failure, show, show_json
from errormotion.cli.page import page_of
from errormotion.cli.root import app


@app.command()
def identify(
    raw: Annotated[
        list[Path],
        typer.Argument(help="Raw datasets: NetCDF, Zarr, CSV of readings, run folders, or a folder of runs."),
    ],
    out: Annotated[Path, typer.Option(help="File of the errors (.nc); it must not exist. For several runs: a folder.")],
    method: Annotated[str | None, typer.Option(help="Id of a method plugin; default: that of the raw data.")] = None,
    set_: options.Set = None,
    settings: options.SettingsFile = None,
    scheduler: Annotated[
        str | None,
        typer.Option(help="For several runs or --monte-carlo: processes, threads, sync, or a Dask scheduler (tcp://)."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Number of processes or threads; default: one for each processor.")
    ] = None,
    tolerances: options.Limits = None,
    monte_carlo: Annotated[
        str | None,
        typer.Option(
            metavar="N|auto",
            help="Evaluate the uncertainty by N Monte Carlo trials (JCGM 101) as well; auto: adaptive number.",
        ),
    ] = None,
    digits: Annotated[int, typer.Option(min=1, max=2, help="For --monte-carlo: digits of a standard uncertainty.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="For --monte-carlo: seed of the random numbers.")] = 0,
    json_: options.Json = False,
) -> None:
    """Identify the errors of one raw dataset, or of many."""
    from errormotion.cli.commands.results import data

    trials = None
    if monte_carlo is not None:
        from errormotion.cli.commands.results.monte_carlo import trials_of

        trials = data.Trials(trials_of(monte_carlo), digits, seed)
    data.identify(raw, method, out, set_ or [], settings, scheduler, workers, tolerances, json_, trials)


@app.command("import")
def import_(
    logs: Annotated[list[Path], typer.Argument(help="A log with columns, a spreadsheet, or several of one dataset.")],
    map_: Annotated[Path | None, typer.Option("--map", help="A TOML file that describes the columns.")] = None,
    out: Annotated[Path | None, typer.Option(help="File of the raw dataset: .nc or .zarr.")] = None,
    propose: Annotated[Path | None, typer.Option(help="File of a proposed map that is written, to correct it.")] = None,
    json_: options.Json = False,
) -> None:
    """Convert logs with columns into a raw dataset, or propose a map for them."""
    from errormotion.cli.commands.results import importing

    importing.import_logs(logs, map_, out, propose, json_)


@app.command()
def report(
    run: Annotated[list[Path], typer.Argument(help="Run folders, or NetCDF files of errors.")],
    out: Annotated[
        Path | None, typer.Option(help="File of the page of one run; default: report.html in the run folder.")
    ] = None,
    tolerances: options.Tolerances = None,
    pdf: options.Pdf = False,
    csv: Annotated[bool, typer.Option("--csv", help="Write every table as CSV into a folder beside the page.")] = False,
    xlsx: Annotated[bool, typer.Option("--xlsx", help="Write every table into a workbook beside the page.")] = False,
    paper: Annotated[
        Literal["A4", "Letter"] | None, typer.Option(help="Paper; default: of the campaign, or A4.")
    ] = None,
    language: Annotated[
        Literal["en", "de"] | None, typer.Option(help="Language; default: of the campaign, or en.")
    ] = None,
    json_: options.Json = False,
) -> None:
    """Write the reports of runs."""
    from errormotion.cli.commands.results import data

    also = tuple(name for name, wanted in (("xlsx", xlsx), ("csv", csv), ("pdf", pdf)) if wanted)
    data.report(run, out, tolerances, json_, language=language or "", paper=paper or "", also=also)


@app.command()
def validate(
    file: Annotated[
        list[Path], typer.Argument(help="Datasets (.nc, .zarr), run folders, bench, campaign or tolerance files.")
    ],
    json_: options.Json = False,
) -> None:
    """Check that files follow their schema; list every violation."""
    from errormotion.cli.commands.results import data

    mistakes = {str(each): data.validate(each) for each in file}
    every = [text for texts in mistakes.values() for text in texts]
    if json_:
        error = failure("\n".join(every), code="file.violations") if every else {}
        found = [{"file": each, "violations": texts} for each, texts in mistakes.items()]
        show_json({"ok": not every, **(found[0] if len(found) == 1 else {"files": found}), **error})
    for each, texts in mistakes.items() if not json_ else ():
        count = f"{len(texts)} violation" + ("s" if len(texts) != 1 else "")
        show("\n  - ".join([f"{each}: {count}", *data.alike(texts)]) if texts else f"{each}: valid")
    if every:
        raise typer.Exit(INVALID)


@app.command()
def compare(
    results: Annotated[
        list[Path] | None,
        typer.Argument(help="Error datasets, run folders, or folders of runs (the newest result of each test)."),
    ] = None,
    name: Annotated[list[str] | None, typer.Option(metavar="NAME=PATH", help="A further result with its name.")] = None,
    at: options.At = None,
    over: options.Over = None,
    select: options.Select = None,
    freedoms: options.Freedoms = None,
    since: Annotated[
        float | None, typer.Option(help="Time of the common reference state, s after the start of the first dataset.")
    ] = None,
    same_start: Annotated[
        bool,
        typer.Option("--same-start", help="Treat time 0 of all datasets as one instant if their start is not stated."),
    ] = False,
    change: Annotated[
        list[str] | None,
        typer.Option(help="A further result: the change between two measurements of the same places."),
    ] = None,
    origin: Annotated[
        list[str] | None,
        typer.Option(help="Origin of the frame of a result in machine coordinates with all axes at zero, mm."),
    ] = None,
    chain: Annotated[str | None, typer.Option(help="Kinematic chain, for results that do not state it.")] = None,
    straightness: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=PLACE",
            help="Where the straightness of a result was read, table or tool, if it does not state it.",
        ),
    ] = None,
    by: Annotated[
        Literal["test", "operator", "instrument", "method"] | None,
        typer.Option(
            help="Group the results for repeatability and reproducibility; uses all results of a folder of runs."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write the comparison as a dataset (.nc).")] = None,
    report: options.Report = None,
    pdf: options.Pdf = False,
    paper: options.Paper = None,
    language: options.Language = None,
    json_: options.Json = False,
) -> None:
    """Compare results of one machine, and explain differences."""
    from errormotion.cli.commands.results import compare as command

    origins = {}
    for each in origin or []:
        result, _, text = each.rpartition("=")
        origins[result] = options.point(f"--origin {result}", text)
    stated = command.Stated(name or [], change or [], origins, chain, by, over, select or [], straightness or [])
    point, page = options.optional_point("--at", at), page_of(report, pdf, paper, language)
    command.compare(results or [], stated, point, options.parts(freedoms), since, same_start, out, page, json_)


@app.command("open")
def open_(
    place: Annotated[
        Path, typer.Argument(help="A run folder, a folder of runs (its newest run with a report), or a page.")
    ] = Path("runs"),
    browser: Annotated[bool, typer.Option(help="Open the browser; otherwise only print the path.")] = True,
    json_: options.Json = False,
) -> None:
    """Open the newest report in the browser, and print its path."""
    from errormotion.cli.commands.results import show as command

    command.open_report(place, browser=browser, as_json=json_)


@app.command()
def export(
    result: Annotated[Path, typer.Argument(help="A run folder, or a NetCDF file of errors.")],
    out: Annotated[Path, typer.Option(help="File to write: .csv, .xlsx, .nc or .zarr; it must not exist.")],
    freedoms: options.Freedoms = None,
    at: Annotated[str | None, typer.Option(help="Functional point, mm; default: that of the result.")] = None,
    k: Annotated[float, typer.Option("-k", min=0, max=10, help="Coverage factor of the uncertainties.")] = 2.0,
    json_: options.Json = False,
) -> None:
    """Write the tables of a result, or the dataset, to a file.

    Tables are for spreadsheets, in um and arcsec; the dataset is NetCDF or Zarr.
    """
    from errormotion.cli.commands.results import export as command

    command.export(result, out, options.parts(freedoms) or None, options.optional_point("--at", at), k, json_)
