"""Arguments of the commands on thermal models and compensation. What a command needs is imported when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from errormotion.cli.guard import guarded
from errormotion.cli.page import page_of
from errormotion.cli.root import Json, Language, Paper, Pdf, compensate_app, millimetres, model_app


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

    point = None if at is None else millimetres("--at", at)
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

    point = None if at is None else millimetres("--at", at)
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

    place = millimetres("--at", at)
    tool = None if point is None else millimetres("--functional-point", point)
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
        origins.append((name, millimetres("--offset", place)))
    choice = command.Choice(
        temperatures=temperatures,
        time=time,
        tolerance=tolerance,
        sampling=sampling,
        parameters=parameters,
        tools=tools,
        machine_unit=machine_unit,
        origins=tuple(origins),
        functional_point=None if point is None else millimetres("--functional-point", point),
        gauge_point=None if gauge is None else millimetres("--gauge-point", gauge),
        start=None if start is None else millimetres("--start", start),
        unit=unit,
        block_delete=block_delete,
        reader=reader,
        check=check,
        partial=partial,
        page=page_of(report, pdf, paper, language),
    )
    command.program(part, with_, choice, out, json_)
