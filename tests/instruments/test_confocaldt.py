"""The driver of the confocalDT: its codec against documents, and the driver against the simulator."""

from collections.abc import Iterator

import numpy as np
import pytest
from coded import raises
from wire_vectors import Vector, vectors

from errormotion.errors import ProtocolError
from errormotion.instruments import simulators
from errormotion.instruments.point_lds.confocaldt import ConfocalDT, ConfocalSettings, codec
from errormotion.instruments.point_lds.confocaldt.blocks import (
    DISTANCE_1,
    HEADER,
    MEASURED,
    block_decoder,
    readings,
    scale,
)
from errormotion.instruments.point_lds.optoncdt.commands import RefusedCommandError, parse_answer


def layer(name: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("vector", vectors("confocaldt", name), ids=str)


def block(counter: int, *values: int) -> bytes:
    header = HEADER.pack(b"SAEM", 2418004, 11020009, MEASURED | DISTANCE_1, 0, 4, len(values), counter)
    return header + np.array(values, dtype="<i4").tobytes()


# ---------------------------------------------------------------------- codec


@layer("facts")
def test_identity(vector: Vector) -> None:
    facts = codec.facts_of(parse_answer(vector.expected["command"], vector.data))
    assert codec.model_of(facts) == vector.expected["name"]
    assert (facts["serial"], facts["version"]) == (vector.expected["serial"], vector.expected["version"])


def test_controllers_with_another_grammar_are_refused() -> None:
    with raises("sensor.model.unknown"):
        codec.model_of({"name": "IFC2421"})


@layer("sensor")
def test_sensor(vector: Vector) -> None:
    facts = codec.facts_of(parse_answer(vector.expected["command"], vector.data))
    assert facts["name"] == vector.expected["name"]
    assert codec.range_of(facts) == pytest.approx(vector.expected["range_mm"] * 1e-3)


@layer("rate")
def test_rate(vector: Vector) -> None:
    assert codec.rate_of(parse_answer("MEASRATE", vector.data)) == vector.expected["hertz"]


@layer("reduction")
def test_reduction(vector: Vector) -> None:
    assert codec.reduction_of(parse_answer("OUTREDUCE", vector.data)) == vector.expected["factor"]


@layer("error")
def test_refusals_have_the_text_of_the_controller(vector: Vector) -> None:
    with pytest.raises(RefusedCommandError, match=vector.expected["message"]):
        parse_answer(vector.expected["command"], vector.data)


@pytest.mark.parametrize(
    ("rate", "command"), [(2500.0, "MEASRATE 2.5"), (330.0, "MEASRATE 0.3"), (7e4, "MEASRATE 70.0")]
)
def test_a_rate_has_one_decimal_place_of_a_kilohertz(rate: float, command: str) -> None:
    assert codec.rate_request(rate) == command


@pytest.mark.parametrize("answer", [[], ["MEASRATE"], ["MEASRATE fast"], ["MEASRATE -1"], ["MEASRATE 0"], ["9" * 300]])
def test_an_invalid_rate_is_an_error(answer: list[str]) -> None:
    with pytest.raises(ProtocolError):
        codec.rate_of(answer)


@layer("block")
def test_blocks(vector: Vector) -> None:
    (found,) = block_decoder().feed(vector.data, last=True)
    values, codes = scale(found.values[:, 0])
    assert found.counter == vector.expected["counter"]
    np.testing.assert_allclose(values * 1e6, vector.expected["micrometres"], rtol=1e-12)
    assert readings().counts(codes) == vector.expected["reasons"]


@layer("other")
def test_other_values_are_refused_with_their_size(vector: Vector) -> None:
    with raises("sensor.output.form"):
        block_decoder().feed(vector.data, last=True)


# ---------------------------------------------------------------------- driver


@pytest.fixture(autouse=True)
def ended() -> Iterator[None]:
    yield
    simulators.reset()


ADDRESS = "sim://cframe/X1?seed=3"


def test_reads_the_distance_of_the_machine() -> None:
    with ConfocalDT(ADDRESS) as sensor:
        world = simulators.world("cframe", 3)
        low, high = sensor.measuring_range
        assert low == 0.0
        value = sensor.read()
        assert low < value < high
        world.set_target("plane", 0.0, 0.0)
        reading = sensor.read()
        assert np.isfinite(reading) != bool(sensor.no_value)


def test_another_range_is_refused() -> None:
    with ConfocalDT(ADDRESS) as sensor:
        span = sensor.measuring_range[1]
    with raises("sensor.range.differs"):
        ConfocalDT(ADDRESS, ConfocalSettings(measuring_range=10 * span)).open()


def test_writes_the_rate_and_states_it() -> None:
    with ConfocalDT(ADDRESS, ConfocalSettings(rate=2500.0)) as sensor:
        assert sensor.rate == 2500.0
        samples = next(sensor.stream(block=100))
        assert samples.values.shape == (1, 100)
        assert samples.rate == 2500.0


def test_restores_the_previous_outputs() -> None:
    with ConfocalDT(ADDRESS) as sensor:
        dialogue = sensor._commands()
        dialogue._before.clear()  # as after another client
        dialogue.command("OUTADD_ETH COUNTER INTENSITY")
        dialogue.command("OUTREDUCE 10 ETHERNET")
        sensor._start_session()
        assert dialogue.command("OUTADD_ETH") == ["OUTADD_ETH NONE"]
        assert np.isfinite(sensor.read())
        opened = sensor._commands()
        opened.restore()
        assert opened.command("OUTADD_ETH") == ["OUTADD_ETH COUNTER INTENSITY"]
        assert codec.reduction_of(opened.command("OUTREDUCE")) == 10


def test_values_of_an_earlier_output_are_not_read() -> None:
    with ConfocalDT(ADDRESS) as sensor:
        stream = sensor.stream(block=50)
        next(stream)
        stream.close()
        first = sensor.read()
        assert abs(first - sensor.read()) < 20e-6  # noise and drift of the bar at rest


def test_refuses_a_master_value() -> None:
    with raises("sensor.master.set"):
        ConfocalDT(f"{ADDRESS}&left=MASTERMV+MASTER+0.5").open()


@pytest.mark.parametrize("left", ["ECHO+OFF", "OUTADD_ETH+COUNTER+INTENSITY", "OUTPUT+ETHERNET", "OUTREDUCE+10"])
def test_reads_with_any_settings_of_another_client(left: str) -> None:
    with ConfocalDT(ADDRESS) as sensor:
        expected = sensor.read()
    simulators.reset()
    with ConfocalDT(f"{ADDRESS}&left={left}") as sensor:
        assert sensor.read() == pytest.approx(expected, abs=20e-6)
        assert next(sensor.stream(block=20)).dropped == 0


@pytest.mark.parametrize("left", ["MEASMODE+THICKNESS", "SWITCHMD2+1"])
def test_refuses_other_values_than_one_distance(left: str) -> None:
    with ConfocalDT(f"{ADDRESS}&left={left}") as sensor, raises("sensor.output.form"):
        sensor.read()
