"""Every driver that can move or change a machine: it only reads unless armed, and checks limits for each command.

The drivers follow from the contracts of their kinds; a new one is tested here automatically.
"""

import inspect
import math
from collections.abc import Callable
from typing import Any

import pytest
from coded import raises

from errormotion import plugins
from errormotion.errors import InstrumentError
from errormotion.instruments.interlock import Interlock
from errormotion.instruments.nc_limits import check_program
from errormotion.plugins import InstrumentInfo, MachineLimits, PluginSettings, Touch
from errormotion.plugins.kind_registry import changes_machine, deviations, kind, kind_changes_machine

DRIVERS = [
    each.id
    for each in plugins.available("instruments")
    if each.distribution.startswith("errormotion ") and changes_machine(plugins.get("instruments", each.id))
]
READING = {
    "open",
    "answer_line",
    "close",
    "identify",
    "configure",
    "bound",
    "read",
    "state",
    "snapshot",
    "conformance",
    "pretravel",
}
"""Methods of which none sends an order."""
ALWAYS = {"stop", "estop", "press_estop", "elapse", "finish", "resynchronise", "exchange"}
"""Methods that are allowed without arm: what stops a machine, waits, or has no effect by itself."""
ARGUMENTS: dict[str, Any] = {
    "position": [0.0, 0.0, 0.1],
    "target": [0.0, 0.0, 0.1],
    "start": [0.0, 0.0, 0.1],
    "direction": [1.0, 0.0, 0.0],
    "feed": 0.01,
    "speed": 100.0,
    "text": "G90 G21\nG1 X1 F100\nM30\n",
    "tool": "bar",
    "schedule": [{"time": 0.0, "spindle_speed": 100.0}],
    "time": 0.0,
    "step": 1e-3,
    "count": 3,
    "kind": "plane",
    "action": "set_target",
    "values": {},
    "programs": 1,
    "touches": [Touch((0.0, 0.0, 0.1), (0.0, 0.0, 0.09))],
}


class Wire:
    """A transport on which nothing may be written."""

    simulated = True

    def __getattr__(self, name: str) -> Any:
        raise AssertionError(f"{name}: something was sent")


def driver_of(plugin_id: str, **settings: Any) -> Any:
    """Return a driver that is marked as open."""
    cls = plugins.get("instruments", plugin_id)
    driver = cls("sim://cframe/x", cls.Settings(**settings))
    for name in ("_transport", "_control"):
        if hasattr(driver, name):
            setattr(driver, name, Wire())
    return driver


def orders(driver: Any) -> list[str]:
    """Return the public methods of a driver that may send a command."""
    return [
        name
        for name, _ in inspect.getmembers(type(driver), inspect.isfunction)
        if not name.startswith("_") and name not in READING | ALWAYS
    ]


def call(driver: Any, name: str, **changed: Any) -> None:
    method = getattr(driver, name)
    arguments = {
        each.name: (ARGUMENTS | changed)[each.name]
        for each in inspect.signature(method).parameters.values()
        if each.default is each.empty or each.name in changed
    }
    found = method(**arguments)
    if inspect.isgenerator(found):
        next(found)


def test_these_drivers_can_change_a_machine() -> None:
    """A new driver is listed here by its capabilities."""
    assert sorted(DRIVERS) == ["controller_probe", "linuxcnc", "virtual_controller"]
    assert kind_changes_machine("controller")
    assert not kind_changes_machine("thermometer")


@pytest.mark.parametrize("plugin_id", DRIVERS)
def test_by_default_it_only_reads(plugin_id: str) -> None:
    driver = driver_of(plugin_id)
    assert driver.settings.arm is False
    assert orders(driver)
    for name in orders(driver):
        with raises("instrument.not_armed"):
            call(driver, name)


@pytest.mark.parametrize("plugin_id", DRIVERS)
def test_it_sends_a_command_once_armed(plugin_id: str) -> None:
    """Counterpart of the test above: only the setting prevents the commands."""
    for name in orders(driver_of(plugin_id)):
        with pytest.raises(AssertionError, match="something was sent"):
            call(driver_of(plugin_id, arm=True), name)


@pytest.mark.parametrize("plugin_id", DRIVERS)
def test_its_methods_are_those_of_its_kind_or_commands(plugin_id: str) -> None:
    driver = driver_of(plugin_id)
    assert not deviations(driver, kind(driver.info.kind))
    known = {*orders(driver), *READING, *ALWAYS}
    assert {name for name in changes_machine(driver) if callable(getattr(type(driver), name, None))} <= known


TIGHT = MachineLimits({"X": (-1e-3, 1e-3), "Y": (-1e-3, 1e-3), "Z": (-1e-3, 1e-3)}, feed=1e-6, spindle_speed=1.0)
WRONG = [math.nan, math.inf, -math.inf, 1e308, 10**400, "fast"]


MOVES = ("move_to", "probe", "spindle", "run_program", "run_steps", "start", "follow")


@pytest.mark.parametrize(
    ("plugin_id", "name"),
    [(each, name) for each in DRIVERS for name in MOVES if hasattr(plugins.get("instruments", each), name)],
)
def test_each_command_is_checked_against_the_limits(plugin_id: str, name: str) -> None:
    driver = driver_of(plugin_id, arm=True)
    driver.bound(TIGHT)
    with pytest.raises(InstrumentError, match="limit"):
        call(driver, name)


