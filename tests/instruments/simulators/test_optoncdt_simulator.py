"""The simulated optoNCDT on its line, against the manufacturer's manuals."""

import re
import select
import socket
from collections.abc import Iterator

import numpy as np
import pytest
from wire_vectors import Vector, vectors

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.point_lds.optoncdt import SimulatedOptoNCDT
from errormotion.instruments.simulators.point_lds.optoncdt.values import encode, raw_distances
from errormotion.instruments.transports import parse_address

PROMPT = b"\r\n->"


class Terminal:
    """A terminal on the sensor's line."""

    def __init__(self, parameters: str = "", device: str = "X1") -> None:
        self.device = SimulatedOptoNCDT(parse_address(f"sim://cframe/{device}?{parameters or 'seed=0'}"))
        host, port = self.device.url.removeprefix("tcp://").split(":")
        self.line = socket.create_connection((host, int(port)), timeout=5)

    def send(self, data: bytes) -> bytes:
        """Return the answer to some bytes, up to its prompt."""
        self.line.sendall(data)
        answer = b""
        while not answer.endswith(PROMPT):
            answer += self.line.recv(1)
        return answer.removesuffix(PROMPT)

    def ask(self, command: str) -> str:
        """Return the answer to a command."""
        return self.send(command.encode() + b"\r\n").decode()

    def read(self, size: int) -> bytes:
        """Return the next bytes of the data stream."""
        data = b""
        while len(data) < size:
            data += self.line.recv(size - len(data))
        return data

    def silence(self) -> bytes:
        """Return bytes until none has arrived for a while."""
        data = b""
        while select.select([self.line], [], [], 0.2)[0]:
            data += self.line.recv(4096)
        return data

    def blocks(self, count: int, width: int) -> np.ndarray:
        """Return the next blocks of the data stream, shape (block, value); their flags are checked."""
        data = np.frombuffer(self.read(3 * count * width), dtype=np.uint8).reshape(count, width, 3).astype(int)
        assert (data[..., 0] >> 6 == 0b00).all()
        assert (data[..., 1] >> 6 == 0b01).all()
        assert (data[:, 0, 2] >> 6 == 0b10).all()
        assert (data[:, 1:, 2] >> 6 == 0b11).all()
        return (data[..., 0] & 63) | (data[..., 1] & 63) << 6 | (data[..., 2] & 63) << 12

    def close(self) -> None:
        self.line.close()
        self.device.close()


@pytest.fixture
def terminals() -> Iterator[list[Terminal]]:
    opened: list[Terminal] = []
    yield opened
    for each in opened:
        each.close()


@pytest.fixture
def terminal(request: pytest.FixtureRequest, terminals: list[Terminal]) -> Terminal:
    terminals.append(Terminal(getattr(request, "param", "")))
    terminals[0].ask("ECHO OFF")
    return terminals[0]


def old(*settings: str) -> pytest.MarkDecorator:
    """Run a test with an ILD1420 that has these parameters."""
    return pytest.mark.parametrize("terminal", ["&".join(["model=ILD1420", *settings])], indirect=True)


# ---------------------------------------------------------------------- answers


def test_with_echo_on_as_delivered_the_command_precedes_its_answer(terminals: list[Terminal]) -> None:
    terminals.append(Terminal())
    ask = terminals[0].ask
    assert ask("MEASRATE 10") == "MEASRATE 10 ok"
    assert ask("MEASRATE") == "MEASRATE\r\nMEASRATE 10"
    assert ask("MEASRATE 7").splitlines()[0] == "MEASRATE 7"
    assert ask("ECHO OFF") == "ECHO OFF ok"
    assert ask("MEASRATE 20") == ""
    assert ask("MEASRATE") == "MEASRATE 20"


@pytest.mark.parametrize("vector", vectors("optoncdt", "getinfo"), ids=str)
def test_getinfo_agrees_with_the_manual(vector: Vector, terminals: list[Terminal]) -> None:
    model = vector.expected["name"].split("-")[0]
    terminals.append(Terminal(f"model={model}&range={vector.expected['range_mm']}"))
    answer = terminals[0].send(b"GETINFO\r\n")
    assert answer.startswith(b"GETINFO\r\n")
    printed = vector.data.removesuffix(PROMPT).strip()
    other = re.compile(rb"Serial: \d{8}")
    assert other.sub(b"", answer.removeprefix(b"GETINFO\r\n")) == other.sub(b"", printed)


def test_a_line_ends_with_lf_and_may_have_cr(terminal: Terminal) -> None:
    assert terminal.send(b"MEASRATE\n") == terminal.send(b"MEASRATE\r\n") == b"MEASRATE 20"
    assert terminal.send(b"\r\n") == b""
    terminal.line.sendall(b"MEAS")
    assert terminal.send(b"RATE\n") == b"MEASRATE 20"


