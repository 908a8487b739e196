"""Arguments of the commands on thermal models and compensation; imports of a command are inside its function."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from errormotion.cli import options
from errormotion.cli.page import page_of
from errormotion.cli.root import compensate_app, model_app


@model_app.command("fit")
def model_fit(
    campaigns: Annotated[list[Path], typer.Argument(help="Errors over time with temperatures: NetCDF or run folders.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File of the model (.nc); it must not exist.")],
    set_: options.Set = None,
    settings: options.SettingsFile = None,
    json_: options.Json = False,
) -> None:
    """Fit a thermal model to the errors of warm-ups."""
    from errormotion.cli.commands.compensation import model as command

    command.make(campaigns, out, set_ or [], settings, json_)


@model_app.command("predict")
def model_predict(
    model: Annotated[Path, typer.Argument(help="A thermal model.")],
    data: Annotated[Path, typer.Argument(help="Temperatures over time: NetCDF, Zarr, or a run folder.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File of the errors (.nc); it must not exist.")],
    json_: options.Json = False,
) -> None:
    """Predict errors from temperatures and working parameters."""
    from errormotion.cli.commands.compensation import model as command

    command.predict(model, data, out, json_)


@model_app.command("check")
def model_check(
    model: Annotated[Path, typer.Argument(help="A thermal model.")],
    errors: Annotated[Path, typer.Argument(help="Measured errors not used in the fit: NetCDF or a run folder.")],
    report: Annotated[Path | None, typer.Option(help="Write a report of the comparison (.html).")] = None,
    pdf: options.Pdf = False,
    paper: options.Paper = None,
    language: options.Language = None,
    json_: options.Json = False,
) -> None:
    """Compare the prediction of a model with measured errors."""
    from errormotion.cli.commands.compensation import model as command

    command.check_model(model, errors, page_of(report, pdf, paper, language), json_)


@compensate_app.command("run")
def compensate_run(
    bench: Annotated[Path, typer.Argument(help="A bench file with thermometers and, for --arm, [compensator].")],
    model: Annotated[Path, typer.Option("--model", "-m", help="A thermal model of the machine.")],
    arm: Annotated[
        str | None,
        typer.Option(metavar="MACHINE", help="Write offsets; states the name of the machine in the bench file."),
    ] = None,
    since: Annotated[
        Path | None,
        typer.Option(help="Log of a monitor or an earlier compensation that started in the reference state."),
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Functional point of the compensation, mm; default: that of the model."),
    ] = None,
    runs: Annotated[Path, typer.Option(help="Folder for the run folder.")] = Path("runs"),
    duration: Annotated[str | None, typer.Option(help="Ramp to zero and end after this time; default: never.")] = None,
    json_: Annotated[bool, typer.Option("--json", help="Print one JSON document for each interval.")] = False,
) -> None:
    """Compensate a machine by offsets that follow its temperatures; without --arm, only compute and log them."""
    from errormotion.cli.commands.compensation import follow as command

    point = options.optional_point("--at", at)
    code = command.run(
        bench, model, runs, arm=arm, since=since, functional_point=point, duration=duration, as_json=json_
    )
    raise typer.Exit(code)


@compensate_app.command("status")
def compensate_status(
    folder: Annotated[Path, typer.Argument(help="A folder of runs, or the run folder of a compensation.")] = Path(
        "runs"
    ),
    json_: options.Json = False,
) -> None:
    """Show the present state of compensations, and check their audit logs."""
    from errormotion.cli.commands.compensation import following as command

    raise typer.Exit(command.status(folder, json_))


@compensate_app.command("stop")
def compensate_stop(
    folder: Annotated[Path, typer.Argument(help="The run folder of a compensation.")],
    json_: options.Json = False,
) -> None:
    """Ramp a compensation to zero and end it, as Ctrl-C in its terminal does."""
    from errormotion.cli.commands.compensation import following as command

    command.stop(folder, json_)


@compensate_app.command("effect")
def compensate_effect(
    before: Annotated[Path, typer.Argument(help="Errors without compensation: NetCDF, run folder, or folder of runs.")],
    after: Annotated[Path, typer.Argument(help="Errors of the same machine with the compensation.")],
    at: Annotated[str | None, typer.Option(help="Functional point 'x,y,z', mm; default: that of BEFORE.")] = None,
    over: options.Over = None,
    select: options.Select = None,
    freedoms: options.Freedoms = None,
    since: Annotated[float | None, typer.Option(help="Time of the reference state in both results, s.")] = None,
    tolerances: Annotated[
        Path | None,
        typer.Option("--tolerances", help="A TOML file of limits; decide on both results and on the reduction."),
    ] = None,
    report: options.Report = None,
    pdf: options.Pdf = False,
    paper: options.Paper = None,
    language: options.Language = None,
    json_: options.Json = False,
) -> None:
    """Compare results without and with a compensation: the reduction and the remaining errors."""
    from errormotion.cli.commands.compensation import effect as command

    code = command.run(
        before,
        after,
        at=options.optional_point("--at", at),
        over=over,
        select=select or [],
        freedoms=options.parts(freedoms),
        since=since,
        tolerances=tolerances,
        page=page_of(report, pdf, paper, language),
        as_json=json_,
    )
    raise typer.Exit(code)


@compensate_app.command("table")
def compensate_table(
    errors: Annotated[Path, typer.Argument(help="Errors over position or targets: NetCDF or a run folder.")],
    for_: Annotated[
        str,
        typer.Option("--for", metavar="CONTROL", help="Format, such as siemens; an unknown name lists all formats."),
    ],
    axis: Annotated[str, typer.Option(help="Axis along which the points of the table lie: X, Y or Z.")],
    component: Annotated[str, typer.Option(help="Axis that is corrected; default: the same axis.")] = "",
    step: Annotated[
        str | None, typer.Option(help="Distance between points, such as 25mm; default: that of the measured points.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")] = Path(),
    at: Annotated[str, typer.Option(help="Positions of the other axes, mm: x,y,z.")] = "0,0,0",
    time: Annotated[str | None, typer.Option(help="Instant of errors over time, such as '90 min'.")] = None,
    functional_point: Annotated[
        str | None, typer.Option(help="Functional point of the tool, mm; default: that of the errors.")
    ] = None,
    chain: Annotated[str, typer.Option(help="Kinematic chain of the machine, if the errors do not state it.")] = "",
    set_: options.Set = None,
    json_: options.Json = False,
) -> None:
    """Write a compensation table of one axis for a control."""
    from errormotion.cli.commands.compensation import tables as command

    tool = options.optional_point("--functional-point", functional_point)
    choice = command.Choice(axis, component, step, options.point("--at", at), time, tool, chain)
    command.table(errors, for_, choice, out, set_ or [], json_)


@compensate_app.command("program")
def compensate_program(
    part: Annotated[Path, typer.Argument(help="An NC program, RS-274 (ISO 6983).")],
    with_: Annotated[
        list[Path],
        typer.Option(
            "--with", help="Errors (NetCDF or run folder) or a thermal model; the errors of several are added."
        ),
    ],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="New program; default: PART.corrected.ngc.")] = None,
    temperatures: Annotated[Path | None, typer.Option(help="Temperatures over time, for a thermal model.")] = None,
    time: Annotated[str | None, typer.Option(help="Time of errors over time, such as '90 min'; default: last.")] = None,
    tolerance: Annotated[str, typer.Option(help="Largest deviation from the corrected path.")] = "1um",
    sampling: Annotated[str, typer.Option(help="Largest distance between examined points of the path.")] = "2mm",
    parameters: Annotated[Path | None, typer.Option(help="LinuxCNC parameter file (.var): work offsets, G28.")] = None,
    offset: Annotated[
        list[str] | None, typer.Option(metavar="G54=X,Y,Z", help="Origin of a work offset in machine coordinates, mm.")
    ] = None,
    tools: Annotated[Path | None, typer.Option(help="Tool table of LinuxCNC (.tbl).")] = None,
    machine_unit: Annotated[str, typer.Option(help="Unit of --parameters and --tools: mm or inch.")] = "mm",
    functional_point: Annotated[
        str | None, typer.Option(help="Functional point of all tools, mm; default: that of the errors.")
    ] = None,
    gauge: Annotated[
        str | None,
        typer.Option("--gauge-point", help="Functional point of a tool of length 0, mm; lengths from --tools."),
    ] = None,
    start: Annotated[str | None, typer.Option(help="Machine position before the program, mm.")] = None,
    unit: Annotated[str, typer.Option(help="Unit before the first G20 or G21: mm or inch.")] = "mm",
    block_delete: Annotated[
        str | None, typer.Option("--block-delete", help="skip or run: how blocks that start with '/' are treated.")
    ] = None,
    reader: Annotated[str, typer.Option(help="Reader: auto, plain, or interpreter (that of LinuxCNC).")] = "auto",
    check: Annotated[bool, typer.Option("--check", help="Check the new program with LinuxCNC's interpreter.")] = False,
    partial: Annotated[bool, typer.Option("--partial", help="Leave out unknown freedoms.")] = False,
    report: Annotated[Path | None, typer.Option(help="Write a page (.html) with path and correction.")] = None,
    pdf: options.Pdf = False,
    paper: options.Paper = None,
    language: options.Language = None,
    json_: options.Json = False,
) -> None:
    """Write a corrected NC program, so that the tool follows the programmed path despite errors of the machine."""
    from errormotion.cli.commands.compensation import program as command

    origins = []
    for text in offset or []:
        name, _, origin = text.partition("=")
        origins.append((name, options.point("--offset", origin)))
    choice = command.Choice(
        temperatures=temperatures,
        time=time,
        tolerance=tolerance,
        sampling=sampling,
        parameters=parameters,
        tools=tools,
        machine_unit=machine_unit,
        origins=tuple(origins),
        functional_point=options.optional_point("--functional-point", functional_point),
        gauge_point=options.optional_point("--gauge-point", gauge),
        start=options.optional_point("--start", start),
        unit=unit,
        block_delete=block_delete,
        reader=reader,
        check=check,
        partial=partial,
        page=page_of(report, pdf, paper, language),
    )
    command.program(part, with_, choice, out, json_)
