"""Arguments of the commands on plugins. What a command needs is imported when it runs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from errormotion.cli.guard import INVALID, guarded
from errormotion.cli.root import Json, plugins_app


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
