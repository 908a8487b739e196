"""Every codec of the wire, with good frames of it: from the golden vectors, and from sessions with the simulators."""

import struct
from collections.abc import Sequence
from contextlib import suppress
from functools import cache, partial
from itertools import islice

import wire_readers as readers
from emscon_answers import encode_change, encode_result
from fuzzing import Codec
from wire_readers import folder
from wire_vectors import vectors

from errormotion.errors import ProtocolError
from errormotion.instruments.controller import virtual
from errormotion.instruments.controller.linuxcnc import codec as linuxcnc
from errormotion.instruments.controller.mtconnect import xml
from errormotion.instruments.controller.shdr.codec import MAX_LINE_BYTES
from errormotion.instruments.interferometer.attocube_ids import codec as ids
from errormotion.instruments.laser_tracker import table_reader
from errormotion.instruments.laser_tracker.leica_emscon import codec as emscon
from errormotion.instruments.laser_tracker.leica_geocom import codec as geocom
from errormotion.instruments.line_profiler.keyence_ljx import codec as ljx
from errormotion.instruments.point_lds.blocks import MAX_BLOCK_BYTES
from errormotion.instruments.point_lds.capancdt import codec as capancdt
from errormotion.instruments.point_lds.confocaldt import blocks as confocaldt
from errormotion.instruments.point_lds.keyence_lk import codec as lk
from errormotion.instruments.point_lds.optoncdt import commands
from errormotion.instruments.point_lds.optoncdt.codec import encode_value
from errormotion.instruments.thermometer import dcon
from errormotion.instruments.thermometer.scpi import codec as scpi
from errormotion.instruments.touch_probe.dprnt.codec import MAX_LINE, Line, format_line
from errormotion.instruments.transports import opc
from errormotion.instruments.transports.base import CHUNK, PIECE
from errormotion.instruments.transports.can import sdo
from errormotion.instruments.transports.http.answer import MAX_LINE_BYTES as MAX_HEAD_LINE
from errormotion.instruments.transports.modbus import codec as modbus
from errormotion.instruments.transports.recording import Recorder, add_note, parts_of, read_recording, write_index
from errormotion.testing.run import subjects_of


@cache
def session(plugin: str) -> Sequence[Sequence[bytes]]:
    """Return what a simulated device sends in a short session, one sequence of frames for each of its lines."""
    subject = subjects_of("instruments", plugin)[0]
    path = folder() / f"{plugin}.rec"
    driver = subject.build(record=path)
    with driver:
        driver.identify()
        driver.read()
        if subject.streams:
            stream = iter(driver.stream())
            list(islice(stream, 1))
            if hasattr(stream, "close"):
                stream.close()
    return [[data for way, data in read_recording(part)[1] if way == "R" and data] for part in parts_of(path)]


def joined(plugin: str, line: int = 0) -> bytes:
    """Return all that a simulated device sends on one line."""
    return b"".join(session(plugin)[line])


def split(data: bytes, end: bytes, most: int = 8) -> list[bytes]:
    """Return different frames up to their ends."""
    return list(dict.fromkeys(part + end for part in data.split(end) if part))[:most]


def rows(device: str, *layers: str) -> list[bytes]:
    """Return the golden vectors of some layers."""
    return [vector.data for layer in layers for vector in vectors(device, layer)]


# ---------------------------------------------------------------------- seeds


def optoncdt_answers() -> list[bytes]:
    own = split(joined("optoncdt")[:2000], commands.PROMPT)
    return [
        *own,
        *rows("optoncdt", "getinfo", "answer"),
        b"GETOUTINFO_RS422 DIST1 COUNTER\r\n->",
        b"E210 unknown\r\n->",
    ]


def optoncdt_values(counter: bool, counter_first: bool) -> list[bytes]:
    def sample(number: int) -> bytes:
        values = [5000 + 7 * (number & 63), number][: 1 + counter]
        ordered = values[::-1] if counter_first else values
        return b"".join(encode_value(value, first=place == 0) for place, value in enumerate(ordered))

    return [b"".join(map(sample, range(30))), b"".join(map(sample, range(262140, 262144))) + sample(0)]


def capancdt_frames() -> list[bytes]:
    def block(counter: int) -> bytes:
        return struct.pack("<4sIIQIHHI4i", b"SAEM", 1, 2, 1, 0, 4, 4, counter, 5, 6, 7, 8)

    return [block(2**32 - 4) + block(0) + block(4), block(7) + block(15), block(3)]


def confocaldt_answers() -> list[bytes]:
    own = split(joined("confocaldt"), commands.PROMPT, most=16)
    return [*own, *rows("confocaldt", "facts", "sensor", "rate", "reduction", "error")]


