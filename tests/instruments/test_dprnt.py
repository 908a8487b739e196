"""Contacts that the machine prints: lines, assignment to touches, and all kinds of loss."""

import math
import re
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from armed import CONTROLLER
from coded import raises
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.simulators import world
from errormotion.instruments.touch_probe.dprnt import Dprnt, DprntSettings
from errormotion.instruments.touch_probe.dprnt.codec import (
    PATTERN,
    Line,
    format_line,
    from_iso_code,
    parse_line,
    text_of,
)
from errormotion.instruments.touch_probe.dprnt.matching import REPEATED, contact_of, touch_of
from errormotion.instruments.transports.loopback.serving import TcpServer
from errormotion.kinematics.fits import fit_sphere
from errormotion.plugins import Contact, Touch

ADDRESS = "sim://cframe/printer?seed=3"
QUICK = DprntSettings(timeout=0.3, start_timeout=0.3)
COMPILED = re.compile(PATTERN)
NORMALS = ((1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0), (0, 0, 1))
#: along X at Y = 0, 10 mm, ... 40 mm: from X = 0 to 3 mm
TOUCHES = [Touch((0.0, 0.01 * k, 0.0), (3e-3, 0.01 * k, 0.0), k) for k in range(5)]


def printed(k: int, x: float = 2.0, number: int | None = None) -> str:
    return ("" if number is None else f"N{number} ") + f"X{x:.3f} Y{10 * k:.3f} Z0.000"


# ---------------------------------------------------------------------- codec


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("X1.500 Y-2.250 Z0.125", Line((1.5e-3, -2.25e-3, 0.125e-3))),
        ("N12 X   12.345 Y -  3.210 Z  100.000 T   45210", Line((12.345e-3, -3.21e-3, 0.1), 12, 45.21)),
        ("N7X1.Y2.Z.5", Line((1e-3, 2e-3, 0.5e-3), 7)),
        ("B1 X1.0 Y2.0 Z3.0", Line((1e-3, 2e-3, 3e-3))),
    ],
)
def test_lines_are_read_as_controls_print_them(text: str, line: Line) -> None:
    found = parse_line(text, COMPILED)
    assert found.position == pytest.approx(line.position, abs=1e-15)
    assert found.number == line.number
    assert found.time == pytest.approx(line.time, nan_ok=True)


@pytest.mark.parametrize("vector", vectors("dprnt", "line"), ids=str)
def test_lines_after_the_manual_of_haas(vector: Vector) -> None:
    found = parse_line(text_of(vector.data), re.compile(vector.expected.get("pattern", PATTERN)))
    assert found.position == pytest.approx([value * 1e-3 for value in vector.expected["position"]], abs=1e-15)
    assert found.number == vector.expected.get("number")
    assert found.time == pytest.approx(vector.expected.get("time", math.nan), nan_ok=True)


@given(
    st.tuples(*[st.integers(-(10**7), 10**7)] * 3),
    st.none() | st.integers(0, 99999),
    st.none() | st.integers(0, 10**8),
)
def test_lines_round_trip(micrometres: tuple[int, int, int], number: int | None, ms: int | None) -> None:
    x, y, z = (value * 1e-6 for value in micrometres)
    line = Line((x, y, z), number, math.nan if ms is None else ms * 1e-3)
    found = parse_line(format_line(line), COMPILED)
    assert found.position == pytest.approx(line.position, abs=1e-12)
    assert found.number == line.number
    assert found.time == pytest.approx(line.time, nan_ok=True)


@pytest.mark.parametrize(
    "text", ["X1 Y2", "X1 Y2 Z", "Y2 X1 Z3", "X1 Y2 Z3 junk", "?N1 X1 Y2 Z3", "X1,5 Y2 Z3", "X1..5 Y2 Z3", "N X1 Y2 Z3"]
)
def test_anything_else_is_a_protocol_error(text: str) -> None:
    with raises("protocol.touch.form"):
        parse_line(text, COMPILED)


@given(st.text(max_size=60))
def test_any_invalid_text_is_a_protocol_error(text: str) -> None:
    try:
        parse_line(text, COMPILED)
    except ProtocolError:
        return
    assert text.count("X") == 1


