"""The plugin ``monte_carlo_evaluation``: Monte Carlo evaluations as datasets."""

from __future__ import annotations

from typing import ClassVar

from errormotion.plugins import DatasetInfo, DatasetPlugin, lazy


class MonteCarloDataset(DatasetPlugin):
    """Monte Carlo evaluations of error datasets."""

    info: ClassVar[DatasetInfo] = DatasetInfo(
        id="monte_carlo_evaluation",
        summary="Monte Carlo evaluation of a result: intervals, and validation of the linear ones",
        schemas=("errormotion.monte_carlo/1",),
    )
    violations = lazy("errormotion.montecarlo.result:violations")
    chapters = lazy("errormotion.montecarlo.report:chapters")
    texts = lazy("errormotion.montecarlo.report:catalogue")
