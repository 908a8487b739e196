"""Another implementation of the protocol at either end: CESAPI, from PyPI, with its own simulator and client."""

import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest

from errormotion.errors import InstrumentError
from errormotion.instruments import simulators
from errormotion.instruments.laser_tracker.leica_emscon import EmSconSettings, LeicaEmScon
from errormotion.instruments.simulators.laser_tracker.leica_emscon import SimulatedEmScon
from errormotion.instruments.transports import parse_address

pytest.importorskip("CESAPI", reason="the package CESAPI, another implementation, is not installed")

SIMULATOR = """
import logging, sys
from CESAPI.test import LTSimulator
logging.disable(logging.CRITICAL)
simulator = eval(sys.argv[2])()
simulator.host, simulator.port, simulator.daemon = "127.0.0.1", int(sys.argv[1]), True
simulator.start()
print("up", flush=True)
sys.stdin.read()
"""

MEASURING = """
import CESAPI.packet as packets
class Measuring(LTSimulator):
    # Its own simulator answers StartMeasurement, but sends no result, and it fills units with counters.
    def packets(self, data):
        found = super().packets(data)
        command, answer = found
        for name in ("SetUnits", "SetCoordinateSystemType", "SetSystemSettings"):
            if command.packetInfo.command == getattr(packets, "ES_C_" + name):
                self.__dict__[name] = command
        if command.packetInfo.command == packets.ES_C_StartMeasurement:
            return command, WithResult(answer)
        return found
    def populateReturnPacket(self, thing):
        super().populateReturnPacket(thing)
        number = thing.packetInfo.command if hasattr(thing, "packetInfo") else None
        if number == packets.ES_C_GetUnits:
            thing.unitsSettings = self.SetUnits.unitsSettings
        elif number == packets.ES_C_GetCoordinateSystemType:
            thing.coordSysType = self.SetCoordinateSystemType.coordSysType
        elif number == packets.ES_C_GetSystemSettings and hasattr(self, "SetSystemSettings"):
            thing.systemSettings = self.SetSystemSettings.systemSettings
class WithResult:
    def __init__(self, answer):
        self.answer, self.packetInfo = answer, answer.packetInfo
    def pack(self):
        result = packets.SingleMeasResultT()
        result.dVal1, result.dVal2, result.dVal3 = 0.25, 1.5, 2.125
        result.dStd1, result.dStd2, result.dStd3 = 1e-6, 2e-6, 3e-6
        result.dTemperature, result.dPressure, result.dHumidity = 21.0, 1000.0, 40.0
        return self.answer.pack() + result.pack()
"""

CLIENT = """
import logging, sys, time
from CESAPI.command import CommandSync
from CESAPI.connection import Connection, PacketStream
from CESAPI.packet import ES_CS_SCC, ES_LU_Millimeter, SystemUnitsDataT
logging.disable(logging.CRITICAL)
unread = PacketStream.unreadCount  # asked without a pause while an answer is awaited
PacketStream.unreadCount = lambda stream: unread(stream) or time.sleep(0.005) or 0
connection = Connection()
connection.connect(host="127.0.0.1", port=int(sys.argv[1]))
command = CommandSync(connection)
units = SystemUnitsDataT()
units.lenUnitType = ES_LU_Millimeter
command.SetUnits(units)
command.SetCoordinateSystemType(ES_CS_SCC)
command.Initialize()
found = command.StartMeasurement()
print(found.dVal1, found.dVal2, found.dVal3, found.dTemperature, found.dPressure, flush=True)
connection.disconnect()
"""


@pytest.fixture
def port() -> Iterator[int]:
    yield from running(SIMULATOR, "LTSimulator")


@pytest.fixture
def measuring_port() -> Iterator[int]:
    head, start, rest = SIMULATOR.partition("logging.disable")
    yield from running(head + MEASURING + start + rest, "Measuring")


def running(script: str, simulator: str) -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        free = server.getsockname()[1]
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(free), simulator],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    with process:
        assert process.stdout.readline() == b"up\n"
        yield free
        process.stdin.close()
        process.wait(20)


def connected(port: int, settings: EmSconSettings) -> LeicaEmScon:
    tracker = LeicaEmScon(f"tcp://127.0.0.1:{port}", settings)
    for _ in range(100):  # it reports its start shortly before it listens
        try:
            tracker.open()
        except InstrumentError as error:
            if not re.search("refused", str(error)):
                raise
            time.sleep(0.05)
        else:
            break
    return tracker


def test_the_driver_works_with_a_foreign_simulator(port: int) -> None:
    tracker = connected(port, EmSconSettings(timeout=5.0))
    try:
        identity, air = tracker.identify(), tracker.environment()
        tracker.set_refraction(1.00027)
        tracker.go_to((1.0, 2.0, 0.1))
        tracker.find_reflector(2.0)
        tracker.home()
        direction, index, reflectors = tracker.direction(), tracker.refraction(), tracker.reflectors()
        changes = [event.text for event in tracker.events]
    finally:
        tracker.close()
    assert (identity.serial_number, identity.firmware) == ("390793", "emScon 3.8.900")
    assert (air.temperature, air.pressure, air.humidity) == (22.0, 101_325.0, 0.42)
    assert (index, reflectors) == (1.00027, ())  # it reports 0 reflectors
    assert np.isfinite(direction).all()
    assert changes == ["initialisation changed", "ready to measure", "statistics changed"]


def test_a_measurement_that_another_implementation_encodes_is_read(measuring_port: int) -> None:
    tracker = connected(measuring_port, EmSconSettings(timeout=5.0))
    try:
        found = tracker.measure()
    finally:
        tracker.close()
    assert found.valid
    assert (found.distance, found.angles, found.std) == (2.125, (0.25, 1.5), (3e-6, 1e-6, 2e-6))
    assert (found.environment.temperature, found.environment.pressure) == (21.0, 100_000.0)
    assert found.refraction_index == 1.00027


@pytest.mark.slow
def test_a_foreign_client_measures_with_the_simulator() -> None:
    device = SimulatedEmScon(
        parse_address("sim://cframe/tracker?seed=3&tracker=AT4xx&noise=0&angle_noise=0&dead_path=0")
    )
    try:
        seen = device.scene.seen(np.array([0.0]))[0]
        port = device.url.rpartition(":")[2]
        done = subprocess.run(
            [sys.executable, "-c", CLIENT, port], capture_output=True, text=True, timeout=60, env=os.environ
        )
        assert done.returncode == 0, done.stderr
        azimuth, zenith, distance, temperature, pressure = map(float, done.stdout.split())
    finally:
        device.close()
        simulators.reset()
    # in mm, and divided by the refraction index of the server: 20 degC, 1013.25 mbar
    assert (azimuth, zenith) == pytest.approx(seen[:2], abs=1e-15)
    assert distance == pytest.approx(1e3 * seen[2], rel=5e-6)
    assert (temperature, pressure) == (20.0, 1013.25)
