"""Machines for the tests of the twin."""

import pytest

from errormotion.twin import Event, VirtualMachine

MINUTE = 60.0


@pytest.fixture
def machine():
    """A cold C-frame, nothing commanded."""
    return VirtualMachine("cframe", seed=3)


@pytest.fixture
def warming():
    """The demonstration: 15000 /min, compensation of Z off after 101 min and of Y after 102 min."""
    machine = VirtualMachine("cframe", seed=3)
    machine.start(
        [
            Event(0, spindle_speed=15000),
            Event(101 * MINUTE, compensation={"Z": False}),
            Event(102 * MINUTE, compensation={"Y": False}),
        ]
    )
    return machine
