"""The command ``errormotion``.

A package that is slow to import is imported only when a command needs it, so that every command starts quickly.
"""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec, PathFinder
from typing import Any

PUT_OFF = ("numpy.f2py", "numpy.testing")
"""Scipy asks numpy for all its names, these among them, which take 0.1 s to load and are not used."""


class PutOff:
    """Finds the modules of `PUT_OFF`, to be loaded when one of their names is used."""

    @staticmethod
    def find_spec(fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return how a module is loaded; None for one that is loaded at once."""
        spec = PathFinder.find_spec(fullname, path, target) if fullname in PUT_OFF else None
        if spec is not None and spec.loader is not None:
            from importlib.util import LazyLoader

            spec.loader = LazyLoader(spec.loader)
        return spec


def prepare() -> None:
    """Prepare the process of a command, so that it starts and ends sooner.

    Imports make 400 000 objects that stay: looking through them for cycles again and again costs 0.1 s of 1 s, and
    0.2 s more when the interpreter ends.
    """
    import atexit
    import gc

    gc.set_threshold(400_000, 20, 20)
    atexit.register(gc.freeze)
    if PutOff not in sys.meta_path:
        sys.meta_path.insert(0, PutOff)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit.

    Parameters
    ----------
    arguments : list of str, optional
        Arguments of the command line; default: those of the process.
    """
    prepare()
    from errormotion.cli.app import app

    app(arguments)