def test_an_answer_can_be_sent_back_as_a_command(terminal: Terminal) -> None:
    settings = terminal.ask("PRINT").splitlines()
    assert "SYNC NONE TERMOFF" in settings
    for setting in settings:
        if not setting.startswith("OUTTHICK"):
            assert terminal.ask(setting) == "", setting


# ---------------------------------------------------------------------- refusals

UNKNOWN, PARAMETER, COUNT, RANGE, ACCESS = "E01", "E02", "E03", "E05", "E06"


@pytest.mark.parametrize(
    ("command", "error"),
    [
        ("FOO", UNKNOWN),
        ("getinfo", UNKNOWN),
        ("LANGUAGE DE", UNKNOWN),
        ("OUTREDUCEDEVICE NONE", UNKNOWN),
        ("GETINFO ALL", COUNT),
        ("SYNC NONE", COUNT),
        ("SYNC TERMON NONE", PARAMETER),
        ("SYNC none TERMOFF", PARAMETER),
        ("TRIGGER NONE", COUNT),
        ("RESETCNT COUNTER", PARAMETER),
        ("RESETCNT MEASCNT MEASCNT", PARAMETER),
        ("RESETCNT", COUNT),
        ("MEASRATE 49.14", RANGE),
        ("MEASRATE 0.5", RANGE),
        ("MEASRATE FAST", PARAMETER),
        ("MEASRATE 10 20", COUNT),
        ("AVERAGE MOVING 3", RANGE),
        ("AVERAGE MEDIAN 9 9", COUNT),
        ("TRIGGERCOUNT 16384", RANGE),
        ("TRIGGERCOUNT 1.5", RANGE),
        ("OUTADD_RS422 DIST_RAW", PARAMETER),
        ("OUTADD_RS422 NONE COUNTER", COUNT),
        ("OUTTHICK_RS422 THICK12", "E14"),
        ("OUTDIST_RS422 DIST2", "E14"),
        ("TRIGGERSW", "E14"),
        ("MASTERMV MASTER 4.5", RANGE),
        ("MASTERMV MASTER", COUNT),
        ("LOGIN wrong", ACCESS),
        ("PASSWD wrong A A", ACCESS),
        ("OUTPUT ANALOG", PARAMETER),
        ('LOGIN "two words"', ACCESS),
        ("X" * 300, "E11"),
    ],
)
def test_the_2300_refuses(terminal: Terminal, command: str, error: str) -> None:
    before = terminal.ask("PRINT")
    assert terminal.ask(command).startswith(f"{error} ")
    assert terminal.ask("PRINT") == before


@pytest.mark.parametrize(
    ("command", "error"),
    [
        ("FOO", "E210"),
        ("SYNC NONE", "E210"),
        ("SYNC NONE TERMOFF", "E210"),
        ("OUTSTATISTIC_RS422 NONE", "E210"),
        ("RESETCNT TRIGCNT", "E234"),
        ("RESETCNT COUNTER", "E234"),
        ("MEASRATE 8", "E236"),
        ("MEASRATE 10", "E236"),
        ("TRIGGER NONE TERMOFF", "E232"),
        ("OUTADD_RS422 TEMP", "E234"),
        ("OUTHOLD 1025", "E236"),
        ("OUTREDUCECOUNT 3000001", "E236"),
        ("OUTPUT ETHERNET", "E234"),
        ("MASTERMV MASTER -1", "E236"),
        ("LANGUAGE FR", "E234"),
        ("LOGIN wrong", "E202"),
        ("\x07", "E204"),
        ("X" * 300, "E214"),
    ],
)
@old()
def test_the_1420_refuses(terminal: Terminal, command: str, error: str) -> None:
    assert terminal.ask(command).startswith(f"{error} ")


def test_bytes_without_a_line_end_are_bounded(terminal: Terminal) -> None:
    terminal.line.sendall(b"A" * 100_000 + b"\n")
    assert terminal.read(4) == b"E11 "
    assert len(terminal.silence()) < 20_000
    assert terminal.ask("MEASRATE") == "MEASRATE 20"


@old("newer=1")
def test_newer_sensors_of_the_1420_measure_at_8_khz(terminal: Terminal) -> None:
    assert terminal.ask("MEASRATE 8") == ""


@pytest.mark.parametrize("terminal", ["user=USER&password=abc"], indirect=True)
def test_changes_of_settings_need_the_level_professional(terminals: list[Terminal], terminal: Terminal) -> None:
    assert terminal.ask("GETUSERLEVEL") == "GETUSERLEVEL USER"
    assert terminal.ask("MEASRATE 10").startswith(ACCESS)
    assert terminal.ask("OUTPUT RS422").startswith(ACCESS)
    assert terminal.ask("MEASRATE") == "MEASRATE 20"
    assert terminal.ask("LOGIN abc") == ""
    assert terminal.ask("MEASRATE 10") == ""
    assert terminal.ask("PASSWD abc NEW OLD").startswith("E36")
    assert terminal.ask("LOGOUT") == ""
    assert terminal.ask("MEASRATE 5").startswith(ACCESS)


