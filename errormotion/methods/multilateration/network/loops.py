"""Choice of the sums over targets: array operations for a small network, compiled loops for a large one."""

from __future__ import annotations

from types import ModuleType

COMPILED_FROM = 5000
"""Number of targets from which compiled loops are used. Once compiled, they are faster from some hundred targets."""


def loops(targets: int) -> ModuleType:
    """Return the module for this number of targets; both have the same results except for rounding."""
    if targets < COMPILED_FROM:
        from errormotion.methods.multilateration.network import vectorised

        return vectorised
    from errormotion.methods.multilateration.network import kernels

    return kernels
