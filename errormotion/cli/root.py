"""The application and its groups of commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import typer

from errormotion.cli.guard import guarded

Command = TypeVar("Command", bound=Callable[..., Any])


class _Group(typer.Typer):
    """A group whose commands end with a message and an exit code after an exception."""

    def command(self, *args: Any, **options: Any) -> Callable[[Command], Command]:
        register: Any = super().command(*args, **options)
        return lambda function: register(guarded(function))


app = _Group(
    name="errormotion",
    help="Measure the error motions of machine tools.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _group(name: str, text: str) -> _Group:
    group = _Group(no_args_is_help=True, help=text, rich_markup_mode=None)
    app.add_typer(group, name=name)
    return group


plugins_app = _group("plugins", "Instruments, methods and kinds of dataset.")
bench_app = _group("bench", "Check a bench file, or the instruments of a bench.")
model_app = _group("model", "Thermal models: errors predicted from temperatures.")
compensate_app = _group("compensate", "Compensate measured errors.")
background_app = _group("background", "Campaigns that 'errormotion run --detach' or the dashboard has started.")
