"""The simulated confocalDT 24x1 on its lines: dialogues of the manual, refusals, and blocks."""

import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from data_port_client import DataPortClient

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators import world
from errormotion.instruments.simulators.point_lds.confocaldt import SimulatedConfocal
from errormotion.instruments.transports import parse_address

HEADER = struct.Struct("<4sIIIIHHI")
NO_PEAK = 0x7FFFFFFB


class Client(DataPortClient):
    def answer(self) -> str:
        """Return the text before the next prompt."""
        return self.text(b"\r\n->")

    def ask(self, command: str) -> str:
        self.send(command + "\n")
        return self.answer()

    def block(self) -> tuple[int, tuple[int, int], np.ndarray]:
        """Return counter, flags and frames of the next block."""
        preamble, article, serial, first, second, width, count, counter = HEADER.unpack(self.exactly(HEADER.size))
        assert (preamble, article, serial) == (b"SAEM", 2418004, self.device.serial)
        return counter, (first, second), np.frombuffer(self.exactly(width * count), "<i4").reshape(count, -1)


def simulated(parameters: str = "", left: str = "ECHO OFF") -> Client:
    left = left.replace(" ", "%20")
    return Client(SimulatedConfocal(parse_address(f"sim://cframe/X1?seed=3&left={left}{parameters}")))


@contextmanager
def streaming(parameters: str = "", left: str = "ECHO OFF") -> Iterator[Client]:
    with simulated(parameters, left + ";OUTPUT ETHERNET") as client:
        client.open_data()
        yield client


# ---------------------------------------------------------------------- commands


@pytest.mark.parametrize(
    ("command", "answer"),
    [
        ("OUTPUT", "OUTPUT NONE"),
        ("OUTPUT RS422", ""),  # p. 92
        ("SYNC SLAVE_EXT", ""),
        ("GETTEMP", "GETTEMP 34.51"),  # p. 96
        ("GETUSERLEVEL", "GETUSERLEVEL PROFESSIONAL"),
        ("SENSORINFO", "Position: 0\r\nName: ifs-2405x\r\nMeasuring range: 3.000 mm\r\nSerial: 12345678"),  # p. 97
        ("SENSORHEAD", "SENSORHEAD 0"),
        ("MEASRATE 0.1", ""),  # p. 102
        ("MEASRATE 10", ""),
        ("SHUTTER 0.125 50", ""),
        ("AVERAGE MOVING 1024", ""),
        ("OUTREDUCE 10 ETHERNET", ""),
        ("OUTADD_ETH STATE COUNTER", ""),
        ("OUTSTATISTIC_ETH PEAK2PEAK MIN", ""),
        ("MEASTRANSFER NONE", ""),
        ('LOGIN "000"', ""),
        ("", ""),
    ],
)
def test_commands_of_the_manual_are_answered(command: str, answer: str) -> None:
    with simulated("&range=3") as client:
        assert client.ask(command) == answer


@pytest.mark.parametrize(
    ("command", "error"),
    [
        ("OUTPUTS", "E01"),
        ("output NONE", "E01"),
        ("GETINFO\x07", "E01"),
        ("SYNC ALWAYS", "E02"),  # p. 96
        ("SYNC none", "E02"),
        ("GETTEMP 1", "E03"),
        ("LOGIN", "E03"),
        ("ROI 5", "E03"),
        ("LOGIN 123", "E06"),
        ("LOGIN " + 32 * "x", "E11"),
        ("SYNC " + 32 * "x", "E11"),
        ("SENSORHEAD 5", "E39"),  # p. 97
        ("SENSORHEAD 20", "E05"),
        ("MEASRATE 10.1", "E05"),
        ("MEASRATE 0.25", "E05"),  # one decimal place
        ("MEASRATE fast", "E02"),
        ("SHUTTER 20000", "E05"),
        ("ROI 511 0", "E05"),
        ("OUTDIST_ETH NONE", "E14"),  # p. 106
        ("OUTTHICK_ETH THICK12", "E14"),
        ("OUTADD_ETH NONE STATE", "E03"),
        ("OUTADD_ETH STATE STATE", "E02"),
        ("OUTREDUCE 1001", "E05"),
        ("MASTERMV MASTER 3.1", "E05"),  # p. 105
        ("MASTERMV MASTER 1", "E32"),
        ("MEASTRANSFER SERVER/TCP 80", "E05"),
        ("PASSWD 000 a b", "E36"),
        (300 * "X", "E11"),
    ],
)
def test_commands_that_are_not_in_the_manual_are_refused(command: str, error: str) -> None:
    with simulated("&range=3") as client:
        assert client.ask(command).startswith(error + " ")
        assert client.ask("OUTPUT") == "OUTPUT NONE"


