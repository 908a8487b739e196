"""What the kit needs to know of the built-in plugins."""

from __future__ import annotations

from typing import Any

from errormotion.plugins import Group
from errormotion.testing.subjects import InstrumentSubject, MethodSubject


def builtin_subjects(
    group: Group, plugin_id: str, cls: Any
) -> tuple[InstrumentSubject, ...] | tuple[MethodSubject, ...]:
    """Return the subjects of a built-in plugin; none for a plugin from elsewhere."""
    return ()
