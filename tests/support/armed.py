"""Settings of drivers that may move the virtual machine."""

from errormotion.instruments.controller.virtual import ControllerSettings
from errormotion.instruments.touch_probe.controller_probe import ControllerProbeSettings

CONTROLLER = ControllerSettings(arm=True, timeout=20.0)  # on a computer with other work
PROBE = ControllerProbeSettings(arm=True)
