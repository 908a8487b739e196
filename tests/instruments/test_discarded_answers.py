"""Where answers to other requests came instead of the awaited one, the error states so, and not that nothing came."""

import json
from collections.abc import Callable
from typing import Any

import pytest
from emscon_answers import encode_answer

from errormotion.errors import InstrumentTimeoutError
from errormotion.instruments.controller.linuxcnc.driver import LinuxCNC
from errormotion.instruments.laser_tracker.leica_emscon import codec as emscon
from errormotion.instruments.laser_tracker.leica_emscon.link import Link
from errormotion.instruments.line_profiler.keyence_ljx import codec as ljx
from errormotion.instruments.line_profiler.keyence_ljx.commands import CommandLine
from errormotion.instruments.point_lds.capancdt.driver import CapaNCDT
from errormotion.instruments.point_lds.keyence_lk.driver import KeyenceLK
from errormotion.instruments.thermometer.dcon import DconTemperature
from errormotion.instruments.thermometer.scpi.driver import ScpiTemperature
from errormotion.instruments.transports.base import Transport
from errormotion.instruments.transports.can.node import CanNode
from errormotion.instruments.transports.can.sdo import SdoClient

URL = "tcp://127.0.0.1:1"


class Line(Transport):
    """A device that answers the first request by another answer, and then is silent."""

    def __init__(self, answer: bytes) -> None:
        super().__init__(URL, 0.05)
        self.answer, self.asked = answer, False

    def _send(self, data: bytes) -> None:
        self.asked = True

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        if not self.asked or not self.answer:
            raise InstrumentTimeoutError("received nothing")
        piece, self.answer = self.answer[:max_bytes], self.answer[max_bytes:]
        return piece

    def close(self) -> None:
        pass


def ask_keyence_lk(line: Line) -> None:
    driver = KeyenceLK(URL)
    driver._transport = line
    driver._enter("Q0")


def ask_capancdt(line: Line) -> None:
    driver = CapaNCDT(URL)
    driver._transport = line
    driver._query("STI")


def ask_scpi(line: Line) -> None:
    driver = ScpiTemperature(URL)
    driver._transport = line
    driver.resynchronise()


def ask_dcon(line: Line) -> None:
    driver = DconTemperature(URL)
    driver._transport = line
    driver.resynchronise()


def ask_linuxcnc(line: Line) -> None:
    driver = LinuxCNC(URL)
    driver._unawaited.add(1)
    line.write(b"?")
    driver._await(line, 2)


def ask_ljx(line: Line) -> None:
    CommandLine(line, "profiler", next(iter(ljx.GENERATIONS)), 0.1).command(0x41)


def ask_emscon(line: Line) -> None:
    line.write(b"?")
    number = next(iter(emscon.COMMANDS))
    Link(line, 0.1, 0.1).await_packet(lambda packet: packet.command == number, 0.1, "the command", number)


@pytest.mark.parametrize(
    ("ask", "answer"),
    [
        (ask_keyence_lk, b"M0,+01.0000\r"),
        (ask_capancdt, b"$GMD0OK\r\n"),
        (ask_scpi, b"+2.1E+01\n"),
        (ask_dcon, b">+025.00\r"),
        (ask_linuxcnc, json.dumps({"id": 1, "ok": True, "result": None}).encode() + b"\n"),
        (ask_ljx, ljx.reply(command=0x42)),
        (ask_emscon, encode_answer(list(emscon.COMMANDS)[1])),
    ],
)
def test_a_discarded_answer_is_stated_where_the_awaited_one_is_missing(
    ask: Callable[[Line], None], answer: bytes
) -> None:
    with pytest.raises(InstrumentTimeoutError, match=r"No answer to .* came, but 1 answer to other requests was disc"):
        ask(Line(answer))
    with pytest.raises(InstrumentTimeoutError) as nothing:
        ask(Line(b""))
    assert "discarded" not in str(nothing.value)


class Node(CanNode):
    """A node without a bus, which answers every request by the value of the entry 0x1234:0."""

    _where = "node 1"

    def __init__(self) -> None:
        self._sdo = SdoClient(self._put, 0.05)

    def _put(self, request: bytes, forget: Callable[[], None] | None) -> None:
        self._sdo.answers.put(bytes.fromhex("4f 34 12 00 01 00 00 00"))

    def _guarded(self, work: Callable[[], Any]) -> Any:
        return work()

    def _silence(self, what: str) -> InstrumentTimeoutError:
        return InstrumentTimeoutError(f"{self._where} {what}")


def test_a_discarded_answer_of_a_node_on_a_can_bus_is_stated() -> None:
    with pytest.raises(InstrumentTimeoutError, match=r"No answer to 0x2000:1 came, but 1 answer to other requests"):
        Node().upload(0x2000, 1)
