"""The conformance kit: checks for all instrument, method and compensator plugins.

``check_plugin(group, plugin_id)`` runs it on a plugin of the registry. In a plugin's own tests, subclass
``InstrumentConformance``, ``MethodConformance`` or ``CompensatorConformance`` and state the subject; pytest then
collects one test for each check.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from errormotion.plugins import CompensatorSubject, InstrumentSubject, MethodSubject

if TYPE_CHECKING:
    from errormotion.testing.kit import Check, CheckResult
    from errormotion.testing.pytest_classes import CompensatorConformance, InstrumentConformance, MethodConformance
    from errormotion.testing.run import check_plugin, run_checks

_HOME = {
    "Check": "kit",
    "CheckResult": "kit",
    "CompensatorConformance": "pytest_classes",
    "InstrumentConformance": "pytest_classes",
    "MethodConformance": "pytest_classes",
    "check_plugin": "run",
    "run_checks": "run",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "Check",
    "CheckResult",
    "CompensatorConformance",
    "CompensatorSubject",
    "InstrumentConformance",
    "InstrumentSubject",
    "MethodConformance",
    "MethodSubject",
    "check_plugin",
    "run_checks",
]
