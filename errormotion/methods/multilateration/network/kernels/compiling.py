"""How loops over targets are compiled and cut into pieces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from errormotion.arrays import Array
from errormotion.compiling import Compiler, in_threads

CHUNK = 1024
"""Targets that one thread adds up."""
LANES = 64
"""Targets that are worked at together: a loop over them becomes vector instructions. A part of a chunk."""
MANY = 20_000
"""More targets than these are shared out to several threads."""
FAST = {"reassoc", "contract", "nsz", "arcp"}
"""Sums may be taken in any order (so that they vectorise)."""
EXACT = {"contract", "nsz"}
"""Products and sums may be fused."""


compiled = Compiler("the loops for large networks of stations and targets", seconds=30, error_model="numpy")


def chunks(targets: int) -> int:
    """Return into how many chunks so many targets are cut."""
    return -(-targets // CHUNK)


def in_chunks(work: Callable[..., Any], targets: int, *given: Any) -> None:
    """Call ``work(*given, first, last)`` for ranges of chunks; where there are many targets, threads share them."""
    in_threads(work, chunks(targets), targets > MANY, *given)


def of_four(station: Array, further: Array) -> bool:
    """Return whether these are four stations (n, 3) without further parameters (k, ...): `four` has loops for them."""
    return len(station) == 4 and len(further) == 0
