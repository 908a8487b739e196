"""The page that a lab hands to its customer: one HTML file that needs nothing else.

``write_report`` writes one from error datasets, ``write_run_report`` from a run folder, ``write_model_report`` lays a
thermal model against a measurement. They are loaded when first asked for, because drawing takes its time to import.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from errormotion.report.write import write_model_report, write_report, write_run_report

__all__ = ["write_model_report", "write_report", "write_run_report"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from errormotion.report import write

        return getattr(write, name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