def test_control_characters_around_lines_are_no_part_of_them() -> None:
    assert text_of(b"\x12%\r\n") == ""
    assert text_of(b"\x00X1 Y2 Z3\r\n") == "X1 Y2 Z3"
    with raises("protocol.text.form"):
        text_of(b"X1\xff Y2\r\n")


def test_a_custom_pattern_must_name_the_coordinates() -> None:
    pattern = r"P(?P<number>\d+);(?P<x>[-\d.]+);(?P<y>[-\d.]+);(?P<z>[-\d.]+)"
    line = parse_line("P3;1;-2;3", re.compile(DprntSettings(pattern=pattern).pattern), length=25.4e-3)
    assert line.position == pytest.approx((25.4e-3, -50.8e-3, 76.2e-3))
    assert line.number == 3
    with pytest.raises(ValueError, match="missing z"):
        DprntSettings(pattern="(?P<x>.)(?P<y>.)")
    with pytest.raises(ValueError, match="regular expression"):
        DprntSettings(pattern="(?P<x>")


# ---------------------------------------------------------------------- assignment to touches


def belongs(text: str, due: int, last: str = "") -> int:
    before = parse_line(last, COMPILED) if last else None
    return touch_of(parse_line(text, COMPILED), TOUCHES, due, before, 1, 1e-3)


def test_without_numbers_the_position_decides() -> None:
    assert belongs(printed(0), 0) == 0
    assert belongs(printed(3), 1, printed(0)) == 3  # two lines are missing
    assert belongs(printed(0), 1, printed(0)) == REPEATED
    assert belongs(printed(0, 2.001), 4, printed(3)) == 0  # the next cycle has started
    with raises("touch.path.none"):
        belongs(printed(5).replace("50.", "55."), 0)


def test_numbers_decide_and_continue_or_restart_between_cycles() -> None:
    assert belongs(printed(2, number=3), 0) == 2
    assert belongs(printed(2, number=13), 0) == 2
    assert belongs(printed(0, number=1), 1, printed(0, number=1)) == REPEATED
    with raises("touch.path.other"):
        belongs(printed(0, number=2), 0)


@pytest.mark.parametrize(
    ("x", "flag"), [(2.0, ""), (3.0, "no trip"), (2.997, "no trip"), (0.0, "tripped at the start"), (0.3, "")]
)
def test_the_position_shows_the_result_of_the_touch(x: float, flag: str) -> None:
    contact = contact_of(parse_line(printed(0, x), COMPILED), TOUCHES[0], 0.2e-3, 5e-6)
    assert contact.flag == flag
    assert math.isnan(contact.position[0]) == bool(flag)


# ---------------------------------------------------------------------- a scripted machine


class Machine:
    """The far end of the line."""

    def __init__(self) -> None:
        self.server = TcpServer("dprnt", lambda data: None)
        self.server.start()

    def say(self, *lines: str | bytes) -> None:
        assert self.server.await_connection(5.0)
        self.server.send(b"".join(each if isinstance(each, bytes) else each.encode() + b"\r\n" for each in lines))


@pytest.fixture
def machine() -> Iterator[Machine]:
    made = Machine()
    yield made
    made.server.close()


@pytest.mark.parametrize(("line_end", "end"), [("cr", b"\r"), ("lf", b"\n"), ("lf", b"\r\n"), ("lf", b"\n\r\r")])
def test_lines_end_as_set(machine: Machine, line_end: str, end: bytes) -> None:
    settings = DprntSettings(timeout=2.0, start_timeout=2.0, line_end=line_end)
    with Dprnt(machine.server.url, settings) as probe:
        machine.say(*(printed(k).encode() + end for k in range(2)))
        found = [each.position for each in probe.measure(TOUCHES[:2])]
    assert found == [pytest.approx((2e-3, 0.01 * k, 0.0)) for k in range(2)]


@pytest.fixture
def probe(machine: Machine) -> Iterator[Dprnt]:
    with Dprnt(machine.server.url, QUICK) as made:
        yield made