def confocaldt_frames() -> list[bytes]:
    def block(counter: int) -> bytes:
        flags = confocaldt.MEASURED | confocaldt.DISTANCE_1
        return confocaldt.HEADER.pack(b"SAEM", 1, 2, flags, 6 << 28, 4, 4, counter) + struct.pack(
            "<4i", 5, 6, 7, 2**31 - 5
        )

    return [block(2**32 - 4) + block(0) + block(4), block(7) + block(15), *rows("confocaldt", "block", "other")]


def lk_answers() -> list[bytes]:
    own = split(joined("keyence_lk"), lk.LINE_END)
    return [*own, *(line + lk.LINE_END for line in rows("keyence_lk", "value", "no value")), b"MS,01,+01.2345\r"]


def ljx_replies() -> list[bytes]:
    pieces = session("keyence_ljx")[0]  # the length of a reply, then the rest of it
    own = [head + rest for head, rest in zip(pieces[::2], pieces[1::2], strict=False)]
    return [*own, *rows("keyence_ljx", "reply", "layout")]


def ljx_profiles() -> list[bytes]:
    def profile(trigger: int) -> bytes:
        words = [0xFFFF & number * 2654435761 for number in range(READER_WORDS)]
        words[:6] = [0, trigger, 5 * trigger, 0, 0, 0]
        words[-1] = sum(words[:-1]) & 0xFFFFFFFF
        return struct.pack(f"<{len(words)}I", *words)

    return [b"".join(map(profile, range(4))), profile(7) + profile(9) + profile(10)]


READER_WORDS = readers.LAYOUT.words


def emscon_packets() -> list[bytes]:
    own = [frame for frame in session("leica_emscon")[0] if len(frame) > emscon.HEADER.size]
    return [*own, *rows("leica_emscon", "answer", "result", "points", "error"), encode_change(1)]


def emscon_points() -> list[bytes]:
    def packet(first: int) -> bytes:
        times = [divmod(10_000 * number, 1_000_000) for number in range(first, first + 5)]
        points = [{"seconds": s, "microseconds": us, "val3": 2.0} for s, us in times]
        return encode_result(emscon.MULTI, {}, points=points)

    return [b"".join(map(packet, (0, 5, 10, 15)))]


def modbus_answers(framing: modbus.Framing) -> list[bytes]:
    one = modbus.encode_write(framing, 1, modbus.WRITE_ONE, 7, [3], 1)  # is its own confirmation
    return [one, *(modbus.encode_answer(framing, 1, 3, words, 1) for words in ([555, 1], [0, 100, 7, 65535]))]


def modbus_requests(framing: modbus.Framing) -> list[bytes]:
    one = modbus.encode_request(framing, 1, 3, 0, 2, 1)
    written = [modbus.encode_write(framing, 1, 16, 5, [1, 2, 3], 3), modbus.encode_write(framing, 1, 6, 5, [9], 4)]
    return [one, one + modbus.encode_request(framing, 1, 4, 5, 100, 2), one[:1] + one, *written]


def can_frames() -> list[bytes]:
    """Return the data of frames behind their identifiers."""
    return [frame[4:] for frame in session("can_temperature")[0] if len(frame) > 4][:8]


def sdo_transfers() -> list[bytes]:
    start = struct.pack("<BHBI", 0x41, 0x1008, 0, 10)
    return [struct.pack("<BHB4s", 0x43, 0x1008, 0, b"CAN4"), start + b"\0abcdefg" + b"\x19hij" + bytes(4)]


def cia404_entries() -> list[bytes]:
    return [b"\0\0\x2d\0" + b"\1\0" + value for value in (b"\0\0\xa2\x41", b"\x20\x00")]


def pdo_frames() -> list[bytes]:
    entries = struct.pack("<II", 0x61300120, 0x61500108)
    return [entries + bytes(8) + bytes(range(8))]


def scpi_answers() -> list[bytes]:
    own = split(joined("scpi_temperature"), scpi.LINE_END)
    return [*own, *rows("scpi_temperature", "identity", "scan list", "error", "readings")]


def documents() -> list[bytes]:
    own = [part[: part.rindex(b">") + 1] for part in joined("mtconnect").split(b"\r\n\r\n")[1:]]
    return [*own, *rows("mtconnect", "probe", "streams", "error")]


