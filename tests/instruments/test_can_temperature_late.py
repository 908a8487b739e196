"""CANopen thermometers: late answers, and answers to another request."""

import struct
from collections.abc import Iterator

import pytest
from canopen_nodes import CONSTANTS, ONE, a_server, reply
from coded import raises

from errormotion.errors import InstrumentTimeoutError
from errormotion.instruments.thermometer.can_temperature import CanTemperature


def test_late_answers_are_not_taken_for_later_ones() -> None:
    """Every value is the number of its request; one answer arrives after the time limit."""
    late, asked, after = 1.0, 0, []

    def answers(number: int, index: int, subindex: int) -> Iterator[tuple[float, bytes]]:
        nonlocal asked
        value: float | None = CONSTANTS.get((index, subindex))
        delay = 0.0
        if (index, subindex) == (0x6130, 1):
            asked += 1
            value = float(asked)
            delay = late if asked == 4 else 0.0
        yield delay, reply(index, subindex, value)

    settings = ONE.model_copy(update={"timeout": 0.6})
    with a_server(answers) as address, CanTemperature(address, settings) as thermometer:
        while asked < 3:
            assert thermometer.read() == {"air": float(asked)}
        with pytest.raises(InstrumentTimeoutError):
            thermometer.read()
        for _ in range(4):
            try:
                after.append((thermometer.read()["air"], float(asked)))
            except InstrumentTimeoutError:
                continue
        assert len(after) >= 3
        assert all(found == right for found, right in after)
        assert thermometer.node.late >= 1


def test_answers_to_other_requests_are_ignored() -> None:
    def answers(number: int, index: int, subindex: int) -> Iterator[tuple[float, bytes]]:
        yield 0.0, reply(0x6130, 2, 99.0)
        yield 0.0, struct.pack("<BHBI", 0x80, 0x6130, 2, 0x08000000)
        value = 20.5 if (index, subindex) == (0x6130, 1) else CONSTANTS.get((index, subindex))
        yield 0.0, reply(index, subindex, value)

    with a_server(answers) as address, CanTemperature(address, ONE) as thermometer:
        assert thermometer.read() == {"air": 20.5}


def test_a_transfer_without_end_is_cut_off() -> None:
    def answers(number: int, index: int, subindex: int) -> Iterator[tuple[float, bytes]]:
        if index == 0x1008:
            yield 0.0, struct.pack("<BHBI", 0x41, index, subindex, 1 << 20)
        else:
            yield 0.0, reply(index, subindex, 1.0 if index == 0x6130 else CONSTANTS.get((index, subindex)))

    with a_server(answers) as address:
        thermometer = CanTemperature(address, ONE)
        with raises("protocol.can.form"):
            thermometer.open()
