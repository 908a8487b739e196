"""A correct instrument passes the kit, and each broken one fails exactly the check for its fault."""

import json
import math
import re
import socket
import threading
import time
from collections import deque
from dataclasses import replace
from pathlib import Path
from typing import ClassVar
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from pydantic import ConfigDict

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ReplayError
from errormotion.plugins import Identity, InstrumentInfo, PluginSettings, Samples
from errormotion.testing import InstrumentConformance, InstrumentSubject, run_checks
from errormotion.testing.checks.instrument import INSTRUMENT_CHECKS
from errormotion.testing.kit import run_check

BLOCK = 8


class Settings(PluginSettings):
    offset: float = 0.0


class Sound:
    """A sensor with text lines 'counter value', in Python lists instead of sockets."""

    info = InstrumentInfo("sound", "point_lds", "A sensor that exists in this test only", "simulated_only")
    Settings = Settings
    measuring_range, mid_range = (0.0, 2e-3), 1e-3

    def __init__(self, address, settings=None, *, record=None):
        self.address, self.settings, self.record = address, settings or Settings(), record
        self.lines = None
        self.log = []

    def open(self):
        if self.lines is None:
            self.lines = self.connect()

    def connect(self):
        parts = urlsplit(self.address)
        if parts.scheme == "replay":
            path = Path(self.address.removeprefix("replay://"))
            if not path.exists():
                raise ReplayError(f"no recording {path}")
            return iter(json.loads(path.read_text()))
        if parts.scheme != "sim":
            raise InstrumentError(f"nobody at {self.address}")
        return wire(parse_qs(parts.query).get("fault", [""])[0])

    def close(self):
        if self.lines is not None and self.record:
            self.record.write_text(json.dumps(self.log))
        self.lines = None

    def __enter__(self):
        self.open()
        return self

    def __exit__(self, *exc):
        self.close()

    def line(self):
        if self.lines is None:
            raise InstrumentError("the sensor is not open; use 'with'")
        text = ""
        while not text.endswith("\n"):
            piece = next(self.lines, None)
            if piece is None:
                raise InstrumentTimeoutError("the sensor is silent")
            self.log.append(piece)
            text += piece
        if text.startswith("refused"):
            self.refuse(text)
        return text

    def refuse(self, text):
        raise InstrumentError(f"the sensor refuses: {text}")

    def value(self, text):
        try:
            return float(text) + self.settings.offset
        except ValueError:
            return math.nan

    def identify(self):
        if self.lines is None:
            raise InstrumentError("the sensor is not open; use 'with'")
        return Identity("Nobody", "Sound 1", "0001", simulated=not self.address.startswith("tcp"))

    def read(self):
        return self.value(self.line().split()[1])

    def stream(self, block=None):
        first = None
        while True:
            values, invalid, dropped = [], 0, 0
            while len(values) < BLOCK:
                counter, text = self.line().split()
                first = int(counter) if first is None else first
                missing = int(counter) - first - len(values)
                values += [math.nan] * missing
                dropped += missing
                values.append(self.value(text))
                invalid += math.isnan(values[-1])
            yield self.block(values, first, dropped, invalid)
            first += len(values)

    def block(self, values, first, dropped, invalid):
        return Samples(np.array([values]), first, 100.0, time.monotonic(), dropped, {"no number": invalid})


def wire(fault):
    """Yield the received lines: 'counter value' in m, from the fourth line on with a fault."""
    for counter in range(1000):
        text = f"{counter} {1e-3 + 1e-6 * math.sin(counter):.9f}\n"
        if fault == "split":
            yield from text
        elif fault == "silence" and counter >= 3:
            return
        elif fault == "refuse" and counter >= 3:
            yield f"refused {counter}\n"
        elif fault == "garbage" and counter == 6:
            yield "6 0.x\n"
        elif not (fault == "drop" and 9 <= counter < 12):
            yield text


SOUND = InstrumentSubject(
    Sound, "sim://bench/sound", faults=("silence", "garbage", "refuse", "drop", "split"), time_limit=0.5
)


class TestSound(InstrumentConformance):
    subject = SOUND


