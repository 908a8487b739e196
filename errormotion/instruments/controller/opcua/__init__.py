"""Controls with an OPC UA server: the information model for CNC systems, or nodes stated in the settings."""

from errormotion.instruments.controller.opcua.driver import OpcUa
from errormotion.instruments.controller.opcua.settings import OpcUaSettings

__all__ = ["OpcUa", "OpcUaSettings"]