def flags(contacts: Sequence[Contact]) -> list[str]:
    return [contact.flag for contact in contacts]


def test_contacts_are_in_the_order_of_the_touches(machine: Machine, probe: Dprnt) -> None:
    machine.say(b"\x12%\r\n", *(printed(k, 2.0 + 0.001 * k) + f" T{1000 * k}" for k in range(5)), b"%\x14")
    contacts = list(probe.measure(TOUCHES))
    np.testing.assert_allclose([contact.position[0] for contact in contacts], 2e-3 + 1e-6 * np.arange(5))
    assert [contact.time for contact in contacts] == [0.0, 1.0, 2.0, 3.0, 4.0]
    assert flags(contacts) == [""] * 5
    assert probe.read()["contacts"] == 5


@pytest.mark.parametrize("numbered", [False, True])
def test_lost_and_repeated_lines_only_cost_their_own_touches(machine: Machine, probe: Dprnt, numbered: bool) -> None:
    lines = [printed(k, number=k + 1 if numbered else None) for k in (0, 0, 1, 3, 4)]
    machine.say(*lines)
    contacts = list(probe.measure(TOUCHES))
    assert flags(contacts) == ["", "", "not made", "", ""]
    assert math.isnan(contacts[2].position[0])
    assert (probe.repeated, probe.missing, probe.unreadable) == (1, 1, 0)


@pytest.mark.parametrize("numbered", [False, True])
def test_a_cycle_whose_end_was_lost_ends_at_the_start_of_the_next_one(
    machine: Machine, probe: Dprnt, numbered: bool
) -> None:
    first = [printed(k, number=k + 1 if numbered else None) for k in range(3)]
    second = [printed(k, 2.5, number=k + 6 if numbered else None) for k in range(5)]
    machine.say(*first, *second)
    assert flags(list(probe.measure(TOUCHES))) == ["", "", "", "not made", "not made"]
    contacts = list(probe.measure(TOUCHES))
    assert flags(contacts) == [""] * 5
    assert contacts[0].position[0] == pytest.approx(2.5e-3)


def test_unreadable_lines_are_counted_and_skipped(machine: Machine, probe: Dprnt) -> None:
    machine.say(
        printed(0), b"\xfe\xff X\r\n", "ALARM 401", printed(1), b"X2.0" + printed(2).encode() + b"\r\n", printed(3)
    )
    machine.say(printed(4))
    assert flags(list(probe.measure(TOUCHES))) == ["", "", "not made", "", ""]
    assert probe.unreadable == 3


def test_only_unreadable_lines_are_an_error(machine: Machine, probe: Dprnt) -> None:
    machine.say(printed(0), *[b"\xfe\xff\n"] * 11)
    source = probe.measure(TOUCHES)
    assert next(source).flag == ""
    with raises("protocol.lines.unreadable"):
        next(source)


def test_silence_names_the_touch_and_keeps_the_contacts(machine: Machine, probe: Dprnt) -> None:
    machine.say(printed(0), printed(1))
    source = probe.measure(TOUCHES)
    assert flags([next(source), next(source)]) == ["", ""]
    with pytest.raises(InstrumentTimeoutError, match=r"Touch 3 of 5 \(item 2\): no line for 0\.3 s"):
        next(source)
    assert probe.read()["contacts"] == 2


def test_a_lost_connection_is_an_error(machine: Machine, probe: Dprnt) -> None:
    machine.say(printed(0))
    source = probe.measure(TOUCHES)
    assert next(source).flag == ""
    machine.server.disconnect()
    with pytest.raises(InstrumentError, match=r"Touch 2 of 5 .* is lost"):
        next(source)


def test_a_probe_that_did_not_trip_or_was_tripped_is_flagged(machine: Machine, probe: Dprnt) -> None:
    machine.say(printed(0, 3.0), printed(1, 0.0), printed(2), printed(3), printed(4))
    assert flags(list(probe.measure(TOUCHES))) == ["no trip", "tripped at the start", "", "", ""]


# ---------------------------------------------------------------------- the virtual machine


