"""How loops over targets are compiled and cut into pieces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])

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


def compiled(**options: Any) -> Callable[[Function], Function]:
    """Compile with numba: cached on disk, without the interpreter's lock."""
    return cast(Callable[[Function], Function], numba.njit(cache=True, nogil=True, error_model="numpy", **options))


@compiled()
def chunks(targets: int) -> int:  # pragma: no cover - compiled
    """Return into how many chunks so many targets are cut."""
    return (targets + CHUNK - 1) // CHUNK
