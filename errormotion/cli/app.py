"""The commands. Each imports what it needs when it is called, so that ``--help`` is fast."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal

import typer

from errormotion.cli.demo import COMPENSATED, CONTROLLERS
from errormotion.cli.guard import ERROR, INVALID, USAGE, guarded
from errormotion.cli.output import show, show_json, table
from errormotion.cli.page import page_of
from errormotion.cli.wording import share

app = typer.Typer(
    name="errormotion",
    help="Measure the error motions of machine tools.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
plugins_app = typer.Typer(
    no_args_is_help=True, help="Instruments, methods and kinds of dataset.", rich_markup_mode=None
)
bench_app = typer.Typer(
    no_args_is_help=True, help="Check a bench file, or the instruments of a bench.", rich_markup_mode=None
)
app.add_typer(plugins_app, name="plugins")
app.add_typer(bench_app, name="bench")
model_app = typer.Typer(
    no_args_is_help=True, help="Thermal models: errors predicted from temperatures.", rich_markup_mode=None
)
app.add_typer(model_app, name="model")
compensate_app = typer.Typer(no_args_is_help=True, help="Compensate measured errors.", rich_markup_mode=None)
app.add_typer(compensate_app, name="compensate")

background_app = typer.Typer(
    no_args_is_help=True, help="Campaigns that 'errormotion run --detach' or the dashboard has started.",
    rich_markup_mode=None,
)  # fmt: skip
app.add_typer(background_app, name="background")

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document instead of text.")]
Runs = Annotated[
    Path | None, typer.Option("--runs", help="Folder for run folders; default: the folder that the campaign names.")
]

Tolerances = Annotated[
    Path | None, typer.Option("--tolerances", help="A TOML file of limits, in place of those of the campaign.")
]
Paper = Annotated[Literal["A4", "Letter"] | None, typer.Option(help="Paper; default: A4.")]
Language = Annotated[Literal["en", "de"] | None, typer.Option(help="Language; default: en.")]
Pdf = Annotated[bool, typer.Option("--pdf", help="Print the page as PDF beside it.")]
Limits = Annotated[Path | None, typer.Option("--tolerances", help="A TOML file of limits; decide on each result.")]


def _version(value: bool) -> None:
    if value:
        from errormotion import __version__

        show(f"errormotion {__version__}")
        raise typer.Exit


def _millimetres(option: str, text: str) -> tuple[float, float, float]:
    """Return the point that an option states in mm, m."""
    try:
        x, y, z = (float(part) / 1e3 for part in text.split(","))
    except ValueError:
        typer.echo(f"{option} {text}: expected three numbers in mm, as in 0,0,-150", err=True)
        raise typer.Exit(USAGE) from None
    return x, y, z


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Measure the error motions of machine tools."""
    del version


@app.command()
@guarded
def demo(
    runs: Annotated[Path, typer.Option(help="Folder for the run folders.")] = Path("runs"),
    controller: Annotated[
        str,
        typer.Option(help=f"Controller of the machine: {', '.join(CONTROLLERS)}. All but the first must be installed."),
    ] = next(iter(CONTROLLERS)),
    compensate: Annotated[
        bool, typer.Option("--compensate", help="Fit a model to a warm-up, and compensate further ones.")
    ] = False,
    json_: Json = False,
) -> None:
    """Measure a virtual machine and compare the result with the truth."""
    shown = COMPENSATED if compensate else CONTROLLERS
    if controller not in shown:
        typer.echo(f"--controller {controller}: expected one of {', '.join(shown)}.", err=True)
        raise typer.Exit(USAGE)
    import_module(shown[controller]).run(runs, json_)