def http_answers() -> list[bytes]:
    return [
        joined("mtconnect"),
        b"HTTP/1.1 200 OK\r\nContent-Type: text/xml\r\nContent-Length: 5\r\n\r\n<a/>\n",
        b"HTTP/1.1 100 Continue\r\n\r\nHTTP/1.0 404 Not Found\r\nConnection: keep-alive\r\n\r\nnothing",
        b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n4\r\n<a/>\r\n1;x=y\r\n\n\r\n0\r\nA: b\r\n\r\n",
        b"HTTP/1.1 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=b\r\nTransfer-Encoding: chunked\r\n\r\n"
        b"2E\r\n--b\r\nContent-length: 4\r\n\r\n<a/>\r\n--b\r\nContent-l\r\n10\r\nength: 2\r\n\r\nok\r\n\r\n0\r\n\r\n",
    ]


def linuxcnc_lines() -> list[bytes]:
    """Return what a bridge sends: the golden vectors, and lines as recorded; none needs an installed LinuxCNC."""
    flags = '"running": false, "homed": true, "enabled": true, "estop": false, "alarms": ["a", "b"]'
    state = (
        '{"time": 1.5, "position": [0.1, 0.2, null], "commanded_position": [0.1, 0.2, 0.3], "spindle_speed": 1200, '
        f'"spindle_load": null, "feed": 0.01, "mode": "mdi", "program": "a.ngc", {flags}}}'
    )
    identity = (
        '{"manufacturer": "LinuxCNC", "model": "cframe", "serial_number": "seed 3", "firmware": "2.9.0~pre1", '
        '"travel": {"X": [-0.305001, 0.305001], "Y": [-0.255001, 0.255001], "Z": [-1e-06, 0.460001]}}'
    )
    texts = [f'{{"id": 1, "ok": true, "result": {result}, "time": 1.5}}' for result in (identity, state)]
    golden = rows("linuxcnc", "welcome", "answer", "beat", "touch")
    return [data.rstrip(linuxcnc.LINE_END) + linuxcnc.LINE_END for data in (*golden, *(t.encode() for t in texts))]


def virtual_lines() -> list[bytes]:
    return [*split(joined("virtual_controller"), virtual.LINE_END), b'{"id": 1, "ok": true, "result": {"x": [1.5]}}\n']


def dprnt_lines() -> list[bytes]:
    lines = (Line((0.0123, -0.0032, 0.1), 12, 45.21), Line((1.5e-3, 2.25e-3, -1.0)))
    printed = "\x12%\r\nN12 X   12.345 Y -  3.210 Z  100.000 T   45210\r\n"
    return [printed.encode(), *(format_line(line).encode() + b"\r\n" for line in lines), b"B1 X1.0 Y2.0 Z3.\r\n"]


def geocom_values(data: bytes) -> None:
    """Read a reply and take each of its values for a number, a whole number and a text."""
    reply = geocom.reply(data)
    for index in range(len(reply.values)):
        for take in (reply.number, reply.whole, reply.text):
            with suppress(ProtocolError):
                take(index)


def ids_values(data: bytes) -> None:
    """Read a reply and take each of its values for a length, true or false, and a text."""
    reply = ids.reply(data)
    for index in range(len(reply.values)):
        for take in (reply.length, reply.flag, reply.text):
            with suppress(ProtocolError):
                take(index)


def tables() -> list[bytes]:
    text = "station,target,length [mm],temperature [degC],pressure [hPa],humidity [%]\n"
    return [(text + "S1,1,1500.5,20.1,1013,40\nS1,2,,20.2,1013,40\nS2,1,900,20.3,1012,41\nS1,1,1500.6,,,\n").encode()]


@cache
def recordings() -> Sequence[bytes]:
    path, index = folder() / "good.rec", folder() / "list.rec"
    recorder = Recorder(path, "tcp://127.0.0.1:5025")
    for number in range(5):
        recorder.frame("WR"[number % 2], bytes(range(number, number + 20)))
    recorder.close()
    plain = path.read_bytes()
    add_note(path, {"session": {"step": "", "readings": {"count": 3}}})
    write_index(index, ["spindle", "frame"])
    return [plain, path.read_bytes(), index.read_bytes()]


# ---------------------------------------------------------------------- the list

_VALUES = ((True, False, "distance and counter"), (True, True, "counter and distance"), (False, False, "distance"))
_FRAMINGS: tuple[modbus.Framing, ...] = ("tcp", "rtu")
_THERMOMETERS = {framing: f"modbus_temperature ({framing.upper()})" for framing in _FRAMINGS}

