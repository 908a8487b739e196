"""The command line: the groups of commands, and the commands that belong to no group.

Modules called ``interface`` state the arguments of commands; each command imports what it needs when it is called, so
that ``--help`` is fast.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from errormotion.cli import options
from errormotion.cli.demo import COMPENSATED, CONTROLLERS
from errormotion.cli.guard import ERROR, UsageError
from errormotion.cli.output import failure, show, show_json, table
from errormotion.cli.root import app, bench_app, compensate_app, model_app, plugins_app
from errormotion.cli.wording import share


def _version(value: bool) -> None:
    if value:
        from errormotion import __version__

        show(f"errormotion {__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Measure the error motions of machine tools."""
    del version


@app.command()
def demo(
    runs: Annotated[Path, typer.Option(help="Folder for the run folders.")] = Path("runs"),
    controller: Annotated[
        str,
        typer.Option(help=f"Controller of the machine: {', '.join(CONTROLLERS)}. All but the first must be installed."),
    ] = next(iter(CONTROLLERS)),
    compensate: Annotated[
        bool, typer.Option("--compensate", help="Fit a thermal model to one warm-up, and compensate further warm-ups.")
    ] = False,
    json_: options.Json = False,
) -> None:
    """Measure a virtual machine and compare with the truth."""
    shown = COMPENSATED if compensate else CONTROLLERS
    if controller not in shown:
        raise UsageError(f"--controller {controller}: expected one of {', '.join(shown)}.", code="option.choice")
    import_module(shown[controller]).run(runs, json_)


GROUPS = ("campaigns", "results", "instruments", "runs", "compensation", "plugins")
"""Folders of `errormotion.cli.commands`, in the order of their commands in ``--help``."""
for _group in GROUPS:
    import_module(f"errormotion.cli.commands.{_group}.interface")


@app.command()
def dashboard(
    runs: Annotated[Path, typer.Argument(help="The folder of runs.")] = Path("runs"),
    bench: Annotated[Path | None, typer.Option(help="A bench file; its thermometers and controller are read.")] = None,
    interval: Annotated[str, typer.Option(help="Interval between readings of the bench, such as '1 s'.")] = "1 s",
    host: Annotated[
        str,
        typer.Option(help="Address to listen on. Any other than 127.0.0.1 is open to the network and needs a token."),
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to listen on.")] = 5006,
    name: Annotated[
        list[str] | None,
        typer.Option(metavar="HOST", help="Another host name by which browsers reach this computer; may be repeated."),
    ] = None,
    cert: Annotated[Path | None, typer.Option(help="Certificate (PEM) for an encrypted connection.")] = None,
    key: Annotated[Path | None, typer.Option(help="Private key (PEM) of the certificate.")] = None,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser of this computer.")] = True,
    campaigns: Annotated[Path, typer.Option(help="The folder of the campaign files.")] = Path(),
    allow_control: Annotated[
        bool, typer.Option("--allow-control", help="Allow the pages to start and stop campaigns and compensations.")
    ] = False,
) -> None:
    """Show runs and instruments in a browser, until Ctrl-C."""
    from errormotion.cli.commands import dashboard as command

    command.run(runs, bench, interval, host, port, name or [], cert, key, browser, campaigns, allow_control)


@app.command()
def doctor(json_: options.Json = False) -> None:
    """Check that this computer has what errormotion needs."""
    from errormotion.cli.commands import doctor as command

    findings = command.examine()
    if json_:
        bad = [f"{f.name}: {f.message}" for f in findings if not f.ok]
        error = failure("\n".join(bad), code="doctor.findings") if bad else {}
        show_json({"ok": not bad, "findings": [f.__dict__ for f in findings], **error})
    else:
        show(
            table(
                ["", "what", "found"],
                [["-" if f.absent else "ok" if f.ok else "BAD", f.name, f.message] for f in findings],
            )
        )
    if not all(f.ok for f in findings):
        raise typer.Exit(ERROR)


share(app, plugins_app, bench_app, model_app, compensate_app)

__all__ = ["app"]
