"""The LJ-X8000A driver against its wire simulator, over real sockets."""

import itertools
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from coded import raises
from pydantic import ValidationError

from errormotion.datasets.units import EDGE
from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.line_profiler.keyence_ljx import KeyenceLJX, LJXSettings, codec
from errormotion.instruments.line_profiler.keyence_ljx.codec import StreamLayout
from errormotion.instruments.line_profiler.keyence_ljx.decoder import StreamDecoder, StreamEndedError
from errormotion.instruments.line_profiler.keyence_ljx.driver import QUIET_INTERVAL, STREAM
from errormotion.instruments.simulators.faults import parse_fault
from errormotion.instruments.simulators.line_profiler.keyence_ljx import SimulatedLJX, packed
from errormotion.instruments.simulators.line_profiler.profile_sources import Lines, SweptSurface
from errormotion.instruments.transports import parse_address
from errormotion.instruments.transports.loopback.serving import TcpServer
from errormotion.instruments.transports.loopback.stream_serving import NewestConnectionServer
from errormotion.plugins.readings import Profiles

SMALL = "sim://cframe/profiler?seed=3&points=80"
STEP = 1e-7  # m: the simulator's Z unit
FAST = LJXSettings(timeout=0.5)


def take(profiler: KeyenceLJX, blocks: int, block: int | None = None) -> list[Profiles]:
    return list(itertools.islice(profiler.stream(block), blocks))


def session(address: str, blocks: int = 3, block: int = 40, settings: LJXSettings | None = None) -> list[Profiles]:
    with KeyenceLJX(address, settings) as profiler:
        return take(profiler, blocks, block)


def joined(blocks: list[Profiles]) -> np.ndarray:
    return np.concatenate([block.heights for block in blocks])


class Ramp:
    """A surface whose height at every point is the encoder count, in steps of the Z unit."""

    def profile(self, encoder_count: int, n_points: int, x: np.ndarray) -> np.ndarray:
        return STEP * (encoder_count + np.arange(n_points, dtype=float))


@pytest.fixture
def ramp() -> Iterator[SimulatedLJX]:
    device = SimulatedLJX(parse_address("sim://cframe/profiler?points=80&encoder_step=3"), Ramp())
    yield device
    device.close()


def reach(device: SimulatedLJX) -> str:
    """The address of a simulator as that of a real device."""
    return f"{device.url}?stream={device.urls[STREAM].rpartition(':')[2]}"


class Waiting:
    """A feed whose encoder does not move: profiles are only triggered by command."""

    def __init__(self, obeys: bool) -> None:
        self._obeys = obeys
        self._due = threading.Event()

    def count(self) -> int:
        return 4711

    def begin(self) -> None:
        self._due.clear()

    def trigger(self) -> None:
        if self._obeys:
            self._due.set()

    def lines(self, layout: codec.StreamLayout) -> Iterator[Lines | None]:
        while True:
            if self._due.is_set():
                self._due.clear()
                yield Lines(np.array([4711]), np.full((1, layout.points), 1e-3), np.zeros(1))
            yield None

    def report_delivered(self, profiles: int) -> None:
        pass

    def end(self) -> None:
        pass


def requests(device: SimulatedLJX, monkeypatch: pytest.MonkeyPatch, refused: int = -1, code: int = 0x80) -> list[int]:
    """Opcodes of all requests from now on; one of them is refused."""
    seen: list[int] = []
    obey = device._execute

    def noted(opcode: int, arguments: bytes) -> tuple[int, bytes]:
        seen.append(opcode)
        return (code, b"") if opcode == refused else obey(opcode, arguments)

    monkeypatch.setattr(device, "_execute", noted)
    return seen


# ------------------------------------------------------------------ queries


def test_it_states_its_identity_and_counts() -> None:
    with KeyenceLJX(SMALL) as profiler:
        identity = profiler.identify()
        assert (identity.manufacturer, identity.model) == ("Keyence", "LJ-X8000A with head LJ-X8060")
        assert identity.simulated
        assert profiler.temperature() == pytest.approx({"sensor": 35.12, "processor": 41.08, "case": 29.67})
        assert (profiler.counts().trigger, profiler.counts().encoder) == (0, 0)
        assert profiler.errors() == []
        profiler.trigger()