CODECS: Sequence[Codec] = (
    Codec("optoncdt", "answers", readers.optoncdt_answer, optoncdt_answers, commands.MAX_ANSWER),
    *(
        Codec(
            *("optoncdt", f"values, {what}", readers.optoncdt_stream(counter, first)),
            *(partial(optoncdt_values, counter, first), CHUNK),
        )
        for counter, first, what in _VALUES
    ),
    Codec(
        "capancdt",
        "answers",
        readers.capancdt_answer,
        lambda: [*split(joined("capancdt"), b"\n"), *rows("capancdt", "answer")],
        capancdt.MAX_LINE_BYTES,
    ),
    Codec("capancdt", "blocks", readers.capancdt_blocks, capancdt_frames, MAX_BLOCK_BYTES),
    Codec("confocaldt", "answers", readers.confocaldt_answer, confocaldt_answers, commands.MAX_ANSWER),
    Codec("confocaldt", "blocks", readers.confocaldt_blocks, confocaldt_frames, MAX_BLOCK_BYTES),
    Codec("keyence_lk", "answers", readers.keyence_lk, lk_answers, lk.MAX_LINE_BYTES),
    Codec(
        *("keyence_ljx", "replies", readers.ljx_reply),
        *(ljx_replies, ljx.MAX_REPLY_BYTES),
    ),
    Codec("keyence_ljx", "profiles", readers.ljx_stream, ljx_profiles, ljx.MAX_PROFILE_BYTES),
    Codec("keyence_ljx", "requests", ljx.parse_request, lambda: rows("keyence_ljx", "request"), ljx.MAX_REPLY_BYTES),
    Codec("leica_emscon", "packets", readers.emscon_packets, emscon_packets, emscon.MAX_PACKET_BYTES),
    Codec("leica_emscon", "points", readers.emscon_points, emscon_points, emscon.MAX_PACKET_BYTES),
    Codec("leica_geocom", "replies", geocom_values, lambda: rows("leica_geocom", "reply"), geocom.MAX_REPLY),
    Codec("attocube_ids", "replies", ids_values, lambda: rows("attocube_ids", "reply"), ids.MAX_REPLY),
    Codec("tracker_table", "files", readers.tracker_table, tables, table_reader.MAX_TABLE, tried=4096, per_byte=128),
    Codec(
        "dcon_temperature",
        "answers",
        readers.dcon_answer,
        lambda: [*split(joined("dcon_temperature"), dcon.LINE_END), b">+025.12-0000+9999.9\r"],
        dcon.MAX_LINE_BYTES,
    ),
    *(
        Codec(
            *(_THERMOMETERS[framing], "answers", readers.modbus_answer(framing)),
            *(partial(modbus_answers, framing), modbus.MAX_FRAME[framing]),
        )
        for framing in _FRAMINGS
    ),
    *(
        Codec(
            *(_THERMOMETERS[framing], "requests", readers.modbus_request(framing)),
            *(partial(modbus_requests, framing), modbus.MAX_FRAME[framing]),
        )
        for framing in _FRAMINGS
    ),
    Codec(
        "can_temperature",
        "SDO frames",
        readers.sdo_frame,
        lambda: [*can_frames(), *rows("can_temperature", "sdo")],
        sdo.FRAME_BYTES,
    ),
    Codec("can_temperature", "SDO transfers", readers.sdo_transfer, sdo_transfers, sdo.MAX_TRANSFER),
    Codec("can_temperature", "entries of CiA 404", readers.cia404_entries, cia404_entries, sdo.MAX_TRANSFER),
    Codec("can_temperature", "PDO", readers.pdo_frames, pdo_frames, sdo.FRAME_BYTES),
    Codec(
        *("scpi_temperature", "answers", readers.scpi_answer),
        *(scpi_answers, scpi.LONGEST),
    ),
    Codec(
        *("mtconnect", "documents", readers.mtconnect_document),
        *(documents, xml.LONGEST, PIECE),
    ),
    Codec("mtconnect", "HTTP", readers.http_answer, http_answers, MAX_HEAD_LINE),
    Codec(
        "shdr", "lines", readers.shdr_lines, lambda: [joined("shdr"), *rows("shdr", "line", "stream")], MAX_LINE_BYTES
    ),
    Codec("opcua", "lines of a session", readers.opcua_lines, lambda: [joined("opcua")], opc.MAX_BYTES),
    Codec("linuxcnc", "lines", readers.linuxcnc_line, linuxcnc_lines, linuxcnc.MAX_LINE),
    Codec("virtual_controller", "lines", readers.virtual_line, virtual_lines, virtual.MAX_LINE),
    Codec("dprnt", "lines", readers.dprnt_line, dprnt_lines, MAX_LINE),
    Codec("all", "recordings", readers.in_file(readers.recording), recordings, CHUNK, tried=4096),
)
