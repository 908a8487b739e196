"""The application and its groups of commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import typer
from typer.core import TyperGroup

from errormotion.cli.guard import USAGE, guarded
from errormotion.cli.output import failure, show_json

Command = TypeVar("Command", bound=Callable[..., Any])


_UsageError: Any = typer.BadParameter.__mro__[1]
"""The error of wrong options and arguments, which typer does not export."""


SECTIONS = {
    "Measure": ("demo", "init", "plan", "program", "run", "background", "monitor", "calibrate", "bench", "doctor"),
    "Evaluate": ("add", "identify", "report", "open", "compare", "export", "validate", "dashboard"),
    "Keep a record": ("runs", "history", "note"),
    "Improve the machine": ("model", "compensate"),
}
"""Sections of the first help page with their commands, in the order of their use; the others stand below by name."""


class _Commands(TyperGroup):
    """All commands; after ``--json``, unknown options and arguments too are reported as a JSON document."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the commands in `SECTIONS`, and the names of all others."""
        others = [name for name in self.list_commands(ctx) if name not in sum(SECTIONS.values(), ())]
        # 6: the indentation, and the space between a name and its text
        room = formatter.width - 6 - max(map(len, sum(SECTIONS.values(), ())))
        for title, names in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(name, self.commands[name].get_short_help_str(room)) for name in names])
        with formatter.section("For scripts and developers, see 'errormotion COMMAND --help'"):
            formatter.write_text(", ".join(others))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        ctx.meta[__name__] = "--json" in args
        return list(super().parse_args(ctx, args))

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except _UsageError as error:
            if ctx.meta[__name__]:
                about = {"type": type(error).__name__, "exit_code": USAGE}
                show_json({"ok": False, **failure(error.format_message(), code="option.unknown", **about)})
            raise


class _Group(typer.Typer):
    """A group whose commands end with a message and an exit code after an exception."""

    def command(self, *args: Any, **options: Any) -> Callable[[Command], Command]:
        register: Any = super().command(*args, **options)
        return lambda function: register(guarded(function))


app = _Group(
    name="errormotion",
    cls=_Commands,
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
background_app = _group("background", "Campaigns that run by themselves (run --detach, dashboard).")