@pytest.mark.parametrize("plugin_id", sorted(set(DRIVERS) - {"controller_probe"}))
@pytest.mark.parametrize("value", WRONG, ids=str)
def test_nan_and_infinity_are_refused_without_limits_as_well(plugin_id: str, value: Any) -> None:
    driver = driver_of(plugin_id, arm=True)
    refused = [("move_to", {"position": [0.0, 0.0, value]}), ("move_to", {"feed": value}), ("probe", {"feed": value})]
    refused += [("probe", {"target": [value, 0.0, 0.0]}), ("spindle", {"speed": value})]
    for name, changed in refused:
        if value == 1e308 and name in ("spindle", "move_to", "probe") and "feed" not in changed:
            continue  # a number: the machine refuses it by its travel
        with pytest.raises(InstrumentError, match="finite"):
            call(driver, name, **changed)
    if value != 1e308:
        with raises("motion.value.form"):
            driver.elapse(value)


def test_a_probe_passes_the_limits_on_to_its_controller() -> None:
    seen: list[MachineLimits] = []
    driver = driver_of("controller_probe", arm=True)
    driver._control = type("Control", (), {"bound": lambda self, limits: seen.append(limits)})()
    driver.bound(TIGHT)
    assert seen == [TIGHT]


# ---------------------------------------------------------------------- programs

LIMITS = MachineLimits({"X": (0.0, 0.1)}, feed=0.02, spindle_speed=1000.0)


def interlock(limits: MachineLimits = LIMITS) -> Interlock:
    made = Interlock("test", "here")
    made.limits = limits
    return made


@pytest.mark.parametrize(
    "text",
    [
        "%\n(a comment with X900)\nG90 G94 G21\nM3 S900\nG1 X100 Y900 F1200\nG4 P5000\nM5\nM30\n%\n",
        "G21 G90 G94\nF600\nG31 X50.5 (ball) ; X900\nDPRNT[N1*X#5061[53]]\nPOPEN\nT1 M6\n",
        "N10 G90G21G94\nN20 G1X0F1200\nN30 X5\nN40 POPEN\nG4 X5.5\n",
    ],
)
def test_a_program_within_the_limits_is_accepted(text: str) -> None:
    check_program(text, interlock())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("G90 G94 G21\nG1 X100.1 F100\n", "line 2 .*X would move to 100.1 mm"),
        ("G90 G94 G21\nG1 X-1 F100\n", "X would move to -1 mm"),
        ("G90 G94 G21\nG1 X1 F1201\n", "feed would be 1201 mm/min"),
        ("G90 G94 G21\nG1 X1 F0\n", "finite feed above 0"),
        ("G90 G94 G21\nG1 X1\n", "a move before a feed"),
        ("G90 G94 G21\nG0 X1\n", "a rapid move"),
        ("M3 S1001\n", "spindle speed would be 1001"),
        ("G1 X1\n", "a position before G21 and G90"),
        ("G90 G94\nG1 X1 F100\n", "a feed F before a line with G21 and G94"),
        ("G90 G21\nG1 X1 F100\n", "a feed F before a line with G21 and G94"),
        ("F100\nG90 G94 G21\nG1 X1\n", "a feed F before"),
        ("G90 G94 G21 F100\n", "a feed F before"),
        ("G90 G94 G21\nF100\nX1\n", "a position before G0 or G1"),
        ("G90 G94 G21\nG31 X1 F100\nX2\n", "line 3 .*a position before G0 or G1"),
        ("G90 G94 G21\nG1 X1 F100\nG4 P1 X900\n", "line 3 .*a dwell with other words"),
        ("G90 G94 G21\nG4 P1 G1 X900 F100\n", "a dwell with other words"),
        ("M3\n", "before a speed S"),
        ("POPEN G1 X900\n", "'POPEN"),
        ("DPRNT[X#5061[53]] G1 X900 [Z]\n", "'DPRNT"),
        ("G91 G21\n", "'G91'"),
        ("G20\n", "'G20'"),
        ("G2 X1 I5\n", "'G2'"),
        ("G92 X0\n", "'G92'"),
        ("G55\n", "'G55'"),
        ("G65 P9810\n", "'G65'"),
        ("M98 P1000\n", "'M98'"),
        ("#1=900\n", "'#1=900'"),
        ("G90 G94 G21\nG1 X#1 F100\n", "unknown"),
        ("G90 G94 G21\nG1 X[1+900] F100\n", "unknown"),
        ("O100 sub\n", "unknown"),
        ("G90 G94 G21\nG1 X1e9 F100\n", "unknown"),
        ("G90 G94 G21\nG1 X9999999999999999 F100\n", "X would move to"),
        ("G90 G94 G21\nG1 X1 Finf\n", "unknown"),
        ("G90 G94 G21\nG1 A1 F100\n", "'A1'"),
    ],
)
def test_a_program_outside_the_limits_or_of_unknown_path_is_refused(text: str, said: str) -> None:
    with pytest.raises(InstrumentError, match=said):
        check_program(text, interlock())
    check_program(text, interlock(MachineLimits()))  # without limits the control decides


def test_the_first_command_is_stated_before_it_is_sent(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    here = interlock()
    here.require_armed(True, "move to X 1")
    here.require_armed(True, "move to X 2")
    (record,) = caplog.records
    assert "test at here is armed (X 0 to 100 mm, feed up to 1200 mm/min, spindle up to 1000 /min)" in record.message
    assert "its first command: move to X 1" in record.message


def test_a_capability_that_changes_a_machine_is_detected_without_an_id() -> None:
    class Foreign:
        info = InstrumentInfo("foreign", "controller", "a control", "simulated_only")
        Settings = PluginSettings
        spindle: Callable[..., None]

        def move_to(self, position: Any, feed: Any = None) -> None: ...

    assert {"move_to", "spindle"} <= set(changes_machine(Foreign))