def ball_touches(item: int = 0) -> list[Touch]:
    machine = world("cframe", 3).machine
    reach = machine.balls.nominal_radius + machine.probe.nominal_tip_radius
    return [
        Touch(*(tuple(machine.balls.nominal[item] + (reach + way) * np.array(n)) for way in (2e-3, -1e-3)), item)
        for n in NORMALS
    ]


def program(touches: Sequence[Touch]) -> str:
    """Return a program that makes touches and prints them, from above each time."""
    lines = ["(touch a ball)", "G21 G90 G94 F3000", "POPEN"]
    for number, touch in enumerate(touches, 1):
        (x, y, z), target = (np.array(touch.start) * 1e3, np.array(touch.target) * 1e3)
        lines += [f"G0 Z{z + 40:.4f}", f"G0 X{x:.4f} Y{y:.4f}", f"G0 Z{z:.4f}"]
        lines.append(f"G31 X{target[0]:.4f} Y{target[1]:.4f} Z{target[2]:.4f} F30")
        lines.append(f"DPRNT[N{number}*X#5061[53]*Y#5062[53]*Z#5063[53]*T#3001[80]]")
        lines.append(f"G1 X{x:.4f} Y{y:.4f} Z{z:.4f} F3000")
    return "\n".join([*lines, "PCLOS", f"G0 Z{z + 40:.4f}", "M30"])


def run(
    address: str, settings: DprntSettings = QUICK, fault: str = ""
) -> tuple[Dprnt, list[Contact], Exception | None]:
    """Run a program on the machine; return the result of the listening driver."""
    contacts: list[Contact] = []
    raised = None
    with (
        Dprnt(address, settings) as probe,
        VirtualController(f"sim://cframe/controller?seed=3{fault}", CONTROLLER) as control,
    ):
        begun = control.run_program(program(ball_touches()))
        control.elapse(begun["duration"] + begun["longest_lead_in"])
        try:
            for contact in probe.measure(ball_touches()):
                contacts.append(contact)
        except InstrumentError as error:
            raised = error
    return probe, contacts, raised


@pytest.mark.parametrize("wire", ["pty", "tcp"])
def test_the_machine_prints_and_the_ball_is_found(wire: str) -> None:
    machine = world("cframe", 3).machine
    _, contacts, raised = run(f"{ADDRESS}&wire={wire}")
    assert raised is None
    assert flags(contacts) == [""] * 5
    assert all(contact.time > 0 for contact in contacts)
    ball = fit_sphere(np.array([contact.position for contact in contacts]))
    true = machine.balls.centre[0] - machine.probe_error(ball.centre, 0.0)[0]
    # printed to 1 um, tripped to 0.25 um, lobes and form of 2 um
    np.testing.assert_allclose(ball.centre, true, atol=5e-6)


@pytest.mark.parametrize(
    ("port", "settings"),
    [
        ("zeros=none", {}),
        ("eob=lfcrcr&percent=1", {}),
        ("code=iso", {"code": "iso"}),
        ("control=haas", {"line_end": "cr"}),
        ("control=haas&eob=crlf", {}),
        ("control=haas&code=iso&percent=1", {"line_end": "cr", "code": "iso"}),
    ],
)
def test_lines_of_all_controls_are_read(port: str, settings: dict[str, str]) -> None:
    _, contacts, raised = run(ADDRESS)
    probe, found, raised_too = run(f"{ADDRESS}&{port}", DprntSettings(timeout=0.3, start_timeout=0.3, **settings))
    assert (raised, raised_too, flags(found), probe.unreadable) == (None, None, [""] * 5, 0)
    for one, other in zip(contacts, found, strict=True):
        assert other.position == pytest.approx(one.position, abs=2.5e-6)  # of another touch: rounding and scatter


def test_iso_code_shows_damaged_characters() -> None:
    assert from_iso_code(bytes.fromhex("c3a0afd8")) == b"C /X"
    with raises("protocol.text.parity"):
        from_iso_code(b"C /X")
    probe, contacts, raised = run(f"{ADDRESS}&code=iso", DprntSettings(timeout=0.3, start_timeout=0.3))
    assert isinstance(raised, InstrumentTimeoutError)
    assert probe.unreadable == 5
    assert contacts == []


