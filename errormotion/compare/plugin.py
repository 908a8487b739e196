"""The plugin ``error_comparison``: results of comparisons as datasets."""

from __future__ import annotations

from typing import ClassVar

from errormotion.plugins import DatasetInfo, DatasetPlugin, lazy


class ComparisonDataset(DatasetPlugin):
    """Comparisons of error datasets."""

    info: ClassVar[DatasetInfo] = DatasetInfo(
        id="error_comparison",
        summary="Comparison of several error datasets: differences, consensus, causes",
        schemas=("errormotion.comparison/1",),
    )
    violations = lazy("errormotion.compare.result:violations")
    chapters = lazy("errormotion.compare.report:chapters")
    texts = lazy("errormotion.compare.report:texts")
    plot = lazy("errormotion.compare.report.picture:plot")
