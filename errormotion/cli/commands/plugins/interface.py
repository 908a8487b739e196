"""Arguments of the commands on plugins; imports of a command are inside its function."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from errormotion.cli import options
from errormotion.cli.guard import INVALID
from errormotion.cli.root import plugins_app


@plugins_app.command("list")
def plugins_list(json_: options.Json = False) -> None:
    """List all plugins, including those that cannot be loaded."""
    from errormotion.cli.commands.plugins import listing as command

    command.list_plugins(json_)


@plugins_app.command("show")
def plugins_show(plugin: Annotated[str, typer.Argument(help="Id of the plugin.")], json_: options.Json = False) -> None:
    """Show the description of a plugin and its settings."""
    from errormotion.cli.commands.plugins import listing as command

    command.show_plugin(plugin, json_)


@plugins_app.command("check")
def plugins_check(
    plugin: Annotated[str, typer.Argument(help="Id of the plugin.")],
    address: Annotated[str | None, typer.Option(help="Address of a real instrument; default: its simulator.")] = None,
    mutants: Annotated[
        int | None, typer.Option(min=0, help="Number of changed frames to try; default: 300, in at most 6 s.")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option("--only", help="Name of a check to run; can be repeated. Default: all.")
    ] = None,
    json_: options.Json = False,
) -> None:
    """Run the conformance kit on a plugin."""
    from errormotion.cli.commands.plugins import listing as command

    if not command.check_plugin(plugin, address, mutants, only or (), json_):
        raise typer.Exit(INVALID)


@plugins_app.command("new")
def plugins_new(
    what: Annotated[Literal["instrument", "method", "compensator"], typer.Argument(help="Kind of plugin.")],
    name: Annotated[str, typer.Argument(help="Name of the plugin; its id is made from it.")],
    out: Annotated[Path | None, typer.Option(help="Folder to write; default: errormotion-NAME.")] = None,
    json_: options.Json = False,
) -> None:
    """Write a new distribution with a plugin that passes the conformance kit."""
    from errormotion.cli.commands.plugins import new as command

    command.new(what, name, out, json_)