class SaysNothingOfItself(Sound):
    info = replace(Sound.info, summary="")


class NamesNoMidRange(Sound):
    mid_range = None


class MeasuresItsRange(Sound):
    def measuring_range(self):
        return 0.0, 2e-3


class ReadsByNumber(Sound):
    def read(self, channel=None, *, unit):
        return super().read()


class StreamsWithoutBlocks(Sound):
    def stream(self, chunk=None):
        return super().stream()


class FillsWithoutStart(Sound):
    def fill(self, values, reasons):
        values[:], reasons[:] = 1e-3, 0


class SwallowsUnknownSettings(Sound):
    class Settings(Settings):
        model_config = ConfigDict(extra="ignore")

    def __init__(self, address, settings=None, *, record=None):
        super().__init__(address, settings or self.Settings(), record=record)


class HidesItsSerialNumber(Sound):
    def identify(self):
        return replace(super().identify(), serial_number="")


class PassesAsReal(Sound):
    def identify(self):
        return replace(super().identify(), simulated=False)


class OpensOnce(Sound):
    def open(self):
        if self.lines is not None:
            raise InstrumentError("open already")
        super().open()


class AttributeErrorBeforeOpen(Sound):
    def identify(self):
        return self.lines and super().identify()


class WaitsForever(Sound):
    def connect(self):
        if not self.address.startswith(("sim", "replay")):
            time.sleep(1.0)
        return super().connect()


class ReadsText(Sound):
    def read(self):
        value = super().read()
        return {"distance": None if value > 1e-3 else value}


class ReadsMillimetres(Sound):
    def value(self, text):
        return 1e3 * super().value(text)


class StreamsSinglePrecision(Sound):
    def block(self, values, first, dropped, invalid):
        sound = super().block(values, first, dropped, invalid)
        return replace(sound, values=sound.values.astype(np.float32))


class StartsEveryBlockAtZero(Sound):
    def block(self, values, first, dropped, invalid):
        return replace(super().block(values, first, dropped, invalid), first=0)


class TakesAPieceForALine(Sound):
    def line(self):
        if "fault=split" not in self.address:
            return super().line()
        return super().line().replace("9", "8")


class ClosesTheGap(Sound):
    """Puts the samples after a gap at the positions of the lost ones, and counts the loss at the end of the block."""

    def block(self, values, first, dropped, invalid):
        kept = [value for value in values if not math.isnan(value)] if dropped else values
        return super().block(kept + [math.nan] * dropped if dropped else kept, first, dropped, invalid)


class TakesGarbageForNumbers(Sound):
    def value(self, text):
        value = super().value(text)
        return 1e-3 if math.isnan(value) else value


class RaisesIndexErrors(Sound):
    def line(self):
        try:
            return super().line()
        except InstrumentTimeoutError:
            raise IndexError("list index out of range") from None


class ReplaysFromMemory(Sound):
    """Ignores the recording."""

    def connect(self):
        return wire("") if self.address.startswith("replay") else super().connect()


class BreaksAMember(Sound):
    @property
    def mid_range(self):
        return {}["range"]


class TakesARefusalForSilence(Sound):
    def refuse(self, text):
        raise InstrumentTimeoutError("the sensor is silent")


class LeavesAThread(Sound):
    ended = threading.Event()

    def open(self):
        super().open()
        threading.Thread(target=self.ended.wait, daemon=True).start()


class LeavesASocket(Sound):
    kept: ClassVar = deque()

    def open(self):
        super().open()
        self.kept.append(socket.socket())


BROKEN = [
    ("info_complete", SaysNothingOfItself),
    *(("kind_contract", plugin) for plugin in (NamesNoMidRange, MeasuresItsRange, StreamsWithoutBlocks)),
    ("kind_contract", FillsWithoutStart),
    ("settings_strict", SwallowsUnknownSettings),
    ("identify", HidesItsSerialNumber),
    ("identify", PassesAsReal),
    ("open_and_close_twice", OpensOnce),
    ("use_before_open", AttributeErrorBeforeOpen),
    ("no_device", WaitsForever),
    ("readings", ReadsText),
    ("plausible_magnitudes", ReadsMillimetres),
    ("stream_blocks", StreamsSinglePrecision),
    ("monotonic_time", StartsEveryBlockAtZero),
    ("split_reads", TakesAPieceForALine),
    ("counted_drops", ClosesTheGap),
    ("faults", TakesGarbageForNumbers),
    ("faults", RaisesIndexErrors),
    ("members", BreaksAMember),
    ("refusals", TakesARefusalForSilence),
    ("record_and_replay", ReplaysFromMemory),
    ("nothing_left", LeavesAThread),
    ("nothing_left", LeavesASocket),
]


