"""Reports: self-contained HTML files.

``write_report`` writes a report from error datasets, ``write_run_report`` from a run folder, ``write_page`` from
chapters. They are loaded at first use, because the drawing library takes time to import.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from errormotion.report.write import Form, write_page, write_report, write_run_report

__all__ = ["Form", "write_page", "write_report", "write_run_report"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from errormotion.report import write

        return getattr(write, name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
