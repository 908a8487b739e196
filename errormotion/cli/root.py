"""The application and its groups of commands."""

from __future__ import annotations

import typer

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