@pytest.fixture(autouse=True)
def clean_up():
    LeavesAThread.ended.clear()
    yield
    LeavesAThread.ended.set()
    for line in LeavesASocket.kept:
        line.close()
    LeavesASocket.kept.clear()


@pytest.mark.parametrize(("check", "plugin"), BROKEN, ids=lambda value: getattr(value, "__name__", value))
def test_a_broken_instrument_fails_exactly_its_check(check, plugin):
    results = run_checks(replace(SOUND, plugin=plugin))
    failed = {result.name: result.message for result in results if not result.ok}
    assert failed.keys() == {check}


@pytest.mark.parametrize(
    ("plugin", "message"),
    [
        (NamesNoMidRange, "point_lds: 'mid_range' is missing"),
        (MeasuresItsRange, "'measuring_range' is a method, expected an attribute or property"),
        (ReadsByNumber, r"expected read\(\) -> 'float', found read\(channel=None, \*, unit\)"),
        (
            StreamsWithoutBlocks,
            r"expected stream\(block: 'int \| None' = None\).*, found stream\(chunk=None\) \(Streaming\)",
        ),
        (FillsWithoutStart, r"'lost' is missing \(Synchronised\)"),
    ],
)
def test_a_deviation_from_the_contract_is_stated_with_its_member(plugin, message):
    check = next(check for check in INSTRUMENT_CHECKS if check.name == "kind_contract")
    result = run_check(check, replace(SOUND, plugin=plugin))
    assert not result.ok
    assert re.search(message, result.message)


def test_an_unregistered_kind_has_no_contract_and_no_bounds():
    class Other(Sound):
        info = replace(Sound.info, kind="other_kind")

    results = {result.name: result for result in run_checks(replace(SOUND, plugin=Other))}
    assert results["kind_contract"].skipped
    assert "no kind 'other_kind' is registered" in results["kind_contract"].message
    assert results["plausible_magnitudes"].skipped


def test_for_every_check_a_plugin_fails():
    broken_at_the_wire = {"late_answers", "time_limit", "baudrate", "mutants"}  # see test_wire_checks.py
    assert {check for check, _ in BROKEN} | broken_at_the_wire == {check.name for check in INSTRUMENT_CHECKS}


def test_every_check_states_its_requirement():
    assert all(len(check.claim) > 30 for check in INSTRUMENT_CHECKS)


def test_a_check_that_hangs_fails_at_its_time_limit():
    class Hangs(Sound):
        def identify(self):
            time.sleep(0.6)
            return super().identify()

    check = next(check for check in INSTRUMENT_CHECKS if check.name == "identify")
    result = run_check(replace(check, limit=0.2), replace(SOUND, plugin=Hangs))
    assert not result.ok
    assert "still running after 0.2 s" in result.message


def test_checks_without_a_stream_do_not_apply_to_a_driver_without_one():
    ReadsOnly = type(
        "ReadsOnly", (), {k: v for k, v in vars(Sound).items() if k not in ("stream", "__dict__", "__weakref__")}
    )
    results = run_checks(InstrumentSubject(ReadsOnly, "sim://bench/sound", faults=()))
    assert [result.message for result in results if not result.ok] == []
    skipped = {result.name for result in results if result.skipped}
    of_streams = {"stream_blocks", "monotonic_time", "split_reads", "counted_drops", "faults"}
    assert skipped == of_streams | {"refusals", "late_answers", "time_limit", "baudrate"}


def test_faults_are_not_tried_with_a_real_device():
    assert replace(SOUND, address="serial:///dev/ttyUSB0").menu == ()