@app.command()
@guarded
def init(
    folder: Annotated[Path, typer.Argument(help="The folder for bench.toml and campaign.toml.")] = Path(),
    machine: Annotated[str, typer.Option(help="Name of the machine.")] = "",
    chain: Annotated[str, typer.Option(help="Its kinematic chain, such as workpiece-X-Y-bed-Z-spindle-tool.")] = "",
    travel: Annotated[
        list[str] | None,
        typer.Option(metavar="AXIS=LOW,HIGH", help="Travel of an axis of the chain, such as X=-300mm,300mm."),
    ] = None,
    instrument: Annotated[
        list[str] | None, typer.Option(metavar="NAME=ID@ADDRESS", help="An instrument of the bench; may be repeated.")
    ] = None,
    test: Annotated[
        list[str] | None, typer.Option(metavar="NAME=ID", help="A test of the campaign; may be repeated.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME.KEY=VALUE", help="One setting of an instrument or of a test."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files that exist.")] = False,
    json_: Json = False,
) -> None:
    """Write a bench and a campaign for the instruments at hand; on a terminal, ask for what is not stated."""
    from errormotion.cli.commands.campaigns.init import command

    command.init(
        folder, machine, chain, travel or [], instrument or [], test or [], set_ or [], force=force, as_json=json_
    )


@app.command()
@guarded
def run(
    campaign: Annotated[
        Path | None,
        typer.Argument(help="A campaign file; with --resume optional, or a run folder.", show_default=False),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the newest unfinished campaign.")] = False,
    runs: Runs = None,
    yes: Annotated[bool, typer.Option("--yes", help="Assume that every request to the operator is done.")] = False,
    report: Annotated[bool, typer.Option(help="Write a report for each test.")] = True,
    tolerances: Tolerances = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Report path and duration only; nothing is opened or moved.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="With --dry-run: a folder for pictures of the path.")] = None,
    detach: Annotated[
        bool, typer.Option("--detach", help="Run in a process of its own, which outlives this terminal.")
    ] = False,
    publish: Annotated[
        Path | None, typer.Option(help="Publish the progress in this folder, and wait there for answers.")
    ] = None,
    json_: Json = False,
) -> None:
    """Run the tests of a campaign: acquire, identify, report."""
    if dry_run:
        from errormotion.cli.commands.campaigns import dry_run as dry

        if campaign is None:
            typer.echo("--dry-run: expected a campaign file.", err=True)
            raise typer.Exit(USAGE)
        dry.run(campaign, out, json_)
        return
    if out is not None:
        typer.echo("--out is allowed with --dry-run only.", err=True)
        raise typer.Exit(USAGE)
    from errormotion.cli.commands.campaigns import run as command

    if detach:
        command.detach(campaign, resume=resume, runs=runs, as_json=json_)
        return
    command.run(
        campaign, resume=resume, runs=runs, yes=yes, with_report=report, tolerances=tolerances, as_json=json_,
        publish=publish,
    )  # fmt: skip


@app.command()
@guarded
def identify(
    raw: Annotated[
        list[Path],
        typer.Argument(help="Raw datasets: NetCDF, Zarr, CSV of readings, run folders, or a folder of those."),
    ],
    out: Annotated[Path, typer.Option(help="The NetCDF file to write; it must not exist. For several runs: a folder.")],
    method: Annotated[
        str | None, typer.Option(help="The id of a method plugin; default: the method of the raw data.")
    ] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One setting.")] = None,
    settings: Annotated[Path | None, typer.Option(help="A TOML file of settings.")] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="For several runs or --monte-carlo: processes, threads, sync, or a Dask scheduler, tcp://host:port."
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="How many processes or threads; default: one for each processor.")
    ] = None,
    tolerances: Limits = None,
    monte_carlo: Annotated[
        str | None,
        typer.Option(
            metavar="N|auto",
            help="Evaluate the uncertainty by N trials (JCGM 101) as well, or by as many as the result needs.",
        ),
    ] = None,
    digits: Annotated[
        int, typer.Option(min=1, max=2, help="For --monte-carlo: meaningful digits of a standard uncertainty.")
    ] = 1,
    seed: Annotated[int, typer.Option(min=0, help="For --monte-carlo: one seed gives one result.")] = 0,
    json_: Json = False,
) -> None:
    """Identify the errors of one raw dataset, or of many."""
    from errormotion.cli.commands.results import data

    trials = None
    if monte_carlo is not None:
        from errormotion.cli.commands.results.monte_carlo import trials_of

        trials = data.Trials(trials_of(monte_carlo), digits, seed)
    data.identify(raw, method, out, set_ or [], settings, scheduler, workers, tolerances, json_, trials)


@app.command()
@guarded
def calibrate(
    data: Annotated[Path, typer.Argument(help="Readings of a sensor against a reference: NetCDF or CSV.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The calibration to write, .nc; it must not exist.")],
    set_: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One setting.")] = None,
    settings: Annotated[Path | None, typer.Option(help="A TOML file of settings.")] = None,
    json_: Json = False,
) -> None:
    """Make a calibration from readings."""
    from errormotion.cli.commands.instruments import calibrate as command

    command.run(data, out, set_ or [], settings, json_)


@app.command("import")
@guarded
def import_(
    log: Annotated[Path, typer.Argument(help="A log with columns: CSV or TSV.")],
    map_: Annotated[Path, typer.Option("--map", help="A TOML file that describes the columns.")],
    out: Annotated[Path, typer.Option(help="The raw dataset to write: .nc or .zarr.")],
    json_: Json = False,
) -> None:
    """Convert a log with columns into a raw dataset."""
    from errormotion.cli.commands.results import data

    data.import_log(log, map_, out, json_)


@app.command()
@guarded
def monitor(
    bench: Annotated[Path, typer.Argument(help="A bench file with thermometers, a controller, or both.")],
    runs: Annotated[Path, typer.Option(help="Folder for the run folder of the log.")] = Path("runs"),
    interval: Annotated[str, typer.Option(help="Interval between two rows of the log.")] = "1 s",
    duration: Annotated[str | None, typer.Option(help="Duration of the log; default: until Ctrl-C.")] = None,
    json_: Annotated[bool, typer.Option("--json", help="Print one JSON document for each row.")] = False,
) -> None:
    """Show temperatures and working parameters live, and log them."""
    from errormotion.cli.commands.instruments import monitor as command

    command.run(bench, runs, interval, duration, json_)


