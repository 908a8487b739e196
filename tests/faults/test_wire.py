"""A quick form of ``make wire``: one session of each instrument on a disturbed wire, and the wire itself."""

import socket
import threading
import time
from collections.abc import Iterator

import pytest
import wire_proxy
import wire_trials as trials
from wire_proxy import DOWN, KINDS, UP, Fault, Proxy, Wire

from errormotion import plugins

CASES = trials.cases()
QUICK = ("duplicate", "cut", "corrupt", "split")
"""Kinds that are soon over."""
LONG = ("capancdt", "five_sensor_frame", "keyence_ljx", "opcua")
"""Their sessions have thousands of samples, or a slow client."""


@pytest.mark.parametrize(
    ("number", "case"),
    [
        pytest.param(number, case, id=case.name, marks=[pytest.mark.slow] * (case.plugin in LONG))
        for number, case in enumerate(CASES)
    ],
)
def test_a_disturbed_session_is_right_or_refused_and_the_driver_opens_again(number: int, case: trials.Case) -> None:
    kind = QUICK[number % len(QUICK)]
    (fault,) = trials.faults(case, kind, 1, seed=3)
    outcome = trials.trial(case, fault)
    assert not outcome.fault, f"{outcome.fault} ({outcome.what}; {fault})"


@pytest.mark.parametrize("at", [6, 20])
def test_an_answer_that_comes_twice_is_not_taken_for_the_next_one(at: int) -> None:
    """The protocol has no numbers: all later readings would be one reading old."""
    outcome = trials.trial(trials.Case("keyence_lk"), Fault("duplicate", DOWN, at))
    assert (outcome.end, outcome.fault) == ("right", "")
    assert outcome.what.startswith(f"duplicate of piece {at} down")


def test_a_changed_byte_is_found_by_a_checksum() -> None:
    case = next(case for case in CASES if case.settings)
    for place in range(3):
        outcome = trials.trial(case, Fault("corrupt", DOWN, 6, seed=place))
        assert (outcome.end, outcome.fault) == ("refused", "")


def test_a_wrong_value_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a checksum, and with the claim that there is one."""
    case = trials.Case("dcon_temperature", checked=("corrupt",))
    faults = (Fault("corrupt", DOWN, 6, seed=seed) for seed in range(30))
    assert any(trials.trial(case, fault).fault.startswith("wrong: ") for fault in faults)


def test_every_instrument_is_tried_or_has_a_reason() -> None:
    ours = {each.id for each in plugins.available("instruments") if each.distribution.startswith("errormotion ")}
    assert {case.plugin for case in CASES} | set(trials.WITHOUT_WIRE) >= ours
    assert set(trials.WITHOUT_WIRE) <= ours


# ---------------------------------------------------------------------- the wire


@pytest.fixture
def echo() -> Iterator[str]:
    """A server that sends back what it receives, one connection after another."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            while True:
                try:
                    line, _ = server.accept()
                except OSError:
                    return
                with line:
                    while data := line.recv(100):
                        line.sendall(data)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"
        server.shutdown(socket.SHUT_RDWR)
    thread.join(2.0)


@pytest.mark.parametrize(
    ("kind", "received"),
    [
        ("", b"0123456789"),
        ("delay", b"0123456789"),
        ("split", b"0123456789"),
        ("drip", b"0123456789"),
        ("duplicate", b"012343456789"),
        ("exchange", b"012435678"),
        ("corrupt", None),
        ("reorder", b"0125673489"),
        ("lose", b"01256789"),
        ("half-open", b"012"),
        ("cut", b"012"),
    ],
)
def test_a_wire_does_what_its_fault_says(echo: str, kind: str, received: bytes | None) -> None:
    wire = Wire(Fault(kind, DOWN, 1, seed=1))
    proxy = Proxy(echo, wire)
    got = b""
    try:
        with socket.create_connection(("127.0.0.1", int(proxy.url.rpartition(":")[2])), timeout=2.0) as line:
            line.settimeout(0.5)
            for number, data in enumerate((b"012", b"34", b"567", b"89")):
                try:
                    line.sendall(data)
                except OSError:
                    break
                until = time.monotonic() + (0.1 if wire.done and kind in ("half-open", "cut") else 5.0)
                while wire.pieces[DOWN] <= number and time.monotonic() < until:
                    time.sleep(0.001)
            try:
                while len(got) < 12 and (data := line.recv(100)):
                    got += data
            except OSError:
                pass
    finally:
        proxy.close()
    if kind == "corrupt":
        assert len(got) == 10
        assert sum(a != b for a, b in zip(got, b"0123456789", strict=True)) <= 1
    elif kind == "exchange":
        assert sorted(got) == list(b"0123456789")
    else:
        assert got == received
    assert wire.done == bool(kind)
    assert wire.pieces[UP] >= 1


def test_kinds_are_known_and_a_calm_wire_passes_on(echo: str) -> None:
    assert set(wire_proxy.HARMLESS) < set(KINDS)
    wire = Wire(Fault("half-open", DOWN, 0))
    proxy = Proxy(echo, wire)
    try:
        with socket.create_connection(("127.0.0.1", int(proxy.url.rpartition(":")[2])), timeout=2.0) as line:
            line.settimeout(0.2)
            line.sendall(b"a")
            with pytest.raises(TimeoutError):
                line.recv(1)
            wire.calm()
            line.settimeout(2.0)
            line.sendall(b"b")
            assert line.recv(1) == b"b"
    finally:
        proxy.close()
