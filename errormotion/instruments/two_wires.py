"""Settings of devices on two wires (RS-485)."""

from __future__ import annotations

from pydantic import Field

from errormotion.plugins import PluginSettings


class TwoWireSettings(PluginSettings):
    """Settings of a device on two wires; see `transports.half_duplex`."""

    echo: bool = Field(
        default=False, description="whether the converter returns each request before the answer (RS-485 with echo)"
    )
    leading_zeros: bool = Field(
        default=False, description="whether bytes of 0 before an answer are skipped (RS-485 without bias resistors)"
    )
