"""The shipped demonstrations: campaigns on the virtual machine, and their results compared with the truth."""

CONTROLLERS = {"virtual": "errormotion.cli.demo.spindle", "linuxcnc": "errormotion.cli.demo.probing"}
"""Module of the demonstration of each controller; the first one requires no installation."""
COMPENSATED = {
    "virtual": "errormotion.cli.demo.compensated",
    "linuxcnc": "errormotion.cli.demo.compensated_probing",
}
"""Module of the demonstration of a closed loop of each controller."""