def test_program_and_x_pitch_are_set_and_queried() -> None:
    with KeyenceLJX(SMALL, LJXSettings(program=3, x_pitch=25e-6)) as profiler:
        assert profiler.program() == 3
        assert profiler.x_pitch() == pytest.approx(25e-6, rel=1e-12)
        (block,) = take(profiler, 1, 2)
        assert np.diff(block.x) == pytest.approx(25e-6, rel=1e-9)
        assert block.x.shape == (80,)
        with raises("profiler.program.number"):
            profiler.change_program(16)
        profiler.change_program(0)
        assert profiler.program() == 0


def test_without_settings_the_program_is_unchanged(ramp: SimulatedLJX) -> None:
    with KeyenceLJX(reach(ramp), LJXSettings(program=5, x_pitch=30e-6)):
        pass
    with KeyenceLJX(reach(ramp)) as profiler:
        assert profiler.program() == 5
        assert profiler.x_pitch() == pytest.approx(30e-6)


def test_errors_are_shown_and_cleared(ramp: SimulatedLJX) -> None:
    ramp._errors = [50, 71]
    with KeyenceLJX(reach(ramp)) as profiler:
        assert profiler.errors() == [50, 71]
        profiler.clear_error(50)
        assert profiler.errors() == [71]


def test_settings_of_a_bench_file_need_units_and_valid_values() -> None:
    said = {"x_pitch": "12.5 um", "rate": "4 kHz", "noise": "0.5 um", "timeout": "2 s", "program": 1}
    read = LJXSettings.model_validate(said, context=EDGE)
    assert (read.x_pitch, read.rate, read.noise, read.timeout) == pytest.approx((12.5e-6, 4000.0, 0.5e-6, 2.0))
    for wrong in ({"x_pitch": 12.5}, {"program": 16}, {"rate": "0 Hz"}, {"generation": "LJ-S"}):
        with pytest.raises(ValidationError):
            LJXSettings.model_validate(wrong, context=EDGE)


def test_a_refusal_is_an_error_with_its_number_and_has_no_effect(ramp: SimulatedLJX) -> None:
    with KeyenceLJX(reach(ramp)) as profiler:
        with pytest.raises(InstrumentError, match=r"refuses request A0: error 80A2 .*not prepared"):
            profiler.command(codec.START_STREAM, bytes(8))
        with pytest.raises(InstrumentError, match="refuses request FF"):
            profiler.command(0xFF)
        assert profiler.program() == 0


def test_without_its_second_connection_a_stream_is_refused(ramp: SimulatedLJX) -> None:
    with KeyenceLJX(reach(ramp)) as profiler:
        profiler.transport.line(STREAM).close()
        deadline = time.monotonic() + 60.0
        while ramp._data.await_connection(0.0) and time.monotonic() < deadline:
            time.sleep(0.01)
        with pytest.raises(InstrumentError, match=r"80A0 \(no connection for the stream"):
            profiler.read()


def test_a_connection_that_its_client_has_closed_is_none_even_before_it_is_accepted() -> None:
    server = NewestConnectionServer("stream", lambda data: None)  # its thread does not run: nothing is noticed
    try:
        place = parse_address(server.url)
        first = socket.create_connection((place.host, place.port))
        assert server.accept_pending()
        first.close()
        assert not server.accept_pending()
        socket.create_connection((place.host, place.port)).close()
        assert not server.accept_pending()
        with socket.create_connection((place.host, place.port)):
            assert server.accept_pending()
    finally:
        server.close()


def test_a_wrong_start_code_is_refused(ramp: SimulatedLJX) -> None:
    with KeyenceLJX(reach(ramp)) as profiler:
        profiler.command(codec.PREPARE_STREAM, bytes(4))
        with pytest.raises(InstrumentError, match="another start code"):
            profiler.command(codec.START_STREAM, bytes((codec.PREPARE_STREAM, 0, 0, 0, 1, 0, 0, 0)))


# ------------------------------------------------------------------ measuring


