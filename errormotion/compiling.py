"""Functions that numba compiles at their first call, with a message on the terminal during the compilation.

A module declares its functions with a `Compiler`:

    compiled = Compiler("the loops for large campaigns", seconds=5)

    @compiled(fastmath=True)
    def add(x, y): ...

Nothing is compiled and numba is not imported before the first call. Compiled functions may call one another. A function
that is called only by compiled ones is declared with ``@compiled(inner=True)``, which omits its entry from Python, an
eighth of the code. A function with only one caller is declared with ``@compiled(inline="always")``: it becomes part of
its caller, with the options of the caller, and is not compiled separately. The cache of numba on disk stores compiled
functions, so that they are compiled once for each installation.
"""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, update_wrapper
from itertools import pairwise
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar, cast

if TYPE_CHECKING:
    from collections.abc import Mapping

Function = TypeVar("Function", bound=Callable[..., Any])


class Compiler:
    """A decorator for a group of functions that are compiled: cached on disk, without the interpreter's lock.

    Parameters
    ----------
    what : str
        The group for the message on the terminal: ``the loops for large campaigns``.
    seconds : float
        Typical time of the compilation, s.
    **options
        Of ``numba.njit`` for all functions of the group, such as ``error_model="numpy"``.
    """

    def __init__(self, what: str, seconds: float, **options: Any) -> None:
        self.what, self.seconds, self.options = what, seconds, options
        self._reported = False

    def __call__(self, *, inner: bool = False, **options: Any) -> Callable[[Function], Function]:
        """Return the decorator with further options of ``numba.njit``; ``inner``: only compiled functions call it."""

        def declare(function: Function) -> Function:
            entries = {"no_cpython_wrapper": inner or "inline" in options, "no_cfunc_wrapper": True}
            return cast(Function, _Compiled(self, function, {**self.options, **entries, **options}))

        return declare

    def report(self) -> None:
        """Write on the terminal that the group is compiled, once for each process; only if stderr is a terminal."""
        if not self._reported and sys.stderr.isatty():
            print(f"Compiling {self.what}, once: about {self.seconds:g} s", file=sys.stderr, flush=True)
        self._reported = True


class _Compiled:
    """A function that is compiled at its first call."""

    def __init__(self, compiler: Compiler, function: Callable[..., Any], options: Mapping[str, Any]) -> None:
        self._compiler, self._function, self._options = compiler, function, options
        update_wrapper(self, function)

    @cached_property
    def dispatcher(self) -> Any:
        """The function as numba's dispatcher."""
        import numba

        made = numba.njit(cache=True, nogil=True, **self._options)(self._function)
        _reporters()[made] = self._compiler
        return made

    @property
    def targetoptions(self) -> Any:
        """Its options, for inlining by numba."""
        return self.dispatcher.targetoptions

    @property
    def py_func(self) -> Callable[..., Any]:
        """The function in Python, for inlining by numba."""
        return self._function

    @property
    def _numba_type_(self) -> Any:
        """Its type, for calls from other compiled functions."""
        return self.dispatcher._numba_type_

    def __call__(self, *args: Any) -> Any:
        if self._options["no_cpython_wrapper"]:
            raise TypeError(
                f"{self._function.__qualname__} is declared with inner=True or inline: only compiled code calls it"
            )
        return self.dispatcher(*args)


def in_threads(work: Callable[..., Any], items: int, several: bool, *given: Any) -> None:
    """Call ``work(*given, first, last)`` for ranges that together contain all items.

    Threads of Python are used instead of those of numba, because code for the latter takes two to four times as long to
    compile.

    Parameters
    ----------
    work : callable
        Computes the items from ``first`` to before ``last`` independently, without the lock of the interpreter.
    items : int
        Number of items.
    several : bool
        Whether to use several threads; else this thread computes all.
    given : tuple
        Further arguments.
    """
    if not several:
        work(*given, 0, items)
        return
    count = min(threads(), items)
    own, *others = pairwise([items * k // count for k in range(count + 1)])
    with ThreadPoolExecutor(max(len(others), 1)) as pool:  # starts threads only for submitted work
        running = [pool.submit(work, *given, *part) for part in others]
        work(*given, *own)
        for each in running:
            each.result()


def threads() -> int:
    """Return the number of threads, as used by numba (``NUMBA_NUM_THREADS``)."""
    import numba

    return int(numba.config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined, unused-ignore]


_REPORTERS: dict[Any, Compiler] = {}
_COUNTING = Lock()
_RARELY = (100_000, 50, 50)
"""Thresholds of the garbage collector during a compilation, of which it otherwise takes a tenth of the time."""


def _reporters() -> dict[Any, Compiler]:
    """Return the group of each function known to numba, and register the groups for its reports on compilations."""
    if not _REPORTERS:
        from numba.core import event

        class Listener(event.Listener):  # type: ignore[misc, unused-ignore]
            def __init__(self) -> None:
                self.running, self.before = 0, gc.get_threshold()

            def on_start(self, event: Any) -> None:
                with _COUNTING:
                    self.running += 1
                    if self.running == 1:
                        self.before = gc.get_threshold()
                        gc.set_threshold(*_RARELY)
                compiler = _REPORTERS.get(event.data["dispatcher"])
                if compiler is not None:
                    compiler.report()

            def on_end(self, event: Any) -> None:  # noqa: ARG002 - as numba calls it
                with _COUNTING:
                    self.running -= 1
                    if self.running == 0:
                        gc.set_threshold(*self.before)

        event.register("numba:compile", Listener())  # type: ignore[no-untyped-call, unused-ignore]
    return _REPORTERS
