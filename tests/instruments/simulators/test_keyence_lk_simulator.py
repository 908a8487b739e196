"""The simulated LK-G5000 and LK-G3000 on their line, with lines of manuals and of foreign clients."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from wire_vectors import Vector, vectors

from errormotion.instruments.simulators.point_lds.keyence_lk import SimulatedKeyenceLK
from errormotion.instruments.simulators.point_lds.keyence_lk_grammar import CONTROLLERS, DISPLAYS, value_text
from errormotion.instruments.transports import parse_address

#: Settings that a program of LSST requests of an LK-G5000, with the first output.
SETTINGS = [
    "LM,01",
    "HA,M,01",
    "HA,R,01",
    "HB,M,01",
    "HB,B,01",
    "HC,N,01",
    "HC,L,01",
    "HE,01",
    "HF,01",
    "HG,01",
    "HI,01",
    "HJ,01",
    "OA,H,01",
    "OA,T,01",
    "OA,C,01",
    "OA,M,01",
    "OB,01",
    "OC,01",
    "OD,01",
    "OE,M,01",
    "OF,01",
    "OG,01",
    "OH,01",
    "OI,01",
    "OJ,01",
    "OK,01",
    "CA",
    "CB",
    "CD",
    "CE",
    "CF",
    "CG,01",
    "CH",
    "EE",
    "EF",
    "EG",
    "EH,I",
    "EH,M",
    "EH,G",
]


class Line:
    """A terminal at the controller."""

    def __init__(self, device: SimulatedKeyenceLK) -> None:
        host, _, port = device.url.removeprefix("tcp://").rpartition(":")
        self.socket = socket.create_connection((host, int(port)), timeout=10)

    def raw(self, data: bytes) -> bytes:
        self.socket.sendall(data)
        answer = b""
        while not answer.endswith(b"\r"):
            answer += self.socket.recv(4096)
        return answer

    def ask(self, text: str) -> str:
        return self.raw(text.encode() + b"\r").decode().removesuffix("\r")


@contextmanager
def line(controller: str = "LK-G5000", more: str = "&readings=-1.2345") -> Iterator[Line]:
    device = SimulatedKeyenceLK(parse_address(f"sim://cframe/lk?seed=3&controller={controller}{more}"))
    terminal = Line(device)
    try:
        yield terminal
    finally:
        terminal.socket.close()
        device.close()


@pytest.mark.parametrize("vector", vectors("keyence_lk", "value"), ids=str)
def test_values_are_formatted_as_in_the_manual(vector: Vector) -> None:
    decimals, value = vector.expected["decimals"], vector.expected["value"]
    display = next(k for k, (_, places) in enumerate(DISPLAYS) if places == decimals)
    assert value_text(value * DISPLAYS[display][0], display) == vector.data.decode()


@pytest.mark.parametrize("vector", vectors("keyence_lk", "no value"), ids=str)
def test_missing_values_are_formatted_as_in_the_manual(vector: Vector) -> None:
    reading = {"no value": "nan", "over range": "-99", "under range": "99"}[vector.expected["reason"]]
    with line(more=f"&readings={reading}") as terminal:
        assert terminal.ask("MS,01") == f"MS,01,{vector.data.decode()}"


@pytest.mark.parametrize("vector", vectors("keyence_lk", "answer"), ids=str)
def test_answers_are_those_that_foreign_clients_read(vector: Vector) -> None:
    expected = vector.expected
    display = next(k for k, (_, places) in enumerate(DISPLAYS) if places == expected["decimals"])
    with line(expected["controller"], f"&readings={-expected['value']}&display={display}") as terminal:
        assert terminal.ask(expected["request"]) == vector.data.decode()


@pytest.mark.parametrize("vector", vectors("keyence_lk", "error"), ids=str)
def test_mistakes_are_answered_with_their_errors(vector: Vector) -> None:
    with line(vector.expected["controller"]) as terminal:
        if vector.expected["mode"] == "communication":
            assert terminal.ask("Q0") == "Q0"
        assert terminal.ask(vector.expected["request"]) == vector.data.decode()


def test_several_and_all_outputs_are_read_at_once() -> None:
    with line(more="&readings=-1.2345&output=2&outputs=3") as terminal:
        assert terminal.ask("MA") == "MA,XXXXXXXX,+01.2345,XXXXXXXX"
        assert terminal.ask("MM,011000000000") == "MM,011000000000,+01.2345,XXXXXXXX"
        assert terminal.ask("MM,000100000000") == "ER,MM,62"
        assert terminal.ask("MM,002000000000") == "ER,MM,62"
        assert terminal.ask("MM,0110") == "ER,MM,60"
        assert terminal.ask("MM") == "ER,MM,61"
        assert terminal.ask("MA,01") == "ER,MA,61"
        assert terminal.ask("MS,04") == "ER,MS,62"
        assert terminal.ask("MS,2") == "ER,MS,60"
        assert terminal.ask("MS,0A") == "ER,MS,62"


def test_lower_case_is_understood_and_a_line_feed_between_commands_is_ignored() -> None:
    with line() as terminal:
        assert terminal.ask("ms,01") == "MS,01,+01.2345"
        assert terminal.raw(b"MA\r\n") == b"MA,+01.2345\r"  # as clients send that end their lines so
        assert terminal.raw(b"MA\r\n") == b"MA,+01.2345\r"


def test_a_line_without_end_is_bounded() -> None:
    with line() as terminal:
        assert terminal.raw(b"MS," + b"0" * 100_000 + b"\r").startswith(b"ER,MS,60")
        assert terminal.ask("MA") == "MA,+01.2345"


@pytest.mark.parametrize(("on", "off"), [("VS,01", "WS,01"), ("VM,100000000000", "WM,100000000000"), ("VA", "WA")])
def test_zero_is_set_and_cleared(on: str, off: str) -> None:
    with line() as terminal:
        assert terminal.ask(on) == on[:2]
        assert terminal.ask("MS,01") == "MS,01,+00.0000"
        assert terminal.ask(off) == off[:2]
        assert terminal.ask("MS,01") == "MS,01,+01.2345"


@pytest.mark.parametrize(("on", "off"), [("TS,1,01", "TS,0,01"), ("TM,1,100000000000", "TM,0,100000000000")])
def test_timing_holds_the_value(on: str, off: str) -> None:
    with line(more="&readings=-1,-2,-3,-4") as terminal:
        assert terminal.ask(on) == on[:2]
        assert [terminal.ask("MA") for _ in range(2)] == ["MA,+01.0000"] * 2
        assert terminal.ask(off) == off[:2]
        assert terminal.ask("MA") == "MA,+02.0000"
        assert terminal.ask(on[:2] + ",2" + on[4:]) == f"ER,{on[:2]},62"
        assert terminal.ask("RS,01") == "RS"


def test_data_are_stored_and_fetched() -> None:
    with line(more="&readings=-1,-2,-3&outputs=2") as terminal:
        assert terminal.ask("AN") == "AN,0,0000000,0000000"
        assert terminal.ask("AO,01") == "ER,AO,51"
        assert terminal.ask("Q0") == "Q0"
        assert terminal.ask("SW,CD,0000005,00") == "SW,CD"
        assert terminal.ask("SW,CD,0000005,11") == "ER,SW,62"
        assert terminal.ask("SW,CD,5") == "ER,SW,61"
        assert terminal.ask("R0") == "R0"
        assert [terminal.ask(text) for text in ("AQ", "AS", "AP")] == ["AQ", "AS", "AP"]
        assert terminal.ask("AN") == "AN,0,0000005,0000000"
        assert terminal.ask("AO,01") == "AO,+01.0000,+02.0000,+03.0000,+01.0000,+02.0000"


@pytest.mark.parametrize(
    "text",
    SETTINGS,
)
def test_every_setting_that_foreign_clients_request_is_only_answered_in_the_communication_mode(text: str) -> None:
    with line() as terminal:
        assert terminal.ask(f"SR,{text}") == "ER,SR,51"
        assert terminal.ask("Q0") == "Q0"
        assert terminal.ask(f"SR,{text}").startswith(f"SR,{text},")
        assert terminal.ask("MS,01") == "ER,MS,51"


def test_settings_are_written_checked_and_take_effect() -> None:
    with line() as terminal:
        assert terminal.ask("Q0") == "Q0"
        assert terminal.ask("SW,OI,01,3") == "SW,OI"
        assert terminal.ask("SR,OI,01") == "SR,OI,01,3"
        assert terminal.ask("SW,OF,01,+050000") == "SW,OF"
        assert terminal.ask("SR,OF,01") == "SR,OF,01,+0.50000"
        assert terminal.ask("SW,OF,01,+0.50000") == "ER,SW,60"  # a change has no point
        assert terminal.ask("SW,CA,9") == "ER,SW,62"
        assert terminal.ask("SW,OC,01,0") == "ER,SW,61"
        assert terminal.ask("SW,OC,1,0,5") == "ER,SW,60"
        assert terminal.ask("SW,OC,01,0,5") == "SW,OC"
        assert terminal.ask("SW,ZZ,01,0") == "ER,SW,62"
        assert terminal.ask("SR") == "ER,SR,61"
        assert terminal.ask("R0") == "R0"
        assert terminal.ask("R0") == "ER,R0,51"
        assert terminal.ask("MS,01") == "MS,01,+1.73450"


def test_program_and_panel_are_switched() -> None:
    with line() as terminal:
        assert terminal.ask("PR") == "PR,0"
        assert terminal.ask("PW,7") == "PW"
        assert terminal.ask("PR") == "PR,7"
        assert terminal.ask("PW,8") == "ER,PW,62"
        assert terminal.ask("KL,1") == "KL"
        assert terminal.ask("KL,2") == "ER,KL,62"
        assert terminal.ask("KL") == "ER,KL,61"


def test_the_older_series_has_its_own_commands() -> None:
    with line("LK-G3000", "&readings=-1.2345&output=2") as terminal:
        assert terminal.ask("M0") == "M0,XXXXXXXX,+01.2345"
        assert terminal.ask("M2") == "M2,+01.2345"
        assert terminal.ask("MS,01") == "ER,MS,00"
        assert terminal.ask("V2") == "V2"
        assert terminal.ask("M2") == "M2,+00.0000"
        assert terminal.ask("W0") == "W0"
        assert terminal.ask("T1,2") == "T1"
        assert terminal.ask("VR,0") == "VR"
        assert terminal.ask("VR,3") == "ER,VR,22"
        assert terminal.ask("VR") == "ER,VR,21"
        assert terminal.ask("DQ") == "DQ"
        assert terminal.ask("DO,1").startswith("DO,1,")
        assert terminal.ask("Q0") == "Q0"
        assert terminal.ask("SW,HA,M,1,0") == "SW,HA"
        assert terminal.ask("SW,HB,1,4") == "SW,HB"
        assert terminal.ask("SW,CA,5") == "SW,CA"
        assert terminal.ask("SW,CA,6") == "ER,SW,22"
        assert terminal.ask("SW,OC,1,0,9") == "SW,OC"
        assert terminal.ask("SW,CI,1,00003,0") == "SW,CI"
        assert terminal.ask("R0") == "R0"
        assert terminal.ask("AS") == "AS"
        assert terminal.ask("AN") == "AN,0,00000,00003"
        assert terminal.ask("AO,2") == "AO,+01.2345,+01.2345,+01.2345"


@pytest.mark.parametrize("controller", sorted(CONTROLLERS))
def test_every_line_has_an_answer(controller: str) -> None:
    with line(controller) as terminal:
        for text in (
            "",
            ",",
            "MS,,",
            "SW,,,",
            "é",
            "ER,MS,00",
            "Q0,1",
            "MS," + "1" * 200,
            "AO,99",
            "SR,OA",
            "SW,OI,01",
        ):
            assert terminal.ask(text).startswith("ER,")
