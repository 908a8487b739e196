"""A virtual machine whose time advances continuously."""

import time

from armed import CONTROLLER

from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.thermometer.dcon import DconSettings, DconTemperature


def test_time_stands_still_unless_ticking_is_on() -> None:
    with VirtualController("sim://cframe/controller?seed=61", CONTROLLER) as control:
        before = control.state()["time"]
        time.sleep(0.05)
        assert control.state()["time"] == before


def test_a_monitored_machine_warms_up_automatically() -> None:
    """A tenth of a second at 36 000 simulated seconds per second is an hour; the front bearing warms by several
    kelvins."""
    sensors = DconSettings(channels=("spindle_front",))
    with (
        VirtualController("sim://cframe/controller?seed=62&clock=36000", CONTROLLER) as control,
        DconTemperature("sim://cframe/t?seed=62&sensors=spindle_front", sensors) as thermometer,
    ):
        control.spindle(12000.0)
        cold = thermometer.read()["spindle_front"]
        start = control.state()["time"]
        time.sleep(0.15)
        assert control.state()["time"] > start + 3600
        assert thermometer.read()["spindle_front"] > cold + 3.0


def test_time_continues_from_the_value_that_is_set() -> None:
    with VirtualController("sim://cframe/controller?seed=63&clock=1", CONTROLLER) as control:
        control.elapse(5000.0)
        assert 5000.0 <= control.state()["time"] < 5100.0
        control.start([])
        assert control.state()["time"] < 100.0
