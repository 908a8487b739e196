"""The plugin ``machine_history``: figures of a machine over time as datasets."""

from __future__ import annotations

from typing import ClassVar

from errormotion.plugins import DatasetInfo, DatasetPlugin, lazy


class HistoryDataset(DatasetPlugin):
    """Histories of figures."""

    info: ClassVar[DatasetInfo] = DatasetInfo(
        id="machine_history",
        summary="One figure of one machine over time: trend, steps, control limits, notes",
        schemas=("errormotion.history/1",),
    )
    violations = lazy("errormotion.record.history:violations")
    chapters = lazy("errormotion.record.page:chapters")
    texts = lazy("errormotion.record.page:texts")
