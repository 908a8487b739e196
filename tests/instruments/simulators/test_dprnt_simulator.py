"""The simulated printer port: documented lines, the grammar of DPRNT, control codes, flow control, late lines."""

import math
import socket
import time
from contextlib import contextmanager
from urllib.parse import urlsplit

import pytest
from coded import raises
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError
from errormotion.instruments import simulators
from errormotion.instruments.simulators import world
from errormotion.instruments.simulators.touch_probe.dprnt import SimulatedPrinter
from errormotion.instruments.simulators.virtual_world.printing import in_iso_code, parse_block
from errormotion.instruments.transports import parse_address

DEVICE = "dprnt"
QUIET = 0.15  # s, longer than the delay of a line
DC1, DC2, DC3, DC4 = b"\x11", b"\x12", b"\x13", b"\x14"


def text(template, value=1.5436, control="haas", zeros="blank"):
    return parse_block(template, lambda _: value).text(control, zeros)


# ------------------------------------------------------------------ documented lines


@pytest.mark.parametrize("vector", vectors(DEVICE, "printed"), ids=str)
def test_documented_lines(vector: Vector) -> None:
    expected = vector.expected
    block = parse_block(expected["template"], lambda name: expected["values"][name])
    assert block.text(expected["control"]) + "\r" == vector.data.decode()


@pytest.mark.parametrize("vector", vectors(DEVICE, "refused"), ids=str)
def test_formats_that_are_not_legal(vector: Vector) -> None:
    with raises("machine.print.digits"):
        text(vector.data.decode())


@pytest.mark.parametrize("vector", vectors(DEVICE, "ISO code"), ids=str)
def test_characters_in_iso_code(vector: Vector) -> None:
    assert in_iso_code(vector.expected["text"].encode()) == vector.data


# From memory of FANUC's manuals, as docs/reference/devices/dprnt.md states: blanks for zeros and a column for the sign,
# or neither; digits above the stated ones are cut.
@pytest.mark.parametrize(
    ("template", "value", "blank", "none"),
    [
        ("X#2[53]", 128.47398, "X   128.474", "X128.474"),
        ("Y#5[53]", -91.2, "Y-   91.200", "Y-91.200"),
        ("T#30[20]", 123.456, "T 23", "T23"),
        ("Z#1[53]", 0.0, "Z     0.000", "Z0.000"),
        ("Z#1[53]", -0.0004, "Z     0.000", "Z0.000"),
        ("Z#1[03]", -0.5, "Z-0.500", "Z-0.500"),
    ],
)
def test_a_fanuc_control_blanks_or_omits_leading_zeros(template, value, blank, none):
    assert text(template, value, "fanuc") == blank
    assert text(template, value, "fanuc", "none") == none


@pytest.mark.parametrize(
    ("template", "value", "expected"),
    [("Y#1[53]", -91.2, "Y  -91.200"), ("Y#1[23]", -91.2, "Y-91.200"), ("Y#1[13]", -0.0004, "Y0.000")],
)
def test_a_haas_control_puts_the_sign_at_the_digits(template, value, expected):
    assert text(template, value) == expected


# ------------------------------------------------------------------ grammar


@pytest.mark.parametrize(
    ("template", "why"),
    [
        ("X#1", "expected a variable with its format"),
        ("X#1[5]", "expected a variable with its format"),
        ("X#1[533]", "expected a variable with its format"),
        ("X#[53]", "expected a variable with its format"),
        ("X#1[-5]", "expected a variable with its format"),
        ("X,#1[53]", "',' cannot be printed"),
        ("x", "'x' cannot be printed"),
        ("A=B", "'=' cannot be printed"),
        ("]", "cannot be printed"),
        ("\xb5", "cannot be printed"),
    ],
)
def test_other_blocks_are_refused(template, why):
    with pytest.raises(InstrumentError, match=why):
        text(template)


def test_stars_are_spaces_and_spaces_in_a_format_are_ignored():
    assert text("A**B #1 [ 14 ]*-/+9") == "A  B 1.5436 -/+9"


@given(st.floats(-99998, 99998), st.integers(1, 5), st.integers(0, 3))
def test_printed_numbers_are_those_of_the_program(value, whole, decimals):
    whole = max(whole, len(str(int(abs(value)) + 1)))
    for control, zeros in (("haas", "blank"), ("fanuc", "blank"), ("fanuc", "none")):
        printed = text(f"X#1[{whole}{decimals}]", value, control, zeros).removeprefix("X")
        expected = round(value, decimals) if decimals else math.trunc(value)
        assert float(printed.replace(" ", "")) == pytest.approx(expected, abs=1e-9)
        assert ("." in printed) == bool(decimals)


@given(st.text(max_size=30))
def test_any_template_is_a_block_or_refused(template):
    try:
        block = parse_block(template, lambda _: 1.0)
    except InstrumentError:
        return
    assert set(block.text()) <= set("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789+-/. ")


# ------------------------------------------------------------------ on its line


@pytest.fixture(autouse=True)
def _fresh():
    yield
    simulators.reset()