def test_models_have_their_rates() -> None:
    with simulated("&model=IFC2471") as client:
        assert client.ask("GETINFO").startswith("Name: IFC2471\r\nSerial: 11020003\r\n")
        assert client.ask("MEASRATE 70") == ""
        assert client.ask("MEASRATE 0.1").startswith("E05")
    with pytest.raises(InstrumentError, match="IFC2451, IFC2461, IFC2471"):
        SimulatedConfocal(parse_address("sim://cframe/X1?model=IFC2421"))


def test_reading_only_as_user() -> None:
    with simulated("&user=USER") as client:
        assert client.ask("MEASRATE") == "MEASRATE 1.0"
        assert client.ask("MEASRATE 2.5").startswith("E06")
        assert client.ask("LOGIN 000") == ""
        assert client.ask("MEASRATE 2.5\r") == ""
        assert client.ask("MEASRATE") == "MEASRATE 2.5"


def test_with_echo_the_command_precedes_its_answer() -> None:
    with simulated(left="") as client:
        assert client.ask("MEASRATE") == "MEASRATE\r\nMEASRATE 1.0"
        assert client.ask("MEASRATE 2.5") == "MEASRATE 2.5 ok"


def test_every_setting_can_be_sent_back_as_it_was_answered() -> None:
    with simulated() as client:
        for line in client.ask("PRINT").split("\r\n"):
            assert client.ask(line) == ""


def test_the_data_port_is_reported() -> None:
    with simulated() as client:
        assert client.ask("MEASTRANSFER") == f"MEASTRANSFER SERVER/TCP {client.device.port}"


# ---------------------------------------------------------------------- values


def test_values_are_those_of_the_virtual_machine() -> None:
    with streaming() as client:
        counter, flags, frames = client.block()
        truth = world("cframe", 3).machine.distances(0, len(frames), 1000.0, ["X1"])[0]
        following, _, _ = client.block()
    assert flags == (1 << 18 | 1 << 19, 6 << 28)
    assert following == counter + len(frames)
    np.testing.assert_allclose(frames[:, 0] * 1e-9, truth, rtol=0, atol=0.501e-9)


def test_further_values_have_the_positions_of_the_manual() -> None:
    chosen = "OUTADD_ETH STATE INTENSITY TIMESTAMP COUNTER ENC1 MEASRATE SHUTTER;OUTSTATISTIC_ETH MAX MIN"
    with streaming(left=f"ECHO OFF;MEASRATE 2.5;{chosen}") as client:
        counter, (first, second), frames = client.block()
    assert first == 1 << 7 | 1 << 8 | 1 << 11 | 1 << 12 | 1 << 15 | 1 << 18 | 1 << 19 | 1 << 26
    assert second == 5 << 28 | 1 << 15 | 1 << 16
    assert frames.shape[1] == 10
    assert (frames[:, 0] == 4000).all()  # 100 us
    assert (frames[:, 1] == 16000).all()  # 40 MHz / 2.5 kHz
    np.testing.assert_array_equal(frames[:, 3], counter + np.arange(len(frames)))
    assert (np.diff(frames[:, 4]) == 400).all()
    assert (frames[:, 6] & 0x7FF == 512).all()
    assert (frames[:, 7] == 0).all()
    np.testing.assert_array_equal(frames[:, 8], np.minimum.accumulate(frames[:, 5]))
    np.testing.assert_array_equal(frames[:, 9], np.maximum.accumulate(frames[:, 5]))


