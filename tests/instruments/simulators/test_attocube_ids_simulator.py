"""The simulated IDS3010, byte by byte over a socket, against published exchanges."""

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from wire_vectors import vectors

from errormotion.instruments.simulators.interferometer.attocube_ids import SimulatedIds
from errormotion.instruments.transports.address import parse_address

SYSTEM, DISPLACEMENT = "com.attocube.ids.system.", "com.attocube.ids.displacement."


@contextmanager
def line(query: str) -> Iterator[Any]:
    """Yield a function that sends bytes and returns the reply."""
    device = SimulatedIds(parse_address(f"sim://cframe/ids?seed=5&{query}"))
    place = parse_address(device.url)
    try:
        with socket.create_connection((place.host, place.port), timeout=5.0) as wire, wire.makefile("rb") as lines:

            def ask(data: bytes) -> dict[str, Any]:
                wire.sendall(data)
                reply = lines.readline()
                assert reply.endswith(b"\r\n")
                return dict(json.loads(reply))

            yield ask
    finally:
        device.close()


def call(method: str, *params: Any, api: int = 2) -> bytes:
    request = {"jsonrpc": "2.0", "method": method, "id": 4, "params": list(params)}
    return json.dumps({**request, "api": api} if api > 1 else request).encode()


def test_requests_of_the_makers_client_are_understood() -> None:
    with line("running=1") as ask:
        for vector in vectors("attocube_ids", "request"):
            reply = ask(vector.data)
            assert (reply["id"], reply["result"][0]) == (vector.expected["number"], 0)
        assert ask(vectors("attocube_ids", "request")[0].data + b"\n")["result"][0] == 0  # as from MATLAB


def test_an_unknown_function_is_refused_as_published() -> None:
    published = json.loads(next(each.data for each in vectors("attocube_ids", "reply") if "unknown" in each.name))
    with line("init=0") as ask:
        reply = ask(b'{"jsonrpc":"2.0","method":"com.attocube.ids.displacement.getAll","id":1}')
        assert reply == published
        assert ask(call("com.attocube.ids.displacement.__class__"))["error"]["code"] == -32099


def test_two_requests_in_one_segment_are_a_parse_error() -> None:
    with line("running=1") as ask:
        two = 2 * call(SYSTEM + "getCurrentMode")
        assert ask(two)["error"]["code"] == -32700
        assert ask(call(SYSTEM + "getCurrentMode"))["result"] == [0, "measurement running"]
        assert ask(b"no json")["error"]["message"] == "Parse Error"


def test_an_old_interface_gives_values_alone_but_warnings_with_displacements() -> None:
    with line("running=1") as ask:
        assert ask(call(SYSTEM + "getCurrentMode", api=1))["result"] == ["measurement running"]
        assert len(ask(call(DISPLACEMENT + "getAxesDisplacement", api=1))["result"]) == 4


def test_a_measurement_starts_from_the_idle_mode_only() -> None:
    with line("init=0") as ask:
        assert ask(call(SYSTEM + "stopMeasurement"))["result"][0] != 0
        assert ask(call(DISPLACEMENT + "getAxesDisplacement"))["result"][0] != 0
        assert ask(call(SYSTEM + "startMeasurement"))["result"] == [0]
        assert ask(call(SYSTEM + "getCurrentMode"))["result"] == [0, "measurement running"]
        assert ask(call(SYSTEM + "startOpticsAlignment"))["result"][0] != 0
        assert ask(call(SYSTEM + "stopMeasurement"))["result"] == [0]
        assert ask(call(SYSTEM + "startOpticsAlignment"))["result"] == [0]


def test_a_reset_moves_the_reference_and_keeps_the_absolute_position() -> None:
    with line("running=1&noise=0") as ask:
        before = ask(call(DISPLACEMENT + "getAbsolutePositions"))["result"]
        assert before == [0, 500_000_000_000, 500_000_000_000, 500_000_000_000]
        assert ask(call(SYSTEM + "resetAxis", 1))["result"] == [0]
        assert ask(call(DISPLACEMENT + "getAbsolutePositions"))["result"] == before
        assert ask(call(SYSTEM + "resetAxis", 3))["result"][0] != 0


@pytest.mark.parametrize("wrong", [("setAverageN", 25), ("getAxisDisplacement",), ("getAxisDisplacement", "0")])
def test_wrong_parameters_are_errors(wrong: tuple[Any, ...]) -> None:
    with line("running=1") as ask:
        assert ask(call(DISPLACEMENT + wrong[0], *wrong[1:]))["result"][0] != 0