@contextmanager
def port(**params):
    query = "&".join(f"{name}={value}" for name, value in {"seed": 3, "port": 0, **params}.items())
    printer = SimulatedPrinter(parse_address(f"sim://cframe/printer?{query}"))
    parts = urlsplit(printer.url)
    try:
        with socket.create_connection((parts.hostname, parts.port), timeout=5) as line:
            assert printer._server.await_connection(5)
            yield line, world("cframe", 3)
    finally:
        printer.close()


def run(here, *lines, opened=True):
    """Run a program that prints lines, all at once for the world's clock."""
    blocks = [f"DPRNT[{line}]" for line in lines]
    here.run_program("\n".join(["POPEN", *blocks, "PCLOS", "M30"] if opened else [*blocks, "M30"]))
    here.elapse(10.0)


def received(line, count=None):
    """Return bytes until there are ``count``, or until none has arrived for a while."""
    found = b""
    line.settimeout(5.0 if count else QUIET)
    while count is None or len(found) < count:
        try:
            data = line.recv(4096)
        except TimeoutError:
            break
        if not data:
            break
        found += data
    return found


@pytest.mark.parametrize(
    ("params", "expected"),
    [
        ({}, DC2 + b"A\nB\n" + DC4),
        ({"control": "haas"}, DC2 + b"A\rB\r" + DC4),
        ({"control": "haas", "eob": "crlf"}, DC2 + b"A\r\nB\r\n" + DC4),
        ({"eob": "lfcrcr"}, DC2 + b"A\n\r\rB\n\r\r" + DC4),
        ({"percent": 1}, DC2 + b"%\nA\nB\n%\n" + DC4),
        ({"code": "iso"}, DC2 + b"A\nB\n" + DC4),
    ],
)
def test_lines_are_between_the_codes_of_the_port(params, expected):
    with port(**params) as (line, here):
        run(here, "A", "B")
        assert received(line, len(expected)) == expected
        assert received(line) == b""


def test_iso_code_has_even_parity():
    with port(code="iso") as (line, here):
        run(here, "C*/X")
        assert received(line, 7) == DC2 + bytes.fromhex("c3a0afd8") + b"\n" + DC4


def test_a_fanuc_port_that_is_not_open_prints_nothing_and_a_haas_port_is_always_open():
    with port() as (line, here):
        run(here, "A", opened=False)
        assert received(line) == b""
        run(here, "B")
        assert received(line, 4) == DC2 + b"B\n" + DC4
        run(here, "C", opened=False)
        assert received(line) == b""
    simulators.reset()
    with port(control="haas") as (line, here):
        run(here, "A", opened=False)
        assert received(line, 2) == b"A\r"


@pytest.mark.parametrize("stop", [DC3, b"\x93"])
def test_dc3_stops_the_port_and_dc1_restarts_it(stop):
    with port() as (line, here):
        line.sendall(b"ignored" + stop)
        time.sleep(QUIET)
        run(here, "A", "B")
        assert received(line) == b""
        line.sendall(DC1)
        assert received(line, 6) == DC2 + b"A\nB\n" + DC4


def test_a_late_line_is_sent_after_its_delay_or_before_the_next_one():
    with port(fault="late", fault_at=1) as (line, here):
        run(here, "A", "B")
        assert received(line, 4) == DC2 + b"A\n" + DC4
        assert received(line) == b""
        run(here, "C")
        assert received(line, 6) == DC2 + b"B\nC\n" + DC4
    simulators.reset()
    with port(fault="late", fault_at=0, late_by=2 * QUIET) as (line, here):
        run(here, "A")
        assert received(line) == DC2 + DC4
        assert received(line, 2) == b"A\n"


def test_a_late_line_is_lost_with_its_connection():
    with port(fault="late") as (line, here):
        run(here, "A")
        assert received(line, 2) == DC2 + DC4
        name = line.getpeername()
        line.close()
        with socket.create_connection(name, timeout=5) as other:
            time.sleep(QUIET)
            run(here, "B")
            assert received(other, 4) == DC2 + b"B\n" + DC4


def test_silence_and_drop_affect_lines():
    with port(fault="silence") as (line, here):
        run(here, "A")
        assert received(line) == b""
    simulators.reset()
    with port(fault="drop", fault_at=0, fault_every=2) as (line, here):
        run(here, "A", "B", "C")
        assert received(line, 4) == DC2 + b"B\n" + DC4


def test_an_invalid_block_stops_the_program_before_its_start():
    with port() as (line, here):
        with raises("machine.print.digits"):
            here.run_program("POPEN\nDPRNT[T#3001[81]]\nPCLOS\nM30")
        here.elapse(10.0)
        assert received(line) == b""


@pytest.mark.parametrize("params", ["control=siemens", "eob=nel", "zeros=space", "code=eia", "percent=2"])
def test_parameters_that_no_port_has_are_refused(params):
    with pytest.raises(InstrumentError, match=params.partition("=")[0]):
        SimulatedPrinter(parse_address(f"sim://cframe/printer?{params}"))
