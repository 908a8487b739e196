"""From received bytes to readings, for each codec as its driver does it, without a device and without waiting."""

import atexit
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
from fuzzing import STEPS

from errormotion.errors import ErrormotionError, InstrumentTimeoutError
from errormotion.instruments.controller import virtual
from errormotion.instruments.controller.linuxcnc import codec as linuxcnc
from errormotion.instruments.controller.mtconnect import codec as mtconnect
from errormotion.instruments.controller.mtconnect.choice import choose
from errormotion.instruments.controller.mtconnect.settings import MTConnectSettings
from errormotion.instruments.controller.mtconnect.state import machine_state
from errormotion.instruments.controller.opcua import OpcUa
from errormotion.instruments.controller.shdr import codec as shdr
from errormotion.instruments.controller.shdr.memory import Memory
from errormotion.instruments.laser_tracker.leica_emscon import codec as emscon
from errormotion.instruments.laser_tracker.leica_emscon.link import Link
from errormotion.instruments.laser_tracker.leica_emscon.results import measurement
from errormotion.instruments.laser_tracker.leica_emscon.settings import EmSconSettings
from errormotion.instruments.laser_tracker.leica_emscon.streaming import points
from errormotion.instruments.laser_tracker.table_reader import read_table
from errormotion.instruments.line_profiler.keyence_ljx import codec as ljx
from errormotion.instruments.line_profiler.keyence_ljx.decoder import HeightDecoder
from errormotion.instruments.line_profiler.keyence_ljx.decoder import StreamDecoder as ProfileDecoder
from errormotion.instruments.point_lds.blocks import BlockDecoder
from errormotion.instruments.point_lds.capancdt import blocks as capancdt_values
from errormotion.instruments.point_lds.capancdt import codec as capancdt
from errormotion.instruments.point_lds.confocaldt import blocks as confocaldt_values
from errormotion.instruments.point_lds.confocaldt import codec as confocaldt
from errormotion.instruments.point_lds.counted import CountedReadings
from errormotion.instruments.point_lds.keyence_lk import codec as lk
from errormotion.instruments.point_lds.optoncdt import codec as optoncdt
from errormotion.instruments.point_lds.optoncdt import commands
from errormotion.instruments.point_lds.optoncdt.decoder import StreamDecoder
from errormotion.instruments.thermometer import cia404, dcon
from errormotion.instruments.thermometer.registers import SIZES, ModbusSettings
from errormotion.instruments.thermometer.scpi import codec as scpi
from errormotion.instruments.touch_probe.dprnt.codec import PATTERN, from_iso_code, parse_line, text_of
from errormotion.instruments.transports.base import PIECE, Transport
from errormotion.instruments.transports.can import pdo, sdo
from errormotion.instruments.transports.http.answer import Head, Input, Lines, header_fields
from errormotion.instruments.transports.modbus import codec as modbus
from errormotion.instruments.transports.modbus.serving import ModbusServer
from errormotion.instruments.transports.recording import parts_of, read_index, read_note, read_recording

Read = Callable[[bytes], object]
URL = "tcp://192.0.2.1:1"
PROFILE_POINTS, MAX_BLOCKS, MAX_READINGS = 16, 16, 35_000
EMSCON = EmSconSettings(timeout=1e-9)
LAYOUT = ljx.StreamLayout(1, ljx.INTENSITY, PROFILE_POINTS, 0.8e-6, 0.0, 1e-5)
MODBUS = {
    kind: ModbusSettings(channels=("a", "b"), type=kind, first=0x20) for kind in ("u16", "i16", "u32", "i32", "f32")
}


class Received(Transport):
    """A line from which some bytes were received; a read behind them is a timeout at once.

    Parameters
    ----------
    data : bytes
    by_line : bool
        Whether each write makes the next line of the bytes available, as of a device that answers.
    """

    def __init__(self, data: bytes, *, by_line: bool = False) -> None:
        super().__init__(URL, 0.0)
        self._left = [data]
        self._answers = data.splitlines(keepends=True) if by_line else []
        if by_line:
            self._left = []

    def _send(self, data: bytes) -> None:
        self._left = self._answers[:1]
        del self._answers[:1]

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        STEPS.mark()
        if not self._left or not self._left[0]:
            raise InstrumentTimeoutError(f"{self.url}: nothing more")
        data, self._left[0] = self._left[0][:max_bytes], self._left[0][max_bytes:]
        return data

    def close(self) -> None:
        """Nothing to close."""


