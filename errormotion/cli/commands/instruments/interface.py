"""Arguments of the commands on benches and instruments; imports of a command are inside its function."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from errormotion.cli import options
from errormotion.cli.guard import ERROR, INVALID, fail
from errormotion.cli.output import show, show_json, table
from errormotion.cli.root import app, bench_app


@bench_app.command("validate")
def bench_validate(file: Annotated[Path, typer.Argument(help="A bench file.")], json_: options.Json = False) -> None:
    """Check a bench file; nothing is opened."""
    from errormotion.campaign.files import load_bench
    from errormotion.errors import BenchError

    try:
        plan = load_bench(file)
    except BenchError as error:
        fail(str(error), error, INVALID, json_)
        return
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
def bench_probe(file: Annotated[Path, typer.Argument(help="A bench file.")], json_: options.Json = False) -> None:
    """Open, identify and read every instrument once."""
    from errormotion.cli.commands.instruments import bench as command

    if not command.probe(file, json_):
        raise typer.Exit(ERROR)


@app.command()
def calibrate(
    data: Annotated[Path, typer.Argument(help="Readings of a sensor against a reference: NetCDF or CSV.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="File of the calibration (.nc); it must not exist.")],
    set_: options.Set = None,
    settings: options.SettingsFile = None,
    json_: options.Json = False,
) -> None:
    """Make a calibration from readings."""
    from errormotion.cli.commands.instruments import calibrate as command

    command.run(data, out, set_ or [], settings, json_)


@app.command()
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


@app.command()
def simulate(
    plugin: Annotated[str, typer.Argument(help="The id of an instrument or a compensator.")],
    port: Annotated[
        int | None,
        typer.Option(min=0, max=65535, help="Port; a second line uses the next one. Default: a free port."),
    ] = None,
    host: Annotated[
        str | None, typer.Option(help="Address on which the device listens; default: 127.0.0.1, this computer only.")
    ] = None,
    fault: Annotated[str | None, typer.Option(help="A fault of the device, such as silence, split or late.")] = None,
    bench: Annotated[Path | None, typer.Option(help="A bench file that states the machine and the device.")] = None,
    machine: Annotated[str | None, typer.Option(help="The virtual machine: cframe (default) or gantry.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the errors of the virtual machine.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="One parameter of the simulated device; may be repeated."),
    ] = None,
    json_: options.Json = False,
) -> None:
    """Start the simulated device of an instrument as a server, until Ctrl-C."""
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
def record(
    bench: Annotated[Path, typer.Argument(help="A bench file.")],
    instrument: Annotated[str, typer.Argument(help="The name of one of its instruments.")],
    for_: Annotated[str, typer.Option("--for", metavar="TIME", help="Duration of the session.")] = "10 s",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="File; default: INSTRUMENT-TIME.rec.")] = None,
    mask_serial: Annotated[bool, typer.Option("--mask-serial", help="Mask the serial number.")] = False,
    json_: options.Json = False,
) -> None:
    """Record a short session with one instrument: identity, readings, stream."""
    from errormotion.cli.commands.instruments import record as command

    if not command.record(bench, instrument, for_, out, mask_serial, json_):
        raise typer.Exit(ERROR)


@app.command()
def replay(
    recording: Annotated[Path, typer.Argument(help="A recording made by 'errormotion record'.")],
    json_: options.Json = False,
) -> None:
    """Run the driver on a recorded session, and report whether it was reproduced."""
    from errormotion.cli.commands.instruments import record as command

    if not command.replay(recording, json_):
        raise typer.Exit(INVALID)
