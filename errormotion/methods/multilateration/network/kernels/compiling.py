"""Compilation of loops over targets, and their division into chunks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from errormotion.arrays import Array
from errormotion.compiling import Compiler, in_threads

CHUNK = 1024
"""Number of targets in a chunk, which one thread sums."""
LANES = 64
"""Number of targets, a divisor of the chunk, over which an inner loop compiles to vector instructions."""
MANY = 20_000
"""Number of targets above which several threads are used."""
FAST = {"reassoc", "contract", "nsz", "arcp"}
"""Sums may be in any order, so that they vectorise."""
EXACT = {"contract", "nsz"}
"""Products and sums may be fused."""


compiled = Compiler("the loops for large networks of stations and targets", seconds=30, error_model="numpy")


def chunks(targets: int) -> int:
    """Return the number of chunks of this number of targets."""
    return -(-targets // CHUNK)


def in_chunks(work: Callable[..., Any], targets: int, *given: Any) -> None:
    """Call ``work(*given, first, last)`` for ranges of chunks, in several threads if there are many targets."""
    in_threads(work, chunks(targets), targets > MANY, *given)


def of_four(station: Array, further: Array) -> bool:
    """Return whether these are four stations (n, 3) without further parameters (k, ...), for the loops of `four`."""
    return len(station) == 4 and len(further) == 0
