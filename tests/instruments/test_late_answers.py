"""A device that answers late once shifts no later reading, on TCP and on a serial line."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest

from errormotion.errors import InstrumentError, InstrumentTimeoutError
from errormotion.instruments.controller.virtual import ControllerSettings, VirtualController
from errormotion.instruments.point_lds.keyence_lk.driver import KeyenceLK
from errormotion.instruments.point_lds.keyence_lk.settings import LKSettings
from errormotion.instruments.thermometer.dcon import DconSettings, DconTemperature
from errormotion.instruments.thermometer.modbus_temperature import ModbusTemperature
from errormotion.instruments.thermometer.registers import ModbusSettings

TIMEOUT = 0.3
READINGS = 6


def dcon(query: str) -> DconTemperature:
    return DconTemperature(f"sim://cframe/thermometer?seed=3&{query}", DconSettings(timeout=TIMEOUT, retry=0.0))


def modbus(query: str) -> ModbusTemperature:
    return ModbusTemperature(
        f"sim://cframe/thermometer?seed=3&noise=1&{query}", ModbusSettings(timeout=TIMEOUT, retry=0.0)
    )


def keyence(query: str) -> KeyenceLK:
    readings = ",".join(f"{0.1 * k:.1f}" for k in range(12))
    return KeyenceLK(f"sim://cframe?readings={readings}&{query}", LKSettings(timeout=TIMEOUT))


def controller(query: str) -> Any:
    return VirtualController(f"sim://cframe/controller?seed=3&{query}", ControllerSettings(arm=True, timeout=TIMEOUT))


def read_all(driver: Any, count: int = READINGS) -> list[Any]:
    """Return readings, or the class of their error."""
    found: list[Any] = []
    with driver:
        for _ in range(count):
            try:
                found.append(driver.read())
            except InstrumentError as error:
                found.append(type(error))
    return found


@pytest.mark.parametrize(
    ("make", "wire", "late"),
    [
        (dcon, "tcp", "&late_by=0.45"),
        (dcon, "tcp", ""),
        (dcon, "pty", "&late_by=0.45"),
        (dcon, "pty", ""),  # the request for the name resynchronises
        (modbus, "tcp", "&late_by=0.45"),
        (modbus, "tcp", ""),
        (modbus, "tcp&framing=rtu", "&late_by=0.45"),
        (modbus, "pty", "&late_by=0.45"),
        (modbus, "pty", ""),  # the answer to another number of registers has another length
        (keyence, "tcp", "&late_by=0.45"),
        (keyence, "pty", ""),
    ],
)
def test_the_reading_after_a_late_answer_is_correct(make: Callable[[str], Any], wire: str, late: str) -> None:
    sound = read_all(make(f"wire={wire}"), READINGS + 1)
    assert all(first != second for first, second in pairwise(sound))
    at = {dcon: 4, modbus: 3, keyence: 7}[make]
    found = read_all(make(f"wire={wire}&fault=late&fault_at={at}{late}"))
    number = found.index(InstrumentTimeoutError)
    assert found[:number] == sound[:number]
    assert sound[number] not in found
    # Where nothing late has arrived, another number of registers is read first.
    asked = number + 1 + (make is modbus and wire == "pty" and not late)
    assert found[number + 1 :] == sound[asked : asked + READINGS - number - 1]


def test_a_command_after_a_late_answer_gets_its_own_answer() -> None:
    with controller("fault=late&fault_at=2&late_by=0.45") as machine:
        machine.state()
        with pytest.raises(InstrumentTimeoutError):
            machine.state()
        assert machine.identify().manufacturer == "errormotion"
