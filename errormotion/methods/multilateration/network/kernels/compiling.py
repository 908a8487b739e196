"""How loops over targets are compiled and cut into pieces."""

from __future__ import annotations

from errormotion.compiling import Compiler

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


@compiled()
def chunks(targets: int) -> int:  # pragma: no cover - compiled
    """Return into how many chunks so many targets are cut."""
    return (targets + CHUNK - 1) // CHUNK
