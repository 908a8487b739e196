"""Which loops work on a network: array operations on a small one, compiled loops on a large one."""

from __future__ import annotations

from types import ModuleType

COMPILED_FROM = 5000
"""Targets from which compiled loops are used. They save time from some hundred targets on, once they are compiled."""


def loops(targets: int) -> ModuleType:
    """Return the module of the loops for so many targets; both give the same results but for rounding."""
    if targets < COMPILED_FROM:
        from errormotion.methods.multilateration.network import vectorised

        return vectorised
    from errormotion.methods.multilateration.network import kernels

    return kernels