def test_a_profile_equals_the_surface_to_one_z_unit(ramp: SimulatedLJX) -> None:
    with KeyenceLJX(reach(ramp)) as profiler:
        assert profiler.read() == pytest.approx(STEP * np.arange(80), abs=1e-15)


def test_reading_once_triggers_once_after_the_start_of_the_stream(
    ramp: SimulatedLJX, monkeypatch: pytest.MonkeyPatch
) -> None:
    with KeyenceLJX(reach(ramp)) as profiler:
        seen = requests(ramp, monkeypatch)
        profiler.read()
    assert seen == [codec.PREPARE_STREAM, codec.START_STREAM, codec.TRIGGER, codec.STOP_STREAM]


def test_a_stream_is_never_triggered_by_command(ramp: SimulatedLJX, monkeypatch: pytest.MonkeyPatch) -> None:
    with KeyenceLJX(reach(ramp)) as profiler:
        seen = requests(ramp, monkeypatch)
        take(profiler, 3, 20)
    assert codec.TRIGGER not in seen
    assert codec.START_STREAM in seen


def test_a_profiler_that_runs_freely_may_refuse_the_trigger(
    ramp: SimulatedLJX, monkeypatch: pytest.MonkeyPatch
) -> None:
    with KeyenceLJX(reach(ramp)) as profiler:
        seen = requests(ramp, monkeypatch, refused=codec.TRIGGER)
        assert profiler.read() == pytest.approx(STEP * np.arange(80), abs=1e-15)
        assert codec.TRIGGER in seen
        assert profiler.program() == 0


def test_a_profiler_that_waits_is_read_by_a_trigger(ramp: SimulatedLJX) -> None:
    ramp._feed = Waiting(obeys=True)
    with KeyenceLJX(reach(ramp), FAST) as profiler:
        for _ in range(2):
            assert profiler.read() == pytest.approx(np.full(80, 1e-3), abs=1e-12)
        assert profiler.counts().trigger == 2
        with raises("instrument.no_answer"):
            take(profiler, 1, 1)


@pytest.mark.parametrize(
    ("refused", "says"),
    [
        (-1, "a trigger by command had no effect"),
        (codec.TRIGGER, r"by command was refused: .* 8080 \(not possible in this"),
    ],
)
def test_without_a_profile_the_message_states_the_missing_trigger(
    ramp: SimulatedLJX, monkeypatch: pytest.MonkeyPatch, refused: int, says: str
) -> None:
    ramp._feed = Waiting(obeys=False)
    with KeyenceLJX(reach(ramp), FAST) as profiler:
        requests(ramp, monkeypatch, refused=refused)
        with pytest.raises(InstrumentTimeoutError, match=says) as caught:
            profiler.read()
        assert "waits for its trigger (trigger count 0, encoder 4711)" in str(caught.value)
        assert "Move the axis" in str(caught.value)
        assert profiler.program() == 0  # it is not lost


def test_unavailable_counts_are_omitted_from_the_message(ramp: SimulatedLJX, monkeypatch: pytest.MonkeyPatch) -> None:
    ramp._feed = Waiting(obeys=False)
    with KeyenceLJX(reach(ramp), FAST) as profiler:
        requests(ramp, monkeypatch, refused=codec.GET_COUNTS)
        with pytest.raises(InstrumentTimeoutError, match="waits for its trigger, and a trigger by command"):
            profiler.read()


def test_silence_of_a_profiler_at_the_trigger_gives_timeouts(
    ramp: SimulatedLJX, monkeypatch: pytest.MonkeyPatch
) -> None:
    ramp._feed = Waiting(obeys=False)
    with KeyenceLJX(reach(ramp), FAST) as profiler:
        ramp.fault = parse_fault(parse_address("sim://cframe/p?fault=silence&fault_at=9"), ramp.faults)
        monkeypatch.setattr(ramp._feed, "trigger", lambda: setattr(ramp, "_mute", True))
        with raises("instrument.no_answer"):
            profiler.read()
        with raises("instrument.no_answer"):
            profiler.program()
        ramp._mute = False
        assert profiler.program() == 0  # over a new connection


