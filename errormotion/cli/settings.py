"""Settings of a plugin from the command line: a TOML file, overridden by ``--set key=value``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from errormotion.datasets.files import tomlfile
from errormotion.datasets.files.tomltext import value_of
from errormotion.errors import MethodError


def read_settings(model: Any, file: Path | None, assignments: Sequence[str]) -> Any:
    """Return a checked settings object.

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
    data = tomlfile.read_toml(file, error=MethodError) if file else {}
    for assignment in assignments:
        key, sign, text = assignment.partition("=")
        if not sign or not key.strip():
            raise MethodError(f"--set {assignment}: expected key=value, such as --set average='0.5 s'")
        *tables, name = key.strip().split(".")
        target = data
        for table in tables:
            target = target.setdefault(table, {})
            if not isinstance(target, dict):
                raise MethodError(f"--set {assignment}: '{table}' is a value, not a table")
        target[name] = value_of(text.strip())
    settings, mistakes = tomlfile.check(data, model)
    if settings is None:
        raise MethodError(tomlfile.report(file or "--set", mistakes))
    return settings
