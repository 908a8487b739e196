"""Options of several commands, and their values: points, dates, quantities with units, lists, settings."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from errormotion.cli.guard import UsageError

Json = Annotated[bool, typer.Option("--json", help="Print one JSON document instead of text.")]
Runs = Annotated[Path | None, typer.Option("--runs", help="Folder for run folders; default: that of the campaign.")]
Set = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="One setting; may be repeated.")]
SettingsFile = Annotated[Path | None, typer.Option(help="A TOML file of settings.")]
At = Annotated[str | None, typer.Option(help="Functional point 'x,y,z', mm; default: that of the first dataset.")]
Over = Annotated[str | None, typer.Option(metavar="DIM", help="Dimension of the comparison: time, position or target.")]
Select = Annotated[list[str] | None, typer.Option(help="Element of another dimension, from 0, such as position=3.")]
Freedoms = Annotated[str | None, typer.Option(help="Freedoms, such as EX,EZ; default: all that are known.")]
Tolerances = Annotated[
    Path | None, typer.Option("--tolerances", help="TOML file of limits; default: those of the campaign.")
]
Limits = Annotated[Path | None, typer.Option("--tolerances", help="A TOML file of limits; decide on each result.")]
Report = Annotated[Path | None, typer.Option(help="Write a page (.html).")]
Pdf = Annotated[bool, typer.Option("--pdf", help="Print the page as PDF beside it.")]
Paper = Annotated[Literal["A4", "Letter"] | None, typer.Option(help="Paper; default: A4.")]
Language = Annotated[Literal["en", "de"] | None, typer.Option(help="Language; default: en.")]

Point = tuple[float, float, float]


def point(option: str, text: str) -> Point:
    """Return the point that an option states in mm, m; end the command if it is no point."""
    try:
        x, y, z = (float(part) / 1e3 for part in text.split(","))
    except ValueError:
        raise UsageError(f"{option} {text}: expected three numbers in mm, as in 0,0,-150", code="option.form") from None
    return x, y, z


def optional_point(option: str, text: str | None) -> Point | None:
    """Return the point that an option states in mm, m, or None."""
    return None if text is None else point(option, text)


def date(option: str, text: str | None) -> datetime | None:
    """Return the date that an option states, or None; end the command if it is no date."""
    if text is None:
        return None
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        raise UsageError(
            f"{option} {text}: expected a date, as in 2026-03-31 or 2026-03-31T08:00+01:00", code="option.form"
        ) from None


def parts(text: str | None) -> list[str]:
    """Return the parts of a list with commas; empty without a text."""
    return [part.strip() for part in text.split(",")] if text else []


def quantity(option: str, text: str, kind: Any) -> float:
    """Return a length or a time with its unit, such as ``'25 um'``, in SI.

    Parameters
    ----------
    kind : type
        `errormotion.datasets.units.Length` or ``Time``.

    Raises
    ------
    DatasetError
        The text is no such quantity.
    """
    from pydantic import TypeAdapter, ValidationError

    from errormotion.errors import DatasetError

    try:
        value: float = TypeAdapter(kind).validate_python(text)
    except ValidationError as error:
        reason = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise DatasetError(f"{option} {text}: {reason}", code="option.form") from None
    return value


def duration(option: str, text: str, longest: float = float("inf")) -> float:
    """Return a duration of more than 0 s, s.

    Raises
    ------
    BenchError
        The text is no duration, or it is longer than ``longest``.
    """
    from errormotion.datasets.units import TIME
    from errormotion.errors import BenchError

    try:
        value = TIME.parse(text)
    except ValueError as error:
        raise BenchError(f"{option}: {error}", code="option.form") from None
    if not 0 < value <= longest:
        bound = "" if longest == float("inf") else f" and at most {longest:g} s"
        raise BenchError(f"{option}: expected more than 0 s{bound}; found '{text}'", code="option.outside")
    return value


def read_settings(model: Any, file: Path | None, assignments: Sequence[str]) -> Any:
    """Return checked settings of a plugin: a TOML file, overridden by ``--set key=value``.

    Parameters
    ----------
    model : type of PluginSettings
        The settings class.
    file : Path, optional
        A TOML file with the settings at its top level.
    assignments : sequence of str
        ``key=value``, dotted keys for tables; the value in TOML, else text.

    Raises
    ------
    MethodError
        The settings are invalid; the message states all mistakes.
    """
    from errormotion.datasets.files import tomlfile
    from errormotion.datasets.files.tomltext import value_of
    from errormotion.errors import MethodError

    data = tomlfile.read_toml(file, error=MethodError) if file else {}
    for assignment in assignments:
        key, sign, text = assignment.partition("=")
        if not sign or not key.strip():
            raise MethodError(
                f"--set {assignment}: expected key=value, such as --set average='0.5 s'", code="option.form"
            )
        *tables, name = key.strip().split(".")
        target = data
        for table in tables:
            target = target.setdefault(table, {})
            if not isinstance(target, dict):
                raise MethodError(f"--set {assignment}: '{table}' is a value, not a table", code="option.form")
        target[name] = value_of(text.strip())
    settings, mistakes = tomlfile.check(data, model)
    if settings is None:
        raise MethodError(tomlfile.report(file or "--set", mistakes), code="method.settings.mistakes")
    return settings