def test_blocks_follow_one_another_without_a_gap_with_their_counts(ramp: SimulatedLJX) -> None:
    with KeyenceLJX(reach(ramp)) as profiler:
        blocks = take(profiler, 3, 70)
    assert [block.first for block in blocks] == [0, 70, 140]
    assert np.concatenate([block.trigger for block in blocks]).tolist() == list(range(210))
    encoder = np.concatenate([block.encoder for block in blocks])
    assert encoder.tolist() == [3 * i for i in range(210)]
    assert joined(blocks) == pytest.approx(STEP * np.add.outer(encoder, np.arange(80)), abs=1e-15)
    block = blocks[0]
    assert block.values.shape == (80, 70)
    assert block.heights.flags.c_contiguous
    assert (block.dropped, dict(block.invalid), block.intensity, block.rate) == (0, {}, None, 1000.0)


def test_the_built_in_surface_includes_its_noise() -> None:
    (block,) = session(SMALL, 1, 200)
    surface = SweptSurface(3)
    truth = np.array([surface.height(block.x, count * 1e-6) for count in block.encoder])
    sigma = np.hypot(0.5e-6, STEP / np.sqrt(12))
    assert np.std(block.heights - truth) == pytest.approx(sigma, rel=0.03)  # 16 000 points: 0.6 %
    assert np.ptp(truth) > 1e-4


def test_intensities_are_returned_with_the_heights() -> None:
    (block,) = session(SMALL + "&intensity=1", 1, 5)
    assert block.intensity is not None
    assert block.intensity.shape == (5, 80)
    assert (block.intensity == 100 + np.arange(80)).all()


def test_the_encoders_overflow_is_undone_and_so_is_the_trigger_counts() -> None:
    (block,) = session(SMALL + "&encoder_start=2147483600&trigger_start=4294967290", 1, 40)
    assert block.encoder.tolist() == [2147483600 + 25 * i for i in range(40)]
    assert block.trigger.tolist() == [4294967290 + i for i in range(40)]
    assert not np.isnan(block.values).any()


def test_commands_are_answered_while_profiles_stream() -> None:
    with KeyenceLJX(SMALL) as profiler:
        stream = profiler.stream(20)
        next(stream)
        assert profiler.counts().trigger >= 20
        assert profiler.temperature()["case"] == pytest.approx(29.67)
        for change in (lambda: profiler.change_program(1), lambda: profiler.set_x_pitch(1e-5), profiler.read):
            with raises("stream.running"):
                change()
        assert next(stream).first == 20
        stream.close()
        assert profiler.program() == 0


def test_streams_can_be_started_again_and_again() -> None:
    with KeyenceLJX(SMALL) as profiler:
        for _ in range(3):
            (block,) = take(profiler, 1, 10)
            assert block.first == 0
            assert profiler.read().shape == (80,)


def test_a_slow_caller_loses_nothing() -> None:
    with KeyenceLJX(SMALL, LJXSettings(rate=100.0)) as profiler:
        stream = profiler.stream(50)
        blocks = [next(stream)]
        time.sleep(0.3)  # the queue of 64 profiles and all buffers are full by now
        blocks += itertools.islice(stream, 5)
        stream.close()
    assert np.concatenate([block.trigger for block in blocks]).tolist() == list(range(300))
    assert sum(block.dropped for block in blocks) == 0
    assert not np.isnan(joined(blocks)).any()


def test_at_a_pace_profiles_are_sent_when_they_are_due() -> None:
    start = time.monotonic()
    blocks = session(SMALL + "&pace=1&rate=200", 3, 20)
    assert time.monotonic() - start > 59 / 200
    assert [block.host_time for block in blocks] == sorted(block.host_time for block in blocks)


# ------------------------------------------------------------------ faults


def test_dropped_profiles_are_nan_at_their_positions_and_counted() -> None:
    whole = session(SMALL)
    holes = session(SMALL + "&fault=drop&fault_at=10&fault_every=7")
    gone = np.arange(10, 120, 7)
    missing = np.isnan(joined(holes)).all(axis=1)
    assert np.flatnonzero(missing).tolist() == gone.tolist()
    assert (joined(holes)[~missing] == joined(whole)[~missing]).all()
    assert sum(block.dropped for block in holes) == gone.size
    assert sum(block.invalid["lost"] for block in holes) == 80 * gone.size
    assert np.isnan(np.concatenate([block.encoder for block in holes])[gone]).all()
    assert np.concatenate([block.trigger for block in holes]).tolist() == list(range(120))