@pytest.mark.parametrize("late", [2, 4])
def test_late_lines_of_a_cycle_are_not_touches_of_the_next_one(late: int) -> None:
    touches = ball_touches()
    address = f"{ADDRESS}&fault=late&fault_at={late}&late_by=0.5"
    with Dprnt(address, QUICK) as probe, VirtualController("sim://cframe/controller?seed=3", CONTROLLER) as control:
        begun = control.run_program(program(touches))
        here = world("cframe", 3)
        blocks = [when for when, order in here.port_output if not isinstance(order, str)]
        control.elapse(blocks[late] - here.time + 0.01)  # up to the line that is late
        with pytest.raises(InstrumentTimeoutError, match=f"Touch {late + 1} of 5"):
            list(probe.measure(touches))
        control.elapse(begun["duration"] + begun["longest_lead_in"])
        second = here.time
        control.run_program(program(touches))
        time.sleep(0.5)
        control.elapse(begun["duration"] + begun["longest_lead_in"])
        contacts = list(probe.measure(touches))
        assert flags(contacts) == [""] * 5
        assert all(contact.time > second for contact in contacts)
        assert (probe.late, probe.missing) == (5 - late, 0)


@pytest.mark.parametrize(
    ("fault", "expected", "counts"),
    [
        ("split", [""] * 5, (0, 0, 0)),
        ("duplicate&fault_every=2", [""] * 5, (0, 2, 0)),
        ("drop&fault_at=2&fault_every=100", ["", "", "not made", "", ""], (0, 0, 1)),
        ("garbage&fault_at=2&fault_every=100", ["", "", "not made", "", ""], (1, 0, 1)),
    ],
)
def test_faults_of_the_line_that_cost_a_touch_at_most(
    fault: str, expected: list[str], counts: tuple[int, int, int]
) -> None:
    probe, contacts, raised = run(f"{ADDRESS}&fault={fault}")
    assert raised is None
    assert flags(contacts) == expected
    assert (probe.unreadable, probe.repeated, probe.missing) == counts


@pytest.mark.parametrize(
    ("fault", "wire", "error"),
    [
        ("silence", "pty", InstrumentTimeoutError),
        ("disconnect", "pty", InstrumentTimeoutError),
        ("disconnect", "tcp", InstrumentError),
    ],
)
def test_silence_of_a_line_keeps_the_contacts(fault: str, wire: str, error: type[InstrumentError]) -> None:
    _, contacts, raised = run(f"{ADDRESS}&wire={wire}&fault={fault}&fault_at=3")
    assert isinstance(raised, error)
    assert "Touch 4 of 5 (item 0)" in str(raised)
    assert flags(contacts) == ["", "", ""]


def test_a_probe_that_never_trips_is_flagged() -> None:
    _, contacts, raised = run(ADDRESS, fault="&fault=no_trip")
    assert raised is None
    assert flags(contacts) == ["no trip"] * 5


def test_a_recorded_session_plays_back(tmp_path: Path) -> None:
    path = tmp_path / "printer.rec"
    with (
        Dprnt(ADDRESS, QUICK, record=path) as probe,
        VirtualController("sim://cframe/controller?seed=3", CONTROLLER) as control,
    ):
        begun = control.run_program(program(ball_touches()))
        control.elapse(begun["duration"] + begun["longest_lead_in"])
        orders = ball_touches()
        contacts = list(probe.measure(orders))
    with Dprnt(f"replay://{path}", QUICK) as probe:
        assert list(probe.measure(orders)) == contacts


def test_lines_sent_before_the_driver_opened_are_lost() -> None:
    with VirtualController("sim://cframe/controller?seed=3", CONTROLLER) as control:
        begun = control.run_program(program(ball_touches()))
        control.elapse(begun["duration"] + begun["longest_lead_in"])
        with Dprnt(ADDRESS, QUICK) as probe, pytest.raises(InstrumentTimeoutError, match="Touch 1 of 5"):
            next(probe.measure(ball_touches()))
