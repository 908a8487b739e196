"""Whether the instruments of a bench can be commanded, known before one of them is opened."""

from __future__ import annotations

from typing import Any

from errormotion.plugins.contracts import Bench


def unarmed(bench: Bench, kind: str) -> list[str]:
    """Return a sentence if the instrument of a kind, which a test commands, is not armed; else nothing."""
    driver: Any = bench.of_kind(kind)
    if getattr(driver.settings, "arm", True):
        return []
    return [
        f"'{name}' ({driver.info.id}) only reads, since arm = false, and this test commands it; set arm = true in "
        f"[instruments.{name}] of the bench file"
        for name, each in bench.all_of_kind(kind).items()
        if each is driver
    ]