def test_a_parameter_of_the_address_that_no_sensor_has_is_reported() -> None:
    for parameters, what in (
        ("model=ILD9999", "model"),
        ("left=SYNC+NONE", "E03"),
        ("left=OUTADD_RS422+FOO", "E02"),
        ("left=FOO", "no such setting"),
    ):
        with pytest.raises(InstrumentError, match=what):
            Terminal(parameters)


# ---------------------------------------------------------------------- values


@pytest.mark.parametrize("vector", vectors("optoncdt", "distance"), ids=str)
def test_a_distance_has_the_bytes_of_the_manual(vector: Vector) -> None:
    span = vector.expected["range_mm"]
    raw = raw_distances(np.array([vector.expected["distance_mm"]]), span, 65519)
    assert raw == [vector.expected["raw"]]
    assert encode(raw[:, np.newaxis]) == vector.data


@pytest.mark.parametrize("vector", vectors("optoncdt", "block"), ids=str)
def test_further_values_of_a_block_are_marked(vector: Vector) -> None:
    assert encode(np.array([vector.expected["values"]])) == vector.data


def test_beyond_the_reserves_there_are_error_values() -> None:
    parts = np.array([-0.011, -0.0099, 0.0, 1.0, 1.0099, 1.011, np.nan, -np.inf, np.inf])
    found = raw_distances(parts, 1.0, 65519)
    assert list(found) == [262077, 6, 642, 64878, 65514, 262078, 262076, 262077, 262078]


def distances(terminal: Terminal, count: int = 50) -> np.ndarray:
    """Return the distances of a stream of distances only, mm of a range of 2 mm."""
    assert terminal.ask("OUTPUT RS422") == ""
    raws = terminal.blocks(count, 1)[:, 0]
    assert ((raws >= 643) & (raws <= 64877)).all()
    return (raws * 1.02 / 65520 - 0.01) * 2.0


def test_the_stream_starts_after_the_answer_and_continues_while_commands_are_answered(terminal: Terminal) -> None:
    distances(terminal)
    terminal.line.sendall(b"GETINFO\r\n")
    data = b""
    while b"Imagetype: User\r\n->" not in data:
        data += terminal.line.recv(4096)
    before, _, rest = data.partition(b"Name: ILD2300")
    assert before
    while not rest.partition(b"->")[2]:
        rest += terminal.line.recv(4096)


def test_the_stream_ends_with_output_none(terminal: Terminal) -> None:
    distances(terminal)
    terminal.line.sendall(b"OUTPUT NONE\r\n")
    data = b""
    while not data.endswith(b"\r\n->"):
        data += terminal.line.recv(4096)
    assert terminal.ask("OUTPUT") == "OUTPUT NONE"


