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
simulator = LTSimulator()
simulator.host, simulator.port, simulator.daemon = "127.0.0.1", int(sys.argv[1]), True
simulator.start()
print("up", flush=True)
sys.stdin.read()
"""

CLIENT = """
import logging, sys
from CESAPI.command import CommandSync
from CESAPI.connection import Connection
from CESAPI.packet import ES_CS_SCC, ES_LU_Millimeter, SystemUnitsDataT
logging.disable(logging.CRITICAL)
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
    with socket.create_server(("127.0.0.1", 0)) as server:
        free = server.getsockname()[1]
    process = subprocess.Popen(
        [sys.executable, "-c", SIMULATOR, str(free)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=os.environ
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
    for _ in range(100):  # it states that it is up shortly before it listens
        try:
            tracker.open()
        except InstrumentError as error:
            if not re.search("refused", str(error)):
                raise
            time.sleep(0.05)
        else:
            break
    return tracker


def test_a_simulator_of_another_origin_is_spoken_to_without_change(port: int) -> None:
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
    assert (index, reflectors) == (1.00027, ())  # it states that it knows 0 reflectors
    assert np.isfinite(direction).all()
    assert changes == ["initialisation changed", "ready to measure", "statistics changed"]


def test_a_client_of_another_origin_measures_with_our_simulator() -> None:
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
    # in mm, and divided by the index of the air that the server reckons with: 20 degC, 1013.25 mbar
    assert (azimuth, zenith) == pytest.approx(seen[:2], abs=1e-15)
    assert distance == pytest.approx(1e3 * seen[2], rel=5e-6)
    assert (temperature, pressure) == (20.0, 1013.25)
