"""Settings of the LG7 in a bench file, in addition to the address."""

from pydantic import Field

from errormotion.datasets.units import Time
from errormotion.plugins import PluginSettings


class LineGaugeSettings(PluginSettings):
    timeout: Time = Field(1.0, description="time limit of an answer", gt=0)
    baudrate: int = Field(115200, description="of a serial line", gt=0)