@pytest.mark.parametrize("terminal", ["left=OUTADD_RS422+COUNTER+TIMESTAMP;OUTSTATISTIC_RS422+MAX"], indirect=True)
def test_outputs_of_an_earlier_user_are_listed_and_sent(terminal: Terminal) -> None:
    assert terminal.ask("GETOUTINFO_RS422") == "GETOUTINFO_RS422 COUNTER TIMESTAMP DIST1 MAX"
    assert terminal.ask("MEASRATE 10") == ""
    assert terminal.ask("RESETCNT TIMESTAMP MEASCNT") == ""
    assert terminal.ask("OUTPUT RS422") == ""
    counter, stamp, distance, highest = terminal.blocks(100, 4).T
    assert list(counter) == list(range(100))
    assert list(stamp) == [100 * n // 256 for n in range(100)]
    assert list(highest) == list(np.maximum.accumulate(distance))


@old("left=OUTADD_RS422+STATE+TIMESTAMP+COUNTER")
def test_the_1420_sends_the_distance_first_and_its_time_stamp_in_two_words(terminal: Terminal) -> None:
    assert terminal.ask("GETOUTINFO_RS422") == "GETOUTINFO_RS422 DIST1 STATE COUNTER TIMESTAMP_LO TIMESTAMP_HI"
    assert terminal.ask("RESETCNT TIMESTAMP") == ""
    assert terminal.ask("OUTPUT RS422") == ""
    _, state, counter, low, high = terminal.blocks(2000, 5).T
    assert counter[0] != 0
    assert (np.diff(counter) == 1).all()
    assert (state >> 16 & 3 == 1).all()
    assert list(high * 65536 + low) == [50 * n for n in range(2000)]  # 2 kHz in steps of 10 us


def test_the_counter_continues_between_streams_until_it_is_reset(terminal: Terminal) -> None:
    terminal.ask("OUTADD_RS422 COUNTER")
    starts = []
    for reset in (False, False, True):
        if reset:
            assert terminal.ask("RESETCNT MEASCNT") == ""
        assert terminal.ask("OUTPUT RS422") == ""
        starts.append(int(terminal.blocks(10, 2)[0, 0]))
        terminal.line.sendall(b"OUTPUT NONE\r\n")
        data = b""
        while not data.endswith(b"\r\n->"):
            data += terminal.line.recv(4096)
    assert 0 < starts[0] < starts[1]
    assert starts[2] == 0


def test_a_sensor_that_streams_already_does_so_from_its_first_command_on(terminals: list[Terminal]) -> None:
    terminals.append(Terminal("left=OUTPUT+RS422"))
    line = terminals[-1].line
    line.sendall(b"ECHO\r\n")
    data = b""
    while b"ECHO ON\r\n->" not in data or len(data) < 100:
        data += line.recv(4096)
    line.sendall(b"OUTPUT NONE\r\n")
    while b"OUTPUT NONE ok\r\n->" not in data:
        data += line.recv(4096)


@pytest.mark.parametrize("terminal", ["baudrate=921600"], indirect=True)
def test_values_for_which_the_line_is_too_slow_are_errors(terminal: Terminal) -> None:
    assert terminal.ask("BAUDRATE") == "BAUDRATE 921600"
    distances(terminal)  # 20 kHz, one value: 600 kBd
    terminal.send(b"OUTPUT NONE\r\n")
    terminal.ask("OUTADD_RS422 COUNTER")
    assert terminal.ask("OUTPUT RS422") == ""
    assert (terminal.blocks(10, 2)[:, 1] == 262075).all()


@old("fault=out_of_range&fault_at=10&fault_for=5")
def test_an_earlier_hold_hides_missing_distances(terminal: Terminal) -> None:
    assert terminal.ask("OUTPUT RS422") == ""
    raws = terminal.blocks(30, 1)[:, 0]
    assert (raws[10:15] == 262076).all()
    terminal.send(b"OUTPUT NONE\r\n")
    terminal.ask("OUTHOLD 3")
    assert terminal.ask("OUTPUT RS422") == ""
    raws = terminal.blocks(30, 1)[:, 0]
    assert (raws[10:13] == raws[9]).all()
    assert (raws[13:15] == 262076).all()
    assert raws[15] < 65520


@old("left=OUTREDUCEDEVICE+RS422;OUTREDUCECOUNT+4;OUTADD_RS422+COUNTER")
def test_an_earlier_reduction_leaves_every_fourth_value(terminal: Terminal) -> None:
    terminal.ask("RESETCNT MEASCNT")
    assert terminal.ask("OUTPUT RS422") == ""
    assert list(terminal.blocks(10, 2)[:, 1]) == list(range(0, 40, 4))


def test_averages_smooth_and_a_median_removes_outliers(terminal: Terminal) -> None:
    still = np.std(np.diff(distances(terminal, 4000)))
    terminal.send(b"OUTPUT NONE\r\n")
    assert terminal.ask("AVERAGE MOVING 64") == ""
    assert np.std(np.diff(distances(terminal, 4000))) < 0.5 * still


def test_a_master_value_shifts_and_rescales(terminal: Terminal) -> None:
    assert terminal.ask("MASTERMV MASTER 1.5") == ""
    assert terminal.ask("OUTPUT RS422") == ""
    raws = terminal.blocks(10, 1)[:, 0]
    assert (raws[0] * 1.02 / 65520 - 0.51) * 2.0 == pytest.approx(1.5, abs=2e-5)


def test_without_laser_there_is_no_distance(terminal: Terminal) -> None:
    assert terminal.ask("LASERPOW OFF") == ""
    assert terminal.ask("OUTPUT RS422") == ""
    assert (terminal.blocks(10, 1) == 262082).all()
    terminal.send(b"OUTPUT NONE\r\n")
    assert terminal.ask("MASTERMV MASTER 0") == "E32 Timeout"


def test_a_software_trigger_sends_its_number_of_values(terminal: Terminal) -> None:
    assert terminal.ask("TRIGGER SOFTWARE TERMOFF") == ""
    assert terminal.ask("TRIGGERCOUNT 7") == ""
    assert terminal.ask("OUTPUT RS422") == ""
    assert terminal.ask("OUTPUT") == "OUTPUT RS422"  # nothing in between
    terminal.line.sendall(b"TRIGGERSW\r\n")
    data = terminal.read(len(PROMPT) + 21)
    assert data.startswith(PROMPT) or data.endswith(PROMPT)
    assert terminal.ask("TRIGGER NONE TERMOFF") == ""
    terminal.blocks(100, 1)