def each(*calls: Callable[[], object]) -> None:
    """Make all calls; raise the last of the project's errors where none of them accepts the bytes."""
    last: ErrormotionError | None = None
    accepted = not calls
    for call in calls:
        try:
            call()
        except ErrormotionError as error:
            last = error
        else:
            accepted = True
    if last is not None and not accepted:
        raise last


def pieces(data: bytes) -> Iterator[tuple[bytes, bool]]:
    """Yield the pieces of what a connection delivers, and whether it is the last one; at least two."""
    start, end = 0, min(len(data) // 3, PIECE)
    while True:
        yield data[start:end], False
        STEPS.mark()
        start, end = end, end + PIECE
        if end >= len(data):
            yield data[start:], True
            return


# ---------------------------------------------------------------------- sensors


def optoncdt_answer(data: bytes) -> None:
    lines = commands.parse_answer("GETINFO", optoncdt.text_of(data))
    each(
        lambda: commands.reported_range(commands.parse_info(lines)),
        lambda: commands.parse_layout(lines, counter=True),
        lambda: commands.setting("MEASRATE", lines),
    )


def optoncdt_stream(counter: bool, counter_first: bool) -> Read:
    def read(data: bytes) -> None:
        decoder = StreamDecoder(2e-3, highest=64876, counter=counter, counter_first=counter_first)
        for piece, _ in pieces(data):
            chunk = decoder(piece)
            assert chunk.values.shape == chunk.reasons.shape

    return read


def capancdt_answer(data: bytes) -> None:
    def read(command: str, parse: Callable[[str], object] = str) -> Callable[[], object]:
        return lambda: parse(capancdt.answer_to(command, data))

    capancdt.echoes("VER", data)
    each(
        read("VER"),
        read("LIN4:2"),
        read("STI1200", lambda text: capancdt.parse_sample_time("STI1200", text)),
        read("CHS", capancdt.parse_channels),
        read("CHI1", lambda text: capancdt.parse_channel(1, text)),
        read("COI", lambda text: capancdt.parse_fields("COI", text)),
        read("GDP", lambda text: capancdt.parse_number("GDP", text)),
    )


def counted_blocks(decoder: Callable[[], BlockDecoder], readings: Callable[[], CountedReadings]) -> Read:
    """Return what reads blocks as a stream does; of long gaps, as many readings as a block of a stream has."""

    def read(data: bytes) -> None:
        split, found = decoder(), readings()
        for piece, last in pieces(data):
            for block in split.feed(piece, last=last):
                found.add(block)
            values, codes = found.take(min(found.waiting, MAX_READINGS))
            assert values.shape == codes.shape

    return read


capancdt_blocks = counted_blocks(
    capancdt_values.block_decoder,
    lambda: capancdt_values.readings_of(1, capancdt.Channel("", "", 0.0, 1e-3)),
)
confocaldt_blocks = counted_blocks(confocaldt_values.block_decoder, confocaldt_values.readings)


def confocaldt_answer(data: bytes) -> None:
    lines = commands.parse_answer(confocaldt.INFO, optoncdt.text_of(data))
    facts = confocaldt.facts_of(lines)
    each(
        lambda: confocaldt.model_of(facts),
        lambda: confocaldt.range_of(facts),
        lambda: confocaldt.rate_of(lines),
        lambda: confocaldt.reduction_of(lines),
    )


def keyence_lk(data: bytes) -> None:
    text = lk.decode(data)
    each(
        lambda: lk.parse_value(lk.parse_answer("MS,01", text), lk.DISPLAYS["0.0001 mm"]),
        lambda: lk.parse_value(text, lk.DISPLAYS["0.01 um"]),
    )


def ljx_reply(data: bytes) -> None:
    size = ljx.reply_length(data[:4].ljust(4, b"\0"))
    reply = ljx.parse_reply(data[:size])
    each(
        lambda: ljx.parse_description(reply),
        lambda: ljx.parse_errors(reply),
        lambda: ljx.parse_layout(reply),
        lambda: reply.unpack("II"),
    )


def ljx_stream(data: bytes) -> None:
    decoder, heights = ProfileDecoder(LAYOUT), HeightDecoder(LAYOUT)
    for piece, _ in pieces(data):
        chunk = decoder(piece)
        found = np.empty((len(chunk.values), LAYOUT.points))
        heights.heights(chunk.values, chunk.reasons, found, np.zeros(len(ljx.REASONS), dtype=np.int64))
        heights.intensities(chunk.values, chunk.reasons, np.empty(found.shape, dtype=np.uint16))
        heights.encoder(chunk.values[:, ljx.ENCODER_WORD], chunk.reasons)
        if chunk.end is not None:
            raise chunk.end


# ---------------------------------------------------------------------- trackers


def emscon_packets(data: bytes) -> None:
    link = Link(Received(data), 0.0, 0.0)
    while (packet := link.next_packet(0.0)) is not None:
        if packet.kind in (emscon.SINGLE, emscon.SINGLE2):
            measurement(packet.values, 1.0, 0)


def emscon_points(data: bytes) -> None:
    with suppress(InstrumentTimeoutError):  # behind the last byte
        for _ in islice(points(Link(Received(data), 0.0, 0.0), EMSCON, block=1), MAX_BLOCKS):
            pass


@cache
def folder() -> Path:
    """Return a folder of this process, which ends with it."""
    memory = Path("/dev/shm")  # a disk would be what is measured
    found = Path(tempfile.mkdtemp(prefix="mutants-", dir=memory if memory.is_dir() else None))
    atexit.register(shutil.rmtree, found, ignore_errors=True)
    return found


def in_file(read: Callable[[Path], object]) -> Read:
    """Return what reads bytes from a file."""

    def read_bytes(data: bytes) -> object:
        path = folder() / "frames"
        path.write_bytes(data)
        return read(path)

    return read_bytes


tracker_table = in_file(lambda path: read_table(path, repeats="last"))


def recording(path: Path) -> None:
    each(
        lambda: read_recording(path),
        lambda: read_index(path),
        lambda: read_note(path),
        lambda: parts_of(path),
    )


# ---------------------------------------------------------------------- thermometers


def dcon_answer(data: bytes) -> None:
    each(
        lambda: dcon.parse_temperatures(dcon.decode(data)),
        lambda: dcon.parse_temperatures(dcon.decode(data, with_checksum=True)),
        lambda: dcon.check_configuration(dcon.decode(data).removeprefix("!01")),
    )


def modbus_answer(framing: modbus.Framing) -> Read:
    def decode(data: bytes, kind: str, settings: ModbusSettings) -> None:
        count = 2 * SIZES[kind]
        words = modbus.decode_answer(framing, data, 1, 3, count, 1)
        if words is not None:
            settings.temperature(0, words[: count // 2])

    def read(data: bytes) -> None:
        taken, line = b"", Received(data)
        while lacking := modbus.missing(framing, taken):
            taken += line.read(lacking)
        each(
            *(lambda kind=kind, own=own: decode(taken, kind, own) for kind, own in MODBUS.items()),
            lambda: modbus.decode_written(framing, taken, 1, modbus.WRITE_ONE, 7, [3], 1),
            lambda: modbus.decode_written(framing, taken, 1, modbus.WRITE_SEVERAL, 7, [3, 4], 1),
        )

    return read


def modbus_request(framing: modbus.Framing) -> Read:
    def read(data: bytes) -> None:
        def write(registers: Mapping[int, int]) -> int:
            assert all(0 <= register < 125 and 0 <= value <= 0xFFFF for register, value in registers.items())
            return 0

        server = ModbusServer(framing, 1, 3, {0: 125}, lambda: {0: 7}, write)
        for piece, _ in pieces(data):
            for answer in server.receive(piece):
                assert len(answer) <= 260

    return read


def scpi_answer(data: bytes) -> None:
    text = scpi.decode(data)
    each(
        lambda: scpi.parse_readings(text),
        lambda: scpi.parse_identity(text),
        lambda: scpi.parse_error(text),
        lambda: scpi.parse_channels(text),
    )


def sdo_transfer(data: bytes) -> None:
    """Read an entry; each request is answered by the next eight bytes."""
    frames: Iterator[bytes] = (data[i : i + 8] for i in range(0, len(data), 8))

    def send(_: bytes, reset: Callable[[], None] | None) -> None:
        if reset is not None:
            reset()
        for frame in islice(frames, 1):
            client.answers.put(frame)

    client = sdo.SdoClient(send, 0.0)
    entry = client.upload(0x1008, 0)
    each(lambda: None, *(lambda number=number: number.decode(entry) for number in cia404.NUMBERS.values()))


def sdo_frame(data: bytes) -> None:
    each(
        lambda: sdo.upload_reply(data, 0x6060, 0),
        lambda: sdo.upload_reply(data, 0x6130, 1),
        lambda: sdo.segment_reply(data, 0),
        lambda: sdo.segment_reply(data, 1),
    )


def cia404_entries(data: bytes) -> None:
    """The first bytes are the unit, the next one the digits, the next one the status, the others the value."""
    unit, digits, status, value = data[:4], data[4:5], data[5:6], data[6:]

    def celsius(number: cia404.Number) -> None:
        scale = cia404.scale_of(int.from_bytes(unit, "little"), int.from_bytes(digits, "little"))
        found = scale.celsius(number.decode(value))
        cia404.flag_of(int.from_bytes(status, "little"), found)

    each(*(lambda number=number: celsius(number) for number in cia404.NUMBERS.values()))


def pdo_frames(data: bytes) -> None:
    """The mapping of a PDO, 4 bytes an entry, and behind eight zeros a frame of it."""
    mapping, _, frame = data.partition(bytes(8))
    entries = [int.from_bytes(mapping[i : i + 4], "little") for i in range(0, len(mapping), 4)]
    pdo.decode_identifier(entries[0] if entries else 0)
    for place in pdo.decode_mapping(entries[: pdo.MAX_ENTRIES]):
        place.data(frame[:8])


# ---------------------------------------------------------------------- controllers, probes


def mtconnect_document(data: bytes) -> None:
    document = mtconnect.parse(data)
    for device in document.devices:
        choice = choose(device, MTConnectSettings())
        each(lambda: None, *(lambda item=item: item.scale for item in choice.items.values()))
    items = {each.item: each for each in document.observations}
    named = {
        key: mtconnect.DataItem(item, "SAMPLE", "POSITION")
        for key, item in zip(("position.X", "position.Y", "spindle_speed", "mode"), items, strict=False)
    }
    each(lambda: None, lambda: machine_state(document, named, 0.0))


def http_answer(data: bytes) -> None:
    pieces = [data[i : i + 700] for i in range(0, len(data), 700)]
    source = Input(lambda _: pieces.pop(0) if pieces else b"", URL, 1.0)
    try:
        head = Head(source, URL)
    except EOFError:
        return
    if "multipart" not in head.headers.get("content-type", ""):
        head.body(1 << 20)
        return
    lines = Lines(head, URL)
    while (line := lines.line()) is not None:
        if line.startswith(b"--"):
            text = header_fields(lines.line, URL).get("content-length", "")
            if text.isascii() and text.isdigit() and len(text) < 6:
                lines.block(int(text))


def shdr_lines(data: bytes) -> None:
    lines, memory = shdr.Lines(), Memory()
    for piece, _ in pieces(data):
        for line in lines.feed(piece):
            found = shdr.parse_line(line)
            if isinstance(found, shdr.Command):
                shdr.pong(found)
                continue
            for observed in found:
                memory.store(observed)
    each(lambda: None, *(lambda key=key: memory.numbers(key, {}) for key in memory.values))
    memory.reported("FAULT")


def linuxcnc_line(data: bytes) -> None:
    message = linuxcnc.decode(data)
    if isinstance(message, linuxcnc.Answer):
        each(lambda: linuxcnc.decode_state(message.result), lambda: linuxcnc.decode_touch(message.result))


def virtual_line(data: bytes) -> None:
    virtual.decode_answer(data, 1).result  # noqa: B018 - a refusal raises


def opcua_lines(data: bytes) -> None:
    """A session of which each request is answered by the next line."""
    driver = OpcUa("opc.tcp://192.0.2.1:4840")
    driver._transport = Received(data, by_line=True)
    driver._start_session()
    driver.identify()
    driver.state()


_LINE = re.compile(PATTERN)


def dprnt_line(data: bytes) -> None:
    def read(line: bytes) -> None:
        text = text_of(line)
        if text:
            parse_line(text, _LINE)

    each(lambda: read(from_iso_code(data)), lambda: read(data))
