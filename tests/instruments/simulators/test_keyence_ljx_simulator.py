"""The simulated LJ-X8000A, with the bytes that the manufacturer's Linux library sends and the positions it reads.

Source of the sequences: LJX8_IF_Linux.cpp, LJXA_ACQ.cpp and ProfileDataConvert.cpp of the manufacturer's library 1.0.0;
of the return codes: the manufacturer's sample application for LJ-X8000A.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from errormotion.instruments.simulators.line_profiler.keyence_ljx import SimulatedLJX
from errormotion.instruments.transports import parse_address

MAGIC = 0xFFFFFFFF


class MakersClient:
    """The calls of the manufacturer's library that the tests use, with a socket as in the library."""

    def __init__(self, device: SimulatedLJX) -> None:
        self.device = device
        self.control = self._connect(device.url)
        self.streams: list[socket.socket] = []

    @staticmethod
    def _connect(url: str) -> socket.socket:
        host, _, port = url.removeprefix("tcp://").rpartition(":")
        line = socket.create_connection((host, int(port)), timeout=10)
        line.settimeout(10)
        return line

    def connect_again(self) -> None:
        self.control.close()
        self.control = self._connect(self.device.url)

    def raw(self, frame: bytes) -> bytes:
        """Send bytes; return the reply, whose first four bytes are its length."""
        self.control.sendall(frame)
        head = exactly(self.control, 4)
        return head + exactly(self.control, struct.unpack("<I", head)[0])

    def command(self, data: bytes) -> bytes:
        """The call myAnyCommand: return the reply after the checks common to all replies."""
        frame = struct.pack("<I4sII", 16 + len(data) - 4, bytes.fromhex("0300F000"), 0, len(data)) + data
        answer = self.raw(frame)
        assert struct.unpack_from("<I", answer, 12)[0] == len(answer) - 16
        assert answer[16] == data[0]
        return answer

    def code(self, data: bytes) -> int:
        """Return the result of the library: 0x8000 plus the code, or 0."""
        code = self.command(data)[17]
        return 0x8000 + code if code else 0

    def single(self, opcode: int) -> bytes:
        answer = self.command(bytes([opcode, 0, 0, 0]))
        assert answer[17] == 0
        return answer

    def open_stream(self) -> socket.socket:
        """The call InitializeHighSpeedDataCommunication: another connection; the previous one stays open."""
        self.streams.append(self._connect(self.device.urls["stream"]))
        return self.streams[-1]

    def prestart(self, position: int = 2) -> tuple[bytes, int, int, int]:
        """Return start code, kind, points and unit."""
        answer = self.command(bytes([0x47, 0, 0, 0, position, 0, 0, 0]))
        assert answer[17] == 0
        return answer[32:36], answer[40], *struct.unpack_from("<HH", answer, 44)

    def close(self) -> None:
        for line in [self.control, *self.streams]:
            line.close()


@contextmanager
def client(params: str = "") -> Iterator[MakersClient]:
    device = SimulatedLJX(parse_address(f"sim://cframe/profiler?seed=3{params}"))
    peer = MakersClient(device)
    try:
        yield peer
    finally:
        peer.close()
        device.close()


