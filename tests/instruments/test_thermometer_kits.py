"""The conformance kit on thermometers of all maps, lines and buses."""

from errormotion.instruments.thermometer.can_temperature import CanTemperature
from errormotion.instruments.thermometer.modbus_temperature import ModbusTemperature
from errormotion.testing import InstrumentConformance, InstrumentSubject


class TestAdam(InstrumentConformance):
    """Modbus TCP; a port without a server."""

    subject = InstrumentSubject(
        ModbusTemperature,
        "sim://cframe/adam?seed=3&noise=1&map=adam-6018&thermocouples=K",
        settings={"map": "adam-6018", "thermocouples": ("K",), "timeout": 0.7},
        name="adam",
        mutants=40,
        dead_address="modbus+tcp://127.0.0.1:9?unit=1",
    )


class TestLogger(InstrumentConformance):
    """RTU on a pty, with an open sensor; no such line."""

    subject = InstrumentSubject(
        ModbusTemperature,
        "sim://cframe/logger?seed=3&noise=1&map=logger-16&wire=pty&open=1",
        settings={"map": "logger-16", "timeout": 0.7},
        name="logger",
        mutants=40,
        dead_address="modbus+rtu:///dev/no_such_line?unit=1",
    )


class TestNode(InstrumentConformance):
    """One sensor open and one shorted; a bus without a device."""

    subject = InstrumentSubject(
        CanTemperature,
        "sim://cframe/node?seed=3&open=0&shorted=1",
        settings={"timeout": 0.7},
        name="node",
        mutants=40,
        dead_address="can://virtual/nobody?node=5",
    )