@pytest.mark.parametrize("fault", ["checksum", "garbage"])
def test_damaged_profiles_are_nan_and_counted_as_garbled(fault: str) -> None:
    whole = joined(session(SMALL))
    blocks = session(SMALL + f"&fault={fault}&fault_at=5&fault_every=10")
    there = ~np.isnan(joined(blocks)).all(axis=1)
    garbled = sum(block.invalid.get("garbled", 0) for block in blocks)
    assert garbled == 80 * (~there).sum()
    assert 6 <= (~there).sum() <= 12  # a stray byte between two profiles damages none
    assert set(np.flatnonzero(~there)) <= set(range(5, 120, 10))
    assert (joined(blocks)[there] == whole[there]).all()
    assert sum(block.dropped for block in blocks) == 0


def test_split_pieces_have_no_effect() -> None:
    assert (joined(session(SMALL)) == joined(session(SMALL + "&fault=split"))).all()


def test_a_missing_target_is_nan_with_its_reason() -> None:
    blocks = session(SMALL + "&fault=out_of_range&fault_at=30&fault_for=20")
    nothing = np.isnan(joined(blocks)).all(axis=1)
    assert np.flatnonzero(nothing).tolist() == list(range(30, 50))
    assert [block.invalid.get("invalid", 0) for block in blocks] == [80 * 10, 80 * 10, 0]


def test_checksums_that_are_always_wrong_end_in_a_protocol_error() -> None:
    with raises("profiler.stream.damaged"):
        session(SMALL + "&fault=checksum&fault_at=8&fault_every=1")


def test_silence_from_the_start_is_a_timeout_error_when_opening() -> None:
    start = time.monotonic()
    with raises("instrument.no_answer"):
        session(SMALL + "&fault=silence", settings=FAST)
    assert time.monotonic() - start < 30.0


def test_silence_in_a_stream_is_a_timeout_error_and_so_are_commands_until_it_answers_again() -> None:
    profiler = KeyenceLJX(SMALL + "&fault=silence&fault_at=50", FAST)
    with profiler:
        with raises("instrument.no_answer"):
            take(profiler, 3, 40)
        with raises("instrument.no_answer"):
            profiler.identify()
    with profiler:
        assert profiler.identify().manufacturer == "Keyence"


def test_a_start_that_is_answered_late_is_answered_before_the_stream_breaks(monkeypatch: pytest.MonkeyPatch) -> None:
    at_once = SimulatedLJX.reply

    def late(simulator: SimulatedLJX, data: bytes) -> None:
        time.sleep(0.05)  # in which an unanswered stream would send its 50 profiles and fall silent
        at_once(simulator, data)

    monkeypatch.setattr(SimulatedLJX, "reply", late)
    with raises("instrument.no_answer"):
        session(SMALL + "&fault=silence&fault_at=50", settings=FAST)


def test_a_broken_connection_is_an_instrument_error_and_can_be_opened_again() -> None:
    profiler = KeyenceLJX(SMALL + "&fault=disconnect&fault_at=50", FAST)
    for _ in range(2):
        with profiler, raises("connection.lost"):
            take(profiler, 3, 40)


def test_a_profiler_that_ends_the_stream_by_itself_is_an_instrument_error() -> None:
    with KeyenceLJX(SMALL) as profiler:
        stream = profiler.stream(10)
        next(stream)
        profiler.command(codec.STOP_STREAM)  # as if another client had sent it
        with raises("stream.ended"):
            list(stream)
        assert profiler.read().shape == (80,)


def test_the_notice_of_the_previous_stream_does_not_end_the_next_one() -> None:
    late = f"{SMALL}&notice_delay={2 * QUIET_INTERVAL}"
    with KeyenceLJX(late) as profiler:
        for _ in range(2):
            take(profiler, 1, 10)
            assert profiler.read().shape == (80,)