@compensate_app.command("run")
@guarded
def compensate_run(
    bench: Annotated[Path, typer.Argument(help="A bench file with thermometers and, to write, a table [compensator].")],
    model: Annotated[Path, typer.Option("--model", "-m", help="A thermal model of the machine.")],
    arm: Annotated[
        str | None,
        typer.Option(metavar="MACHINE", help="Write offsets; the name of the machine as in the bench file."),
    ] = None,
    since: Annotated[
        Path | None,
        typer.Option(help="Log of a monitor or an earlier compensation that began in the reference state."),
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Where the errors are to vanish, mm; default: as the model states."),
    ] = None,
    runs: Annotated[Path, typer.Option(help="Folder for the run folder.")] = Path("runs"),
    duration: Annotated[str | None, typer.Option(help="Ramp to zero and end after this time; default: never.")] = None,
    json_: Annotated[bool, typer.Option("--json", help="Print one JSON document for each interval.")] = False,
) -> None:
    """Follow the temperatures of a machine with offsets; without --arm only compute and log them."""
    from errormotion.cli.commands.compensation import follow as command

    point = None if at is None else _millimetres("--at", at)
    code = command.run(
        bench, model, runs, arm=arm, since=since, functional_point=point, duration=duration, as_json=json_
    )
    raise typer.Exit(code)


@compensate_app.command("status")
@guarded
def compensate_status(
    folder: Annotated[Path, typer.Argument(help="A folder of runs, or the run folder of one compensation.")] = Path(
        "runs"
    ),
    json_: Json = False,
) -> None:
    """Show what compensations do now, whoever started them, and check their audit logs."""
    from errormotion.cli.commands.compensation import following as command

    raise typer.Exit(command.status(folder, json_))


@compensate_app.command("stop")
@guarded
def compensate_stop(
    folder: Annotated[Path, typer.Argument(help="The run folder of a compensation.")],
    json_: Json = False,
) -> None:
    """Ask a compensation to ramp to zero and end, as Ctrl-C in its terminal does."""
    from errormotion.cli.commands.compensation import following as command

    command.stop(folder, json_)


@app.command()
@guarded
def simulate(
    plugin: Annotated[str, typer.Argument(help="The id of an instrument or a compensator.")],
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Port of the device, the next one for its next line; default: a free one."),
    ] = None,
    host: Annotated[
        str | None, typer.Option(help="Address at which it listens; default: 127.0.0.1, this computer only.")
    ] = None,
    fault: Annotated[str | None, typer.Option(help="A fault of the device, such as silence, split or late.")] = None,
    bench: Annotated[Path | None, typer.Option(help="A bench file: its machine, and its device.")] = None,
    machine: Annotated[str | None, typer.Option(help="The virtual machine: cframe (default) or gantry.")] = None,
    seed: Annotated[int | None, typer.Option(help="Which individual of the machine.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One parameter of the simulated device.")
    ] = None,
    json_: Json = False,
) -> None:
    """Start the simulated device of an instrument by itself, until Ctrl-C."""
    from errormotion.cli.commands.instruments import simulate as command

    command.run(
        plugin,
        port=port,
        host=host,
        fault=fault,
        bench=bench,
        machine=machine,
        seed=seed,
        settings=set_ or [],
        as_json=json_,
    )


