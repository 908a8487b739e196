"""The virtual machine of simulated raw data, and the record of its interferometer."""

from __future__ import annotations

import json

from errormotion.twin import VirtualMachine

MACHINE = "gantry"
"""Kind of the virtual machine of all simulations."""


def instruments_of(machine: VirtualMachine) -> str:
    """Return the attribute ``instruments`` of a simulated raw dataset."""
    address = f"twin://{machine.kind}?seed={machine.seed}"
    return json.dumps([{"id": "virtual interferometer", "address": address, "simulated": True}])