def test_only_one_notice_before_the_first_profile_is_treated_as_late() -> None:
    layout = StreamLayout(1, 0, 8, STEP, 0.0, 1e-5)
    profile = packed(layout, np.zeros((1, 8)), np.zeros(1, np.int64), np.zeros(1, np.int64)).tobytes()
    stopped = codec.notice(1)
    ends = {
        data: StreamDecoder(layout, late_notice=True)(data).end
        for data in (stopped + profile, stopped + stopped, profile + stopped)
    }
    assert ends[stopped + profile] is None
    assert isinstance(ends[stopped + stopped], StreamEndedError)
    assert isinstance(ends[profile + stopped], StreamEndedError)
    assert isinstance(StreamDecoder(layout)(stopped).end, StreamEndedError)


@pytest.mark.parametrize(
    ("answer", "error", "code"),
    [
        (b"\0\0\0\0" * 8, ProtocolError, "protocol.reply.length"),
        (b"\xff" * 32, ProtocolError, "protocol.reply.length"),
        (codec.reply(bytes(8))[:-1], InstrumentTimeoutError, "instrument.no_answer"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", ProtocolError, "protocol.reply.length"),
    ],
)
def test_another_device_at_the_address_is_a_typed_error(answer: bytes, error: type, code: str) -> None:
    stranger = TcpServer("stranger", lambda data: stranger.send(answer))
    other = TcpServer("other", lambda data: None)
    stranger.start()
    other.start()
    try:
        with raises(code):
            KeyenceLJX(f"{stranger.url}?stream={other.url.rpartition(':')[2]}", FAST).open()
    finally:
        stranger.close()
        other.close()


def test_a_stream_port_without_a_server_is_named(ramp: SimulatedLJX) -> None:
    with raises("connection.not_opened"):
        KeyenceLJX(f"{ramp.url}?stream=9").open()
    with raises("address.number"):
        KeyenceLJX(f"{ramp.url}?stream=70000").open()


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("sim://cframe/profiler?wire=pty", "network connections only"),
        ("sim://cframe/profiler?artefact=cow", "'artefact=cow': expected one of .*swept"),
        ("sim://cframe/profiler?fault=fire", "unknown fault"),
        ("serial:///dev/ttyUSB0", "2 network connections"),
    ],
)
def test_an_invalid_address_is_refused(address: str, message: str) -> None:
    with pytest.raises(InstrumentError, match=message):
        KeyenceLJX(address).open()


def test_leaving_in_the_middle_of_a_stream_ends_every_thread() -> None:
    before = set(threading.enumerate())
    with KeyenceLJX(SMALL) as profiler:
        stream = profiler.stream(10)
        next(stream)
        assert any(thread.name == "reader-keyence_ljx" for thread in threading.enumerate())
    assert set(threading.enumerate()) == before
    with raises("stream.closed"):
        next(stream)


# ------------------------------------------------------------------ recordings


def use(profiler: KeyenceLJX) -> tuple[np.ndarray, ...]:
    with profiler:
        serial = profiler.identify().serial_number
        return np.array(serial), joined(take(profiler, 2, 20)), profiler.read(), joined(take(profiler, 1, 30))


def test_a_recorded_session_plays_back_with_both_its_connections(tmp_path: Path) -> None:
    recording = tmp_path / "session.rec"
    original = use(KeyenceLJX(SMALL, record=recording))
    assert {path.name for path in tmp_path.iterdir()} == {
        "session.rec",
        "session.command.rec",
        "session.stream.rec",
    }
    replayed = use(KeyenceLJX(f"replay://{recording}"))
    for before, after in zip(original, replayed, strict=True):
        assert (before == after).all()
    with raises("replay.write.differs"):
        use(KeyenceLJX(f"replay://{recording}", LJXSettings(program=1)))


def test_a_changed_byte_of_the_recorded_stream_is_found(tmp_path: Path) -> None:
    recording = tmp_path / "session.rec"
    use(KeyenceLJX(SMALL, record=recording))
    stream = tmp_path / "session.stream.rec"
    lines = stream.read_text().splitlines()
    lines[1] = lines[1][:-1] + ("0" if lines[1][-1] != "0" else "1")
    stream.write_text("\n".join(lines) + "\n")
    with raises("recording.damaged"):
        KeyenceLJX(f"replay://{recording}").open()