@app.command()
@guarded
def plan(
    campaign: Annotated[Path, typer.Argument(help="A campaign file.")],
    test: Annotated[str | None, typer.Option(help="One test; default: every test.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="A file for the plan of one test.")] = None,
    json_: Json = False,
) -> None:
    """Report the uncertainty to expect of the tests of a campaign, and how to reduce it."""
    from errormotion.cli.commands.campaigns import plan as command

    command.expect(campaign, test, out, json_)


@app.command()
@guarded
def program(
    campaign: Annotated[Path, typer.Argument(help="A campaign file.")],
    out: Annotated[Path, typer.Option(help="The folder for the programs; existing files are not replaced.")],
    test: Annotated[str | None, typer.Option(help="One test; default: every test that has programs.")] = None,
    json_: Json = False,
) -> None:
    """Write the NC programs of the tests of a campaign."""
    from errormotion.cli.commands.campaigns import program as command

    command.write(campaign, test, out, json_)


@app.command()
@guarded
def record(
    bench: Annotated[Path, typer.Argument(help="A bench file.")],
    instrument: Annotated[str, typer.Argument(help="The name of one of its instruments.")],
    for_: Annotated[str, typer.Option("--for", metavar="TIME", help="Duration of the session.")] = "10 s",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The recording to write; default: INSTRUMENT-TIME.rec.")
    ] = None,
    mask_serial: Annotated[bool, typer.Option("--mask-serial", help="Mask the serial number.")] = False,
    json_: Json = False,
) -> None:
    """Record a short session with one instrument: identity, readings, stream."""
    from errormotion.cli.commands.instruments import record as command

    if not command.record(bench, instrument, for_, out, mask_serial, json_):
        raise typer.Exit(ERROR)


@app.command()
@guarded
def replay(
    recording: Annotated[Path, typer.Argument(help="A recording that 'errormotion record' has made.")],
    json_: Json = False,
) -> None:
    """Run the driver on a recorded session, and report whether it was reproduced."""
    from errormotion.cli.commands.instruments import record as command

    if not command.replay(recording, json_):
        raise typer.Exit(INVALID)


@app.command()
@guarded
def report(
    run: Annotated[Path, typer.Argument(help="A run folder, or a NetCDF file of errors.")],
    out: Annotated[Path | None, typer.Option(help="The page to write; default: report.html in the run folder.")] = None,
    tolerances: Tolerances = None,
    pdf: Pdf = False,
    csv: Annotated[bool, typer.Option("--csv", help="Write every table as CSV into a folder beside the page.")] = False,
    xlsx: Annotated[bool, typer.Option("--xlsx", help="Write every table into a workbook beside the page.")] = False,
    paper: Annotated[
        Literal["A4", "Letter"] | None, typer.Option(help="Paper; default: that of the campaign, else A4.")
    ] = None,
    language: Annotated[
        Literal["en", "de"] | None, typer.Option(help="Language; default: that of the campaign, else en.")
    ] = None,
    json_: Json = False,
) -> None:
    """Write the report of a run."""
    from errormotion.cli.commands.results import data

    also = tuple(name for name, wanted in (("xlsx", xlsx), ("csv", csv), ("pdf", pdf)) if wanted)
    data.report(run, out, tolerances, json_, language=language or "", paper=paper or "", also=also)


@app.command()
@guarded
def validate(
    file: Annotated[Path, typer.Argument(help="A dataset (.nc, .zarr), a run folder, a bench or a campaign file.")],
    json_: Json = False,
) -> None:
    """Check that a file follows its schema, and list every violation."""
    from errormotion.cli.commands.results import data

    mistakes = data.validate(file)
    if json_:
        show_json({"ok": not mistakes, "file": str(file), "violations": mistakes})
    else:
        count = f"{len(mistakes)} violation" + ("s" if len(mistakes) != 1 else "")
        show("\n  - ".join([f"{file}: {count}", *data.alike(mistakes)]) if mistakes else f"{file}: valid")
    if mistakes:
        raise typer.Exit(INVALID)


@app.command()
@guarded
def truth(
    run: Annotated[Path, typer.Argument(help="Run folder of a campaign with a [timeline] on a virtual machine.")],
    out: Annotated[Path, typer.Option(help="File of the error dataset (.nc).")],
) -> None:
    """Write the true errors behind a run on a virtual machine, as an error dataset."""
    from errormotion.cli.commands.runs import truth as command

    command.truth(run, out)


@app.command()
@guarded
def compare(
    results: Annotated[
        list[Path] | None,
        typer.Argument(help="Error datasets, run folders, or folders of runs (the newest result of each test)."),
    ] = None,
    name: Annotated[list[str] | None, typer.Option(help="A further one with a name of its own: NAME=PATH.")] = None,
    at: Annotated[
        str | None, typer.Option(help="Functional point 'x,y,z', mm; default: that of the first dataset.")
    ] = None,
    over: Annotated[
        str | None, typer.Option(metavar="DIM", help="What the errors are compared over: time, position or target.")
    ] = None,
    select: Annotated[
        list[str] | None, typer.Option(help="One element of another dimension, counted from 0: position=3.")
    ] = None,
    freedoms: Annotated[str | None, typer.Option(help="Which are compared: EX,EZ; default: all known ones.")] = None,
    since: Annotated[
        float | None, typer.Option(help="Common reference state, s after the start of the first dataset.")
    ] = None,
    same_start: Annotated[
        bool, typer.Option("--same-start", help="Take time 0 of all datasets as one instant where none is stated.")
    ] = False,
    change: Annotated[
        list[str] | None,
        typer.Option(help="A further one, the change between two measurements of the same places: NAME=AFTER,BEFORE."),
    ] = None,
    origin: Annotated[
        list[str] | None,
        typer.Option(help="Origin of the frame of one in machine coordinates, all axes at zero, mm: NAME=x,y,z."),
    ] = None,
    chain: Annotated[
        str | None, typer.Option(help="Kinematic chain of the machine, for results that state none.")
    ] = None,
    by: Annotated[
        Literal["test", "operator", "instrument", "method"] | None,
        typer.Option(help="Repeatability and reproducibility of groups; a folder of runs stands for all its results."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write the comparison as a dataset (.nc).")] = None,
    report: Annotated[Path | None, typer.Option(help="Write a page (.html).")] = None,
    pdf: Pdf = False,
    paper: Paper = None,
    language: Language = None,
    json_: Json = False,
) -> None:
    """Compare results of one machine: whether they agree, and what explains it where they do not."""
    from errormotion.cli.commands.results import compare as command

    point = None if at is None else _millimetres("--at", at)
    origins = {}
    for each in origin or []:
        own, _, text = each.rpartition("=")
        origins[own] = _millimetres(f"--origin {own}", text)
    chosen = [part.strip() for part in freedoms.split(",")] if freedoms else []
    stated = command.Stated(name or [], change or [], origins, chain, by, over, select or [])
    command.compare(
        results or [], stated, point, chosen, since, same_start, out, page_of(report, pdf, paper, language), json_
    )


@app.command()
@guarded
def runs(
    folders: Annotated[
        list[Path] | None, typer.Argument(help="Run folders, or folders of runs; default: runs.", show_default=False)
    ] = None,
    machine: Annotated[str | None, typer.Option(help="Only the runs of this machine.")] = None,
    method: Annotated[str | None, typer.Option(help="Only the runs of this method.")] = None,
    since: Annotated[str | None, typer.Option(metavar="DATE", help="Only runs from this date on, UTC.")] = None,
    tolerances: Annotated[
        Path | None, typer.Option("--tolerances", help="A TOML file of limits, in place of those of the runs.")
    ] = None,
    json_: Json = False,
) -> None:
    """List the runs of folders, newest first, each with its figure of merit."""
    from errormotion.cli.commands.runs import listing as command

    command.runs(folders or [], machine, method, since, tolerances, json_)


@app.command("open")
@guarded
def open_(
    place: Annotated[
        Path, typer.Argument(help="A run folder, a folder of runs (its newest run with a report), or a page.")
    ] = Path("runs"),
    browser: Annotated[bool, typer.Option(help="Open the browser; without, print the path only.")] = True,
    json_: Json = False,
) -> None:
    """Open the last report in the browser, and print its path."""
    from errormotion.cli.commands.results import show as command

    command.open_report(place, browser=browser, as_json=json_)


@app.command()
@guarded
def export(
    result: Annotated[Path, typer.Argument(help="A run folder, or a NetCDF file of errors.")],
    out: Annotated[Path, typer.Option(help="The file to write: .csv, .xlsx, .nc or .zarr; it must not exist.")],
    freedoms: Annotated[str | None, typer.Option(help="Which are written: EX,EZ; default: all.")] = None,
    at: Annotated[str | None, typer.Option(help="Functional point, mm; default: that of the result.")] = None,
    k: Annotated[float, typer.Option("-k", min=0, max=10, help="Coverage factor of the uncertainties.")] = 2.0,
    json_: Json = False,
) -> None:
    """Write the tables of a result for a spreadsheet, in field units, or the dataset as NetCDF."""
    from errormotion.cli.commands.results import export as command

    point = None if at is None else _millimetres("--at", at)
    chosen = [part.strip() for part in freedoms.split(",")] if freedoms else None
    command.export(result, out, chosen, point, k, json_)


@app.command()
@guarded
def dashboard(
    runs: Annotated[Path, typer.Argument(help="The folder of runs.")] = Path("runs"),
    bench: Annotated[Path | None, typer.Option(help="A bench file: its thermometers and controller are read.")] = None,
    interval: Annotated[str, typer.Option(help="Of the readings of the bench, such as '1 s'.")] = "1 s",
    host: Annotated[
        str, typer.Option(help="Address to listen on. Others than 127.0.0.1 are open to the network: with a token.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to listen on.")] = 5006,
    name: Annotated[
        list[str] | None, typer.Option(help="A further name by which browsers reach this computer; repeatable.")
    ] = None,
    cert: Annotated[Path | None, typer.Option(help="Certificate (PEM) of an encrypted connection.")] = None,
    key: Annotated[Path | None, typer.Option(help="Key (PEM) of the certificate.")] = None,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser of this computer.")] = True,
    campaigns: Annotated[Path, typer.Option(help="The folder of the campaign files.")] = Path(),
    allow_control: Annotated[
        bool, typer.Option("--allow-control", help="Let the pages start and stop what moves or changes a machine.")
    ] = False,
) -> None:
    """Show runs, and the instruments of a bench, in a browser, until Ctrl-C."""
    from errormotion.cli.commands import dashboard as command

    command.run(runs, bench, interval, host, port, name or [], cert, key, browser, campaigns, allow_control)


Process = Annotated[str | None, typer.Option(help="Name of the process; needed if there are several.")]
OfRuns = Annotated[Path, typer.Argument(help="The folder of runs.")]


@background_app.command("list")
@guarded
def background_list(runs: OfRuns = Path("runs"), json_: Json = False) -> None:
    """List the processes of a folder of runs: where they are, and what they request."""
    from errormotion.cli.commands.campaigns import background as command

    command.listed(runs, json_)


@background_app.command("answer")
@guarded
def background_answer(runs: OfRuns = Path("runs"), process: Process = None) -> None:
    """State that the request to the operator is done."""
    from errormotion.cli.commands.campaigns import background as command

    command.answer(runs, process)


@background_app.command("stop")
@guarded
def background_stop(runs: OfRuns = Path("runs"), process: Process = None) -> None:
    """Stop a campaign, as Ctrl-C does; it can be resumed."""
    from errormotion.cli.commands.campaigns import background as command

    command.stop(runs, process)


@app.command()
@guarded
def note(
    folder: Annotated[Path, typer.Argument(help="A run folder; or a folder of runs, with --machine and --at.")],
    text: Annotated[str, typer.Argument(help="What happened, on one line.")],
    machine: Annotated[str | None, typer.Option(help="The machine, for a note without a run.")] = None,
    at: Annotated[
        str | None, typer.Option(metavar="DATE", help="When it happened, UTC; default: the time of the run.")
    ] = None,
    by: Annotated[str, typer.Option(metavar="NAME", help="Who notes it.")] = "",
    json_: Json = False,
) -> None:
    """Note an event of a machine, such as a collision or a repair."""
    from errormotion.cli.commands.runs import note as command

    command.note(folder, text, machine, at, by, json_)


@app.command()
@guarded
def history(
    machine: Annotated[str, typer.Option(help="The machine.")],
    figure: Annotated[
        str, typer.Option(help="A figure of merit (* stands for any characters), or a freedom such as EZ.")
    ],
    folders: Annotated[
        list[Path] | None, typer.Argument(help="Folders of runs; default: runs.", show_default=False)
    ] = None,
    at: Annotated[str | None, typer.Option(help="Place of the freedom 'x,y,z', mm.")] = None,
    method: Annotated[str | None, typer.Option(help="Only the runs of this method.")] = None,
    test: Annotated[str | None, typer.Option(help="Only the runs of this test.")] = None,
    out: Annotated[Path | None, typer.Option(help="Write the history as a dataset (.nc).")] = None,
    report: Annotated[Path | None, typer.Option(help="Write a page (.html).")] = None,
    pdf: Pdf = False,
    paper: Paper = None,
    language: Language = None,
    json_: Json = False,
) -> None:
    """Show a figure of a machine over time: trend, steps, control limits, notes."""
    from errormotion.cli.commands.runs import history as command

    point = None if at is None else _millimetres("--at", at)
    command.history(
        folders or [], machine, figure, point, method, test, out, page_of(report, pdf, paper, language), json_
    )


@app.command()
@guarded
def doctor(json_: Json = False) -> None:
    """Check that this computer has what errormotion needs."""
    from errormotion.cli.commands import doctor as command

    findings = command.examine()
    if json_:
        show_json({"ok": all(f.ok for f in findings), "findings": [f.__dict__ for f in findings]})
    else:
        show(table(["", "what", "found"], [["ok" if f.ok else "BAD", f.name, f.message] for f in findings]))
    if not all(f.ok for f in findings):
        raise typer.Exit(ERROR)


@plugins_app.command("list")
@guarded
def plugins_list(json_: Json = False) -> None:
    """List all plugins, those that do not load included."""
    from errormotion.cli.commands.plugins import listing as command

    command.list_plugins(json_)


@plugins_app.command("show")
@guarded
def plugins_show(plugin: Annotated[str, typer.Argument(help="Its id.")], json_: Json = False) -> None:
    """Show the description of a plugin and its settings."""
    from errormotion.cli.commands.plugins import listing as command

    command.show_plugin(plugin, json_)


@plugins_app.command("check")
@guarded
def plugins_check(
    plugin: Annotated[str, typer.Argument(help="Its id.")],
    address: Annotated[str | None, typer.Option(help="Address of a real instrument; default: its simulator.")] = None,
    mutants: Annotated[
        int | None, typer.Option(min=0, help="Changed frames to try: default 300 in 6 s; of more, all.")
    ] = None,
    json_: Json = False,
) -> None:
    """Run the conformance kit on a plugin."""
    from errormotion.cli.commands.plugins import listing as command

    if not command.check_plugin(plugin, address, mutants, json_):
        raise typer.Exit(INVALID)


@plugins_app.command("new")
@guarded
def plugins_new(
    what: Annotated[
        Literal["instrument", "method", "compensator"], typer.Argument(help="instrument, method or compensator.")
    ],
    name: Annotated[str, typer.Argument(help="Name of the plugin; its id is made from it.")],
    out: Annotated[Path | None, typer.Option(help="Folder to write; default: errormotion-NAME.")] = None,
    json_: Json = False,
) -> None:
    """Write a new distribution with a plugin that passes the conformance kit."""
    from errormotion.cli.commands.plugins import new as command

    command.new(what, name, out, json_)


@bench_app.command("validate")
@guarded
def bench_validate(file: Annotated[Path, typer.Argument(help="A bench file.")], json_: Json = False) -> None:
    """Check a bench file; nothing is opened."""
    from errormotion.campaign.files import load_bench
    from errormotion.errors import BenchError

    try:
        plan = load_bench(file)
    except BenchError as error:
        if json_:
            show_json({"ok": False, "file": str(file), "message": str(error)})
        typer.echo(str(error), err=True)
        raise typer.Exit(INVALID) from error
    rows = [[i.name, i.driver.info.id, i.driver.info.kind, i.address] for i in plan.instruments]
    if json_:
        keys = ("name", "driver", "kind", "address")
        instruments = [dict(zip(keys, row, strict=True)) for row in rows]
        show_json(
            {"ok": True, "file": str(file), "name": plan.name, "machine": plan.machine, "instruments": instruments}
        )
    else:
        show(f"{file}: valid. Bench '{plan.name}', machine '{plan.machine}'.")
        show(table(["instrument", "driver", "kind", "address"], rows))


@bench_app.command("probe")
@guarded
def bench_probe(file: Annotated[Path, typer.Argument(help="A bench file.")], json_: Json = False) -> None:
    """Open, identify and read every instrument once."""
    from errormotion.cli.commands.instruments import bench as command

    if not command.probe(file, json_):
        raise typer.Exit(ERROR)


@model_app.command("fit")
@guarded
def model_fit(
    campaigns: Annotated[list[Path], typer.Argument(help="Errors over time with temperatures: NetCDF or run folders.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The model to write, .nc; it must not exist.")],
    set_: Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One setting.")] = None,
    settings: Annotated[Path | None, typer.Option(help="A TOML file of settings.")] = None,
    json_: Json = False,
) -> None:
    """Fit a thermal model to the errors of warm-ups."""
    from errormotion.cli.commands.compensation import model as command

    command.make(campaigns, out, set_ or [], settings, json_)


@model_app.command("predict")
@guarded
def model_predict(
    model: Annotated[Path, typer.Argument(help="A thermal model.")],
    data: Annotated[Path, typer.Argument(help="Temperatures over time: NetCDF, Zarr, or a run folder.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The errors to write, .nc; it must not exist.")],
    json_: Json = False,
) -> None:
    """Predict errors from temperatures and working parameters."""
    from errormotion.cli.commands.compensation import model as command

    command.predict(model, data, out, json_)


@model_app.command("check")
@guarded
def model_check(
    model: Annotated[Path, typer.Argument(help="A thermal model.")],
    errors: Annotated[
        Path, typer.Argument(help="Measured errors that the model was not fitted to: NetCDF or a run folder.")
    ],
    report: Annotated[Path | None, typer.Option(help="Write a report of the comparison, .html.")] = None,
    pdf: Pdf = False,
    paper: Paper = None,
    language: Language = None,
    json_: Json = False,
) -> None:
    """Compare the prediction of a model with measured errors."""
    from errormotion.cli.commands.compensation import model as command

    command.check_model(model, errors, page_of(report, pdf, paper, language), json_)


@compensate_app.command("effect")
@guarded
def compensate_effect(
    before: Annotated[Path, typer.Argument(help="Errors without the compensation: NetCDF, run folder, or runs.")],
    after: Annotated[Path, typer.Argument(help="Errors of the same machine with it.")],
    at: Annotated[str | None, typer.Option(help="Functional point 'x,y,z', mm; default: that of BEFORE.")] = None,
    over: Annotated[
        str | None, typer.Option(metavar="DIM", help="What the errors are compared over: time, position or target.")
    ] = None,
    select: Annotated[
        list[str] | None, typer.Option(help="One element of another dimension, counted from 0: position=3.")
    ] = None,
    freedoms: Annotated[str | None, typer.Option(help="Which are compared: EX,EZ; default: all known ones.")] = None,
    since: Annotated[float | None, typer.Option(help="Reference state, s after time 0 of both.")] = None,
    tolerances: Annotated[
        Path | None, typer.Option("--tolerances", help="A TOML file of limits; decide on both, and on the reduction.")
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Write a page (.html).")] = None,
    pdf: Pdf = False,
    paper: Paper = None,
    language: Language = None,
    json_: Json = False,
) -> None:
    """Compare two results of one machine: what a compensation took off, and what is left."""
    from errormotion.cli.commands.compensation import effect as command

    point = None if at is None else _millimetres("--at", at)
    chosen = [part.strip() for part in freedoms.split(",")] if freedoms else []
    code = command.run(
        before,
        after,
        at=point,
        over=over,
        select=select or [],
        freedoms=chosen,
        since=since,
        tolerances=tolerances,
        page=page_of(report, pdf, paper, language),
        as_json=json_,
    )
    raise typer.Exit(code)


@compensate_app.command("table")
@guarded
def compensate_table(
    errors: Annotated[Path, typer.Argument(help="Errors over position or targets: NetCDF or a run folder.")],
    for_: Annotated[
        str,
        typer.Option("--for", metavar="CONTROL", help="Format, such as siemens or generic; a wrong one lists all."),
    ],
    axis: Annotated[str, typer.Option(help="Axis along which the points are: X, Y or Z.")],
    component: Annotated[str, typer.Option(help="Axis that is corrected; default: the same.")] = "",
    step: Annotated[str | None, typer.Option(help="Distance between points, such as 25mm; default: measured.")] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the files.")] = Path(),
    at: Annotated[str, typer.Option(help="Positions of the other axes, mm: x,y,z.")] = "0,0,0",
    time: Annotated[str | None, typer.Option(help="Instant of errors over time, such as '90 min'.")] = None,
    point: Annotated[str | None, typer.Option("--functional-point", help="Tool, mm: x,y,z; default: measured.")] = None,
    chain: Annotated[str, typer.Option(help="Chain of the machine, where the errors do not state it.")] = "",
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One setting of the format.")
    ] = None,
    json_: Json = False,
) -> None:
    """Write a compensation table of one axis for a control."""
    from errormotion.cli.commands.compensation import tables as command

    place = _millimetres("--at", at)
    tool = None if point is None else _millimetres("--functional-point", point)
    command.table(errors, for_, command.Choice(axis, component, step, place, time, tool, chain), out, set_ or [], json_)


@compensate_app.command("program")
@guarded
def compensate_program(
    part: Annotated[Path, typer.Argument(help="An NC program, RS-274 (ISO 6983).")],
    with_: Annotated[
        list[Path], typer.Option("--with", help="Errors (NetCDF or run folder) or a thermal model; several add up.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="The new program; default: PART.corrected.ngc.")
    ] = None,
    temperatures: Annotated[Path | None, typer.Option(help="Temperatures over time, for a thermal model.")] = None,
    time: Annotated[
        str | None, typer.Option(help="Instant of errors over time, such as '90 min'; default: the last.")
    ] = None,
    tolerance: Annotated[str, typer.Option(help="Largest distance from the corrected path.")] = "1um",
    sampling: Annotated[str, typer.Option(help="Largest distance of points at which it is examined.")] = "2mm",
    parameters: Annotated[
        Path | None, typer.Option(help="Parameter file of LinuxCNC (.var): work offsets, G92, G28.")
    ] = None,
    offset: Annotated[
        list[str] | None, typer.Option(metavar="G54=X,Y,Z", help="Origin of a work offset in machine coordinates, mm.")
    ] = None,
    tools: Annotated[Path | None, typer.Option(help="Tool table of LinuxCNC (.tbl).")] = None,
    machine_unit: Annotated[str, typer.Option(help="Unit of these two files: mm or inch.")] = "mm",
    point: Annotated[
        str | None, typer.Option("--functional-point", help="Of all tools, mm: x,y,z; default: measured.")
    ] = None,
    gauge: Annotated[
        str | None, typer.Option("--gauge-point", help="Of a tool of length 0, mm: x,y,z; lengths from --tools.")
    ] = None,
    start: Annotated[str | None, typer.Option(help="Machine position before the program, mm: x,y,z.")] = None,
    unit: Annotated[str, typer.Option(help="Unit before the first G20 or G21: mm or inch.")] = "mm",
    block_delete: Annotated[
        str | None, typer.Option("--block-delete", help="skip or run blocks that start with '/'.")
    ] = None,
    reader: Annotated[str, typer.Option(help="auto, plain, or interpreter (that of LinuxCNC).")] = "auto",
    check: Annotated[bool, typer.Option("--check", help="LinuxCNC's interpreter must read the result alike.")] = False,
    partial: Annotated[bool, typer.Option("--partial", help="Leave out freedoms that are not known.")] = False,
    report: Annotated[Path | None, typer.Option(help="Write a page with the correction along the path, .html.")] = None,
    pdf: Pdf = False,
    paper: Paper = None,
    language: Language = None,
    json_: Json = False,
) -> None:
    """Write an NC program whose cuts are where those of another were meant."""
    from errormotion.cli.commands.compensation import program as command

    origins = []
    for text in offset or []:
        name, _, place = text.partition("=")
        origins.append((name, _millimetres("--offset", place)))
    choice = command.Choice(
        temperatures=temperatures,
        time=time,
        tolerance=tolerance,
        sampling=sampling,
        parameters=parameters,
        tools=tools,
        machine_unit=machine_unit,
        origins=tuple(origins),
        functional_point=None if point is None else _millimetres("--functional-point", point),
        gauge_point=None if gauge is None else _millimetres("--gauge-point", gauge),
        start=None if start is None else _millimetres("--start", start),
        unit=unit,
        block_delete=block_delete,
        reader=reader,
        check=check,
        partial=partial,
        page=page_of(report, pdf, paper, language),
    )
    command.program(part, with_, choice, out, json_)


share(app, plugins_app, bench_app, model_app, compensate_app)