def exactly(line: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        piece = line.recv(count - len(data))
        assert piece, "the device closed the connection"
        data += piece
    return data


def stream_words(points: int, intensity: bool) -> int:
    """Words of a profile in the stream as SetThreadParamFast counts them."""
    return 7 + -(-20 * points // 32) + (-(-10 * points // 32) if intensity else 0)


def unpacked(profile: bytes, points: int, intensity: bool) -> tuple[list[int], list[int]]:
    """Return heights (steps, signed) and intensities of successive bit fields."""
    bits = int.from_bytes(profile[24:], "little")
    raws = [bits >> 20 * k & 0xFFFFF for k in range(points)]
    light = []
    for k in range(points if intensity else 0):
        low = 20 * points + 20 * (k // 2) + (0 if k % 2 else 10)
        light.append(bits >> low & 0x3FF)
    return [raw - (1 << 20) if raw >> 19 else raw for raw in raws], light


def setting(kind: int, category: int, item: int) -> bytes:
    return bytes([kind, category, item, 0, 0, 0, 0, 0])


def set_setting(level: int, target: bytes, value: bytes) -> bytes:
    """The bytes of SetSetting: 20 kB, whatever the size of the setting."""
    return bytes([0x32, 0, 0, 0, level, 0, 0, 0]) + target + value.ljust(20 * 1024, b"\0")


def get_setting(level: int, target: bytes) -> bytes:
    return bytes([0x31, 0, 0, 0, 0, 0, 0, 0, level, 0, 0, 0]) + target


def get_profile(position: int, number: int, count: int, erase: int = 0, bank: int = 0) -> bytes:
    return struct.pack("<8B2B2xIBB2x", 0x42, *bytes(7), bank, position, number, count, erase)


def get_batch(position: int, batch: int, number: int, count: int, erase: int = 0) -> bytes:
    return struct.pack("<8B2B2xIIBB2x", 0x43, *bytes(7), 0, position, batch, number, count, erase)


def test_get_error_is_answered_byte_by_byte() -> None:
    with client() as peer:
        answer = peer.raw(bytes.fromhex("1000000003 00F000 00000000 04000000 04000000"))
        assert answer == bytes.fromhex("1C00000003 00F000 00000000 10000000 0400000000000000 00000000 00000000")


def test_models_and_serial_numbers_are_where_the_library_reads_them() -> None:
    with client() as peer:
        answer = peer.single(0x06)
        assert answer[28] == 2
        assert answer[44 + 52 : 44 + 52 + 32].rstrip(b"\0") == b"LJ-X8060"
        assert answer[44 + 32 : 44 + 48].rstrip(b"\0").isdigit()
        assert answer[44 + 32 + 52 : 44 + 48 + 52].startswith(b"H")
        assert len(answer) == 44 + 2 * 52


@pytest.mark.parametrize(
    "opcode", [0x04, 0x06, 0x27, 0x2B, 0x34, 0x37, 0x48, 0x4B, 0x4C, 0x4F, 0x65], ids=lambda opcode: f"{opcode:02X}"
)
def test_commands_without_parameters_are_answered_and_refuse_parameters(opcode: int) -> None:
    with client() as peer:
        peer.single(opcode)
        assert peer.code(bytes([opcode, 0, 0, 0, 0, 0, 0, 0])) == 0x8032


@pytest.mark.parametrize("opcode", [0x05, 0x2A, 0x31, 0x32, 0x33, 0x35, 0x36, 0x39, 0x3D, 0x42, 0x43, 0x47, 0x4E, 0xA0])
def test_commands_with_parameters_refuse_to_be_sent_without(opcode: int) -> None:
    with client() as peer:
        assert peer.code(bytes([opcode, 0, 0, 0])) == 0x8032


def test_commands_of_other_models_are_refused() -> None:
    with client() as peer:
        assert peer.code(bytes([0x07, 0, 0, 0])) == 0x8031
        older = peer.raw(bytes.fromhex("1000000001 00F000 00000000 04000000 04000000"))
        assert older[17] == 0x21  # the model differs
        assert peer.raw(bytes.fromhex("1000000003 00F000 00000000 05000000 04000000"))[17] == 0x32
        peer.single(0x04)


def test_a_frame_longer_than_any_command_ends_the_connection() -> None:
    with client() as peer:
        peer.control.sendall(struct.pack("<I", 1 << 24))
        assert peer.control.recv(1) == b""


def test_programs_change_and_a_wrong_number_is_a_wrong_parameter() -> None:
    with client() as peer:
        assert peer.code(bytes([0x39, 0, 0, 0, 15, 0, 0, 0])) == 0
        assert peer.single(0x65)[24] == 15  # GetActiveProgram
        assert peer.code(bytes([0x39, 0, 0, 0, 16, 0, 0, 0])) == 0x8042
        assert peer.single(0x65)[24] == 15


def test_settings_are_written_read_reflected_and_initialised() -> None:
    with client() as peer:
        sampling = setting(0x10, 0x00, 0x02)
        answer = peer.command(set_setting(1, sampling, bytes([3, 0, 0, 0])))
        assert answer[17] == 0
        assert answer[28:32] == bytes(4)  # no detailed error
        assert peer.command(get_setting(1, sampling))[28:32] == bytes([3, 0, 0, 0])
        assert peer.command(get_setting(2, sampling))[28:32] == bytes([6, 0, 0, 0])  # saved: as before
        assert peer.code(set_setting(0, sampling, bytes([5, 0, 0, 0]))) == 0
        assert peer.command(get_setting(1, sampling))[28] == 3
        assert peer.command(bytes([0x33, 0, 0, 0, 2, 0, 0, 0]))[17] == 0
        assert peer.command(get_setting(2, sampling))[28] == 5
        assert peer.code(set_setting(0, sampling, bytes([9, 0, 0, 0]))) == 0
        assert peer.code(bytes([0x35, 0, 0, 0, 0, 0, 0, 0])) == 0  # RewriteTemporarySetting(1)
        assert peer.command(get_setting(0, sampling))[28] == 5
        assert peer.code(bytes([0x35, 0, 0, 0, 0xFF, 0, 0, 0])) == 0x8042
        assert peer.code(bytes([0x3D, 0, 0, 0, 2, 0, 0, 0, 3, 0, 0, 0])) == 0
        assert peer.command(get_setting(2, sampling))[28] == 6
        assert peer.code(bytes([0x3D, 0, 0, 0, 2, 0, 0, 0, 3, 16, 0, 0])) == 0x8042


@pytest.mark.parametrize(("kind", "size"), [(0x01, 60), (0x02, 20), (0x1F, 10980)])
def test_blocks_of_settings_have_the_sizes_of_the_makers_sample(kind: int, size: int) -> None:
    with client() as peer:
        block = bytes(k % 251 for k in range(size))
        assert peer.code(set_setting(1, setting(kind, 0xFF, 0), block)) == 0
        assert peer.command(get_setting(1, setting(kind, 0xFF, 0)))[28:] == block


@pytest.mark.parametrize(
    "data",
    [
        get_setting(3, setting(0x10, 0, 1)),
        get_setting(1, setting(0x03, 0, 1)),
        get_setting(1, setting(0x20, 0, 1)),
        set_setting(1, setting(0x10, 0, 1), bytes([3])),
        set_setting(1, setting(0x10, 0, 3), bytes([2])),
        set_setting(1, setting(0x10, 0, 0x0A), bytes([0, 0])),
    ],
)
def test_levels_types_and_values_out_of_range_are_refused(data: bytes) -> None:
    with client() as peer:
        assert peer.code(data) == 0x8042


def test_pitch_timer_and_laser_keep_their_settings() -> None:
    with client() as peer:
        assert peer.code(struct.pack("<II", 0x36, 2500)) == 0
        assert struct.unpack_from("<I", peer.single(0x37), 28)[0] == 2500
        assert peer.code(struct.pack("<II", 0x36, 0)) == 0x8042
        assert peer.code(struct.pack("<II", 0x4E, 77)) == 0
        assert struct.unpack_from("<I", peer.single(0x4F), 28)[0] == 77
        assert peer.code(struct.pack("<II", 0x2A, 0)) == 0
        assert peer.code(struct.pack("<II", 0x2A, 2)) == 0x8042


def test_saving_is_reported_as_access_to_the_memory_and_prevents_a_restart() -> None:
    with client() as peer:
        assert peer.code(set_setting(2, setting(0x10, 0, 2), bytes([4]))) == 0
        deadline = time.monotonic() + 5
        while peer.single(0x34)[28]:
            assert time.monotonic() < deadline
        assert peer.code(bytes([0x02, 0, 0, 0])) == 0
        assert peer.control.recv(1) == b""  # it restarts
        peer.connect_again()
        assert peer.command(get_setting(1, setting(0x10, 0, 2)))[28] == 4


def test_the_restart_discards_unsaved_settings() -> None:
    with client() as peer:
        assert peer.code(set_setting(1, setting(0x10, 0, 2), bytes([4]))) == 0
        assert peer.code(bytes([0x02, 0, 0, 0])) == 0
        assert peer.control.recv(1) == b""
        peer.connect_again()
        assert peer.command(get_setting(1, setting(0x10, 0, 2)))[28] == 6


@pytest.mark.parametrize(("points", "intensity"), [(3200, 0), (3200, 1), (300, 1), (600, 1)])
def test_an_acquisition_gives_the_profiles_that_the_library_expects(points: int, intensity: int) -> None:
    with client(f"&points={points}&intensity={intensity}") as peer:
        line = peer.open_stream()
        start, kind, count, unit = peer.prestart()
        assert (bool(kind & 0x40), count, unit) == (bool(intensity), points, 10)
        assert bin(kind & ~0x60).count("1") == 1  # one profile, as GetProfileCount counts
        assert peer.code(bytes([0xA0, 0, 0, 0, 0x47, 0, 0, 0]) + start) == 0
        words = stream_words(points, bool(intensity))
        for number in range(20):
            profile = exactly(line, 4 * words)
            values = struct.unpack(f"<{words}I", profile)
            assert values[-1] == sum(values[:-1]) % (1 << 32)
            assert values[1:3] == (number, 25 * number)
            heights, light = unpacked(profile, points, bool(intensity))
            assert -(1 << 19) + 4 <= min(heights) <= max(heights) < 1 << 19
            assert light == ([100 + k % 800 for k in range(points)] if intensity else [])
        peer.single(0x48)
        assert ends_with_notice(line, 4 * words)


def ends_with_notice(line: socket.socket, size: int) -> bool:
    """Read profiles up to the notice that ends the transmission."""
    while True:
        head = exactly(line, 8)
        magic, kind = struct.unpack("<II", head)
        if magic == MAGIC:
            return bool(kind & 0xFFFF)
        exactly(line, size - 8)


def test_each_acquisition_has_its_own_connection_and_the_previous_one_stays_open() -> None:
    with client("&points=64") as peer:
        size = 4 * stream_words(64, False)
        for k in range(4):
            line = peer.open_stream()
            start, *_ = peer.prestart()
            assert peer.code(bytes([0xA0, 0, 0, 0, 0x47, 0, 0, 0]) + start) == 0
            exactly(line, 10 * size)
            peer.single(0x48)
            if k % 2:  # otherwise the client stops reading, as after a time limit
                assert ends_with_notice(line, size)


def test_a_stream_starts_only_prepared_connected_and_once() -> None:
    with client("&points=64") as peer:
        start, *_ = peer.prestart()
        assert peer.code(bytes([0xA0, 0, 0, 0, 0x47, 0, 0, 0]) + start) == 0x80A0  # no connection
        peer.open_stream()
        assert peer.code(bytes([0xA0, 0, 0, 0, 0x48, 0, 0, 0]) + start) == 0x80A2
        assert peer.code(bytes([0xA0, 0, 0, 0, 0x47, 0, 0, 0]) + b"\xff\xff\xff\xff") == 0x80A3
        assert peer.code(bytes([0x47, 0, 0, 0, 3, 0, 0, 0])) == 0x8042
        assert peer.code(bytes([0x47, 0, 0, 0, 1, 0, 0, 0])) == 0x8081  # nothing is stored yet
        start, *_ = peer.prestart(0)
        peer.single(0x27)
        assert peer.code(bytes([0xA0, 0, 0, 0, 0x47, 0, 0, 0]) + start) == 0x80A4  # cleared since
        start, *_ = peer.prestart()
        assert peer.code(bytes([0xA0, 0, 0, 0, 0x47, 0, 0, 0]) + start) == 0
        assert peer.code(bytes([0xA0, 0, 0, 0, 0x47, 0, 0, 0]) + start) == 0x80A1
        assert peer.code(bytes([0x47, 0, 0, 0, 2, 0, 0, 0])) == 0x80A1
        assert peer.code(bytes([0x39, 0, 0, 0, 1, 0, 0, 0])) == 0x8041


def test_profiles_are_fetched_if_batch_measurement_is_off() -> None:
    with client("&points=300&intensity=1") as peer:
        assert peer.code(bytes([0x22, 0, 0, 0])) == 0x8080
        assert peer.code(get_batch(0, 0, 0, 1)) == 0x8081
        answer = peer.command(get_profile(0, 0, 1))
        current, oldest, top = struct.unpack_from("<III", answer, 28)
        assert (oldest, top, answer[40], answer[48] & 0x40) == (0, current, 1, 0x40)
        points, unit, _, pitch = struct.unpack_from("<HHii", answer, 52)
        assert (points, unit, pitch) == (300, 10, 1250)
        words = 7 + -(-30 * 300 // 32)
        assert len(answer) == 64 + 4 * words
        values = struct.unpack_from(f"<{words}I", answer, 64)
        assert values[1] == current
        heights, light = unpacked(answer[64:], 300, True)
        assert light == [100 + k for k in range(300)]
        assert len(set(heights)) > 100
        assert peer.code(get_profile(2, 10**6, 1)) == 0x8042
        assert peer.code(get_profile(3, 0, 1)) == 0x8042
        assert peer.code(get_profile(0, 0, 0)) == 0x8042
        assert peer.code(get_profile(0, 0, 1, bank=1)) == 0x80A0
        several = peer.command(get_profile(2, 2, 3, erase=1))
        assert struct.unpack_from("<IB", several, 36) == (2, 3)
        assert len(several) == 64 + 3 * 4 * words
        assert struct.unpack_from("<I", peer.command(get_profile(1, 0, 1)), 32)[0] == 5  # 0..4 are erased


def test_batches_run_end_by_themselves_and_are_fetched() -> None:
    with client("&points=64&batch_points=7") as peer:
        assert peer.code(set_setting(1, setting(0x10, 0, 3), bytes([1]))) == 0
        assert peer.code(get_profile(0, 0, 1)) == 0x8081
        assert peer.code(get_batch(0, 0, 0, 1)) == 0x80A0  # none was run
        line = peer.open_stream()
        start, *_ = peer.prestart()
        assert peer.code(bytes([0xA0, 0, 0, 0, 0x47, 0, 0, 0]) + start) == 0
        size = 4 * stream_words(64, False)
        for batch in range(2):
            peer.single(0x22)
            exactly(line, 7 * size)
            assert exactly(line, 8) == struct.pack("<II", MAGIC, 0x10000)  # the batch, not the transmission
            answer = peer.command(get_batch(0, 0, 4, 9))
            numbers = struct.unpack_from("<7IB", answer, 28)
            assert numbers == (batch, 7 | 0x80000000, 0, 7, batch, 7, 4, 3)
            assert struct.unpack_from("<H", answer, 68)[0] == 64
            assert len(answer) == 80 + 3 * size
        assert struct.unpack_from("<I", peer.command(get_batch(2, 0, 0, 1)), 44)[0] == 0
        assert peer.code(get_batch(2, 5, 0, 1)) == 0x8042
        assert peer.code(get_batch(1, 0, 0, 1)) == 0x8042
        assert peer.code(get_batch(3, 0, 7, 1)) == 0x8042
        peer.single(0x48)
        assert struct.unpack("<II", exactly(line, 8)) == (MAGIC, 1)
        assert peer.code(struct.pack("<II", 0x2A, 0)) == 0
        assert peer.code(bytes([0x22, 0, 0, 0])) == 0x80A0  # the laser is off


def test_the_trigger_by_command_needs_the_external_trigger_mode() -> None:
    with client() as peer:
        peer.single(0x21)
        assert peer.code(set_setting(1, setting(0x10, 0, 1), bytes([2]))) == 0
        assert peer.code(bytes([0x21, 0, 0, 0])) == 0x8080
    with client("&trigger=continuous") as peer:
        assert peer.code(bytes([0x21, 0, 0, 0])) == 0x8080


def test_a_late_answer_is_sent_before_the_next_one() -> None:
    with client("&fault=late&fault_at=1") as maker:
        maker.single(0x06)
        maker.control.sendall(struct.pack("<I4sII", 16, bytes.fromhex("0300F000"), 0, 4) + bytes([0x04, 0, 0, 0]))
        maker.control.settimeout(0.2)
        with pytest.raises(TimeoutError):
            maker.control.recv(1)
        maker.control.settimeout(10)
        held = maker.raw(struct.pack("<I4sII", 16, bytes.fromhex("0300F000"), 0, 4) + bytes([0x06, 0, 0, 0]))
        assert held[16] == 0x04
        following = exactly(maker.control, 4)
        assert exactly(maker.control, struct.unpack("<I", following)[0])[12] == 0x06