def test_nothing_is_sent_until_output_is_ethernet() -> None:
    with simulated() as client:
        client.open_data()
        assert client.quiet()
        assert client.ask("OUTPUT ETHERNET") == ""
        assert len(client.block()[2]) > 0
        assert client.ask("OUTPUT NONE") == ""
        client.quiet()
        assert client.quiet()


def test_settings_change_with_a_new_header() -> None:
    with streaming() as client:
        assert client.block()[1][1] >> 28 == 6
        assert client.ask("MEASRATE 5") == ""
        deadline = time.monotonic() + 5.0
        while client.block()[1][1] >> 28 != 4:
            assert time.monotonic() < deadline


def test_outside_the_range_there_are_error_values() -> None:
    with streaming("&range=0.1", "ECHO OFF;OUTADD_ETH STATE") as client:
        frames = client.block()[2]
    assert (frames[:, 0] == 0x7FFFFFF9).all()
    assert (frames[:, 1] == 1 << 6).all()


def test_averages_smooth() -> None:
    spreads = {}
    for kind in ("NONE", "MOVING 8", "RECURSIVE 8", "MEDIAN 9"):
        with streaming(left=f"ECHO OFF;AVERAGE {kind}") as client:
            frames = np.concatenate([client.block()[2] for _ in range(3)])
            spreads[kind] = float(np.diff(frames[:, 0].astype(float)).std())
    assert max(spreads[kind] for kind in spreads if kind != "NONE") < spreads["NONE"] / 2


def test_reduction_omits_values() -> None:
    with streaming(left="ECHO OFF;OUTADD_ETH COUNTER;OUTREDUCE 10") as client:
        frames = np.concatenate([client.block()[2] for _ in range(3)])
    assert (np.diff(frames[:, 0]) == 10).all()


def test_mastering_sets_the_present_value() -> None:
    with streaming() as client:
        client.block()
        assert client.ask("MASTERMV MASTER 0.5") == ""
        assert client.ask("MASTERMV") == "MASTERMV MASTER 0.5"
    with streaming(left="ECHO OFF;MASTERMV MASTER 0.5") as client:
        assert client.block()[2][0, 0] == 500_000


# ---------------------------------------------------------------------- faults


def test_missing_frames_show_in_the_counter() -> None:
    with streaming("&fault=drop&fault_at=100&fault_every=1000") as client:
        blocks = [client.block() for _ in range(2)]
    assert len(blocks[0][2]) == 100
    assert blocks[1][0] == blocks[0][0] + 101


def test_a_missing_target_is_no_peak() -> None:
    with streaming("&fault=out_of_range&fault_at=10&fault_for=5", "ECHO OFF;OUTADD_ETH STATE") as client:
        frames = client.block()[2]
    assert np.flatnonzero(frames[:, 0] == NO_PEAK).tolist() == [10, 11, 12, 13, 14]
    assert np.flatnonzero(frames[:, 1]).tolist() == [10, 11, 12, 13, 14]


def test_silence_ends_values_and_answers() -> None:
    with streaming("&fault=silence&fault_at=50") as client:
        assert len(client.block()[2]) == 50
        assert client.quiet()
        client.commands.settimeout(0.2)
        client.send("GETINFO\n")
        with pytest.raises(TimeoutError):
            client.commands.recv(1)


def test_stray_bytes_precede_a_block() -> None:
    with streaming("&fault=garbage") as client:
        assert client.data is not None
        start = client.exactly(9)
    assert 1 <= start.index(b"SAEM") <= 5


def test_pieces_make_a_block() -> None:
    with streaming("&fault=split") as client:
        assert len(client.block()[2]) > 0
        assert client.ask("OUTPUT") == "OUTPUT ETHERNET"


def test_the_data_port_can_be_opened_again() -> None:
    with streaming("&fault=disconnect&fault_at=20") as client:
        assert len(client.block()[2]) == 20
        with pytest.raises(ConnectionError):
            client.exactly(1)
        client.open_data()
        assert len(client.block()[2]) == 20


def test_a_late_answer_precedes_the_next_one() -> None:
    with simulated("&fault=late&fault_at=0") as client:
        client.send("GETTEMP\n")
        client.send("OUTPUT\n")
        assert client.answer() == "GETTEMP 34.51"
        assert client.answer() == "OUTPUT NONE"
