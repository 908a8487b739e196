"""The application, its groups of commands, and the options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from errormotion.cli.guard import USAGE

app = typer.Typer(
    name="errormotion",
    help="Measure the error motions of machine tools.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _group(name: str, text: str) -> typer.Typer:
    group = typer.Typer(no_args_is_help=True, help=text, rich_markup_mode=None)
    app.add_typer(group, name=name)
    return group


plugins_app = _group("plugins", "Instruments, methods and kinds of dataset.")
bench_app = _group("bench", "Check a bench file, or the instruments of a bench.")
model_app = _group("model", "Thermal models: errors predicted from temperatures.")
compensate_app = _group("compensate", "Compensate measured errors.")
background_app = _group("background", "Campaigns that 'errormotion run --detach' or the dashboard has started.")

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


def millimetres(option: str, text: str) -> tuple[float, float, float]:
    """Return the point that an option states in mm, m."""
    try:
        x, y, z = (float(part) / 1e3 for part in text.split(","))
    except ValueError:
        typer.echo(f"{option} {text}: expected three numbers in mm, as in 0,0,-150", err=True)
        raise typer.Exit(USAGE) from None
    return x, y, z
