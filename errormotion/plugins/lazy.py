"""Attributes of a plugin class that are imported at their first use."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from errormotion.errors import PluginError


def load_object(path: str) -> Any:
    """Return the object of a text ``module:name``.

    Raises
    ------
    PluginError
        The text does not have this form, the module does not exist, or it has no such name.
    """
    module, colon, name = path.partition(":")
    if not colon:
        raise PluginError(f"expected 'module:name', found '{path}'", code="plugin.path.form")
    try:
        return getattr(import_module(module), name)
    except Exception as error:  # any exception of the import of a plugin
        raise PluginError(
            f"'{path}' does not load: {type(error).__name__}: {error}", code="plugin.not_loaded"
        ) from error


def lazy(path: str) -> Any:
    """Return a class attribute that is imported at its first use: ``chapters = lazy("my_lab.report:chapters")``.

    A function is not bound to the instance.
    """
    return _Lazy(path)


class _Lazy:
    def __init__(self, path: str) -> None:
        self.path = path

    def __get__(self, instance: object, owner: type | None = None) -> Any:
        return load_object(self.path)
