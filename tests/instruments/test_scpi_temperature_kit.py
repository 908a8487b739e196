"""The conformance kit on SCPI data acquisition units, and the driver against the simulated unit."""

import math

import pytest
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError
from errormotion.instruments.thermometer.scpi.driver import ScpiTemperature
from errormotion.instruments.thermometer.scpi.settings import ScpiSettings
from errormotion.testing import InstrumentConformance, InstrumentSubject

ADDRESS = "sim://cframe/unit?seed=3&noise=0"


class TestThermocouples(InstrumentConformance):
    """Thermocouples on a pty, one of them open; no such line."""

    subject = InstrumentSubject(
        ScpiTemperature,
        "sim://cframe/couples?seed=3&wire=pty&open=1",
        settings={"timeout": 0.7, "sensors": ("TC K",)},
        name="couples",
        mutants=40,
        dead_address="serial:///dev/no_such_line",
    )


def test_an_open_sensor_and_a_channel_without_one_are_open() -> None:
    settings = ScpiSettings(channels=("frame", "oil", "none"), inputs=(102, 101, 110), timeout=1.0)
    with ScpiTemperature(f"{ADDRESS}&sensors=frame,ambient&open=1", settings) as unit:
        found = unit.read()
    assert (unit.flags, math.isnan(found["frame"]), found["oil"]) == (
        {"frame": "open", "oil": "", "none": "open"},
        True,
        pytest.approx(20.0, abs=5.0),
    )


@pytest.mark.parametrize(
    ("inputs", "refusal"),
    [(111, "refuses 'CONF:TEMP FRTD,85,.*': 305"), (121, "': 112 Channel list"), (201, "': 111 Channel list: slot")],
)
def test_channels_that_the_unit_does_not_have_are_refused_with_its_text(inputs: int, refusal: str) -> None:
    settings = ScpiSettings(channels=("frame",), inputs=(inputs,), timeout=1.0)
    with pytest.raises(InstrumentError, match=refusal):
        ScpiTemperature(ADDRESS, settings).open()


@pytest.mark.parametrize("vector", vectors("scpi_temperature", "command"), ids=str)
def test_settings_of_the_vectors_are_accepted(vector: Vector) -> None:
    if max(vector.expected["inputs"]) > 120:
        vector.expected["inputs"] = [101 + k for k in range(len(vector.expected["inputs"]))]  # a unit with one slot
    names = tuple(f"sensor {k}" for k in range(len(vector.expected["inputs"])))
    with ScpiTemperature(ADDRESS, ScpiSettings(channels=names, timeout=1.0, **vector.expected)) as unit:
        assert set(unit.read()) == set(names)
        assert unit.errors() == []
