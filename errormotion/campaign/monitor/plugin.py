"""The plugin ``monitor_log``: logs of temperatures and working parameters."""

from __future__ import annotations

from typing import ClassVar

from errormotion.campaign.monitor.schema import RAW_SCHEMAS
from errormotion.plugins import DatasetInfo, DatasetPlugin, lazy


class MonitorLog(DatasetPlugin):
    """The log of a monitor."""

    info: ClassVar[DatasetInfo] = DatasetInfo(
        id="monitor_log",
        summary="Log of temperatures and working parameters of a machine",
        schemas=tuple(table.id for table in RAW_SCHEMAS),
    )
    raw_schemas = RAW_SCHEMAS
    chapters = lazy("errormotion.campaign.monitor.report:chapters")
    texts = lazy("errormotion.campaign.monitor.report:texts")
    figures = lazy("errormotion.campaign.monitor.log:figures")
