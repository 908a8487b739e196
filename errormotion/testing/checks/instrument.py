"""Checks of instrument plugins."""
# ruff: noqa: D401 - the docstring of a check is its requirement

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from errormotion.errors import InstrumentError
from errormotion.plugins import InstrumentInfo, InstrumentSubject, Samples, kind_registry
from errormotion.testing.checks import fuzz as fuzz_checks
from errormotion.testing.checks import members as member_checks
from errormotion.testing.checks import shared
from errormotion.testing.checks import wire as wire_checks
from errormotion.testing.kit import CheckFailedError, Checks, require
from errormotion.testing.sessions import Session, first_blocks, leaves, numbers, open_things, require_same, run_session

INSTRUMENT_CHECKS: Checks[InstrumentSubject] = Checks()


def _no_stream(subject: InstrumentSubject) -> str:
    return "" if subject.streams else "the driver has no stream()"


def _no_faults(subject: InstrumentSubject) -> str:
    return "" if subject.menu else "the simulator has no faults"


def _no_bounds(subject: InstrumentSubject) -> str:
    return "" if subject.bounds else f"no plausible readings are stated for the kind '{subject.plugin.info.kind}'"


def _no_contract(subject: InstrumentSubject) -> str:
    return "" if kind_registry.kind(subject.plugin.info.kind) else f"no kind '{subject.plugin.info.kind}' is registered"


def _no_splitting(subject: InstrumentSubject) -> str:
    return "" if subject.split_fault in subject.menu else f"the simulator has no fault '{subject.split_fault}'"


def _no_dropping(subject: InstrumentSubject) -> str:
    if subject.drop_fault not in subject.menu:
        return f"the simulator has no fault '{subject.drop_fault}'"
    return _no_stream(subject)


ATTEMPTS = 3
"""Pairs of compared sessions: on a busy computer, a simulated device measures ahead by different amounts."""


@INSTRUMENT_CHECKS.add()
def info_complete(subject: InstrumentSubject) -> str:
    """Class attribute ``info`` states id, kind, summary, status and version, and its simulator loads."""
    info = subject.plugin.info
    shared.check_info(info, InstrumentInfo, "id", "kind")
    return f"{info.id} ({info.kind}), {info.status}"


@INSTRUMENT_CHECKS.add(why_not=_no_contract)
def kind_contract(subject: InstrumentSubject) -> str:
    """The driver has all members of the contract of its kind, and each accepts the arguments of the contract."""
    kind = subject.plugin.info.kind
    found = kind_registry.deviations(subject.build(), kind_registry.kind(kind))
    require(not found, f"{kind}: {'; '.join(found)}")
    return f"{kind}: {len(kind_registry.members(kind_registry.kind(kind)))} members"


@INSTRUMENT_CHECKS.add()
def settings_strict(subject: InstrumentSubject) -> str:
    """Settings are a PluginSettings, refuse unknown keys, and are unchanged after a round trip through JSON."""
    return shared.check_settings(subject.plugin.Settings, subject.build().settings)


@INSTRUMENT_CHECKS.add()
def identify(subject: InstrumentSubject) -> str:
    """The instrument states manufacturer, model and serial number, the same each time, and whether it is simulated."""
    with subject.build() as instrument:
        first = instrument.identify()
        found = shared.check_identity(first, instrument.identify())
    require(first.simulated == subject.simulated, f"identity.simulated is {first.simulated} at {subject.address}")
    return found


@INSTRUMENT_CHECKS.add()
def open_and_close_twice(subject: InstrumentSubject) -> str:
    """Opening and closing are idempotent, closing before opening has no effect, and reopening is possible."""
    instrument = subject.build()
    try:
        instrument.close()
        instrument.open()
        instrument.open()
        instrument.identify()
        instrument.close()
        instrument.close()
        with instrument as entered:
            require(entered is instrument, "'with instrument as x' does not return the instrument")
            instrument.identify()
    finally:
        instrument.close()
    return "opened and closed twice"


@INSTRUMENT_CHECKS.add()
def use_before_open(subject: InstrumentSubject) -> str:
    """Before opening and after closing, the instrument raises an InstrumentError."""
    instrument = subject.build()
    _require_refusals(instrument, "before open", subject.streams)
    with instrument:
        pass
    _require_refusals(instrument, "after close", subject.streams)
    return "refused before open and after close"


def _require_refusals(instrument: Any, when: str, streams: bool) -> None:
    uses = {"identify": instrument.identify, "read": instrument.read}
    if streams:
        uses["stream"] = lambda: next(iter(instrument.stream()))
    for name, use in uses.items():
        shared.require_refusal(use, f"{name}() {when}")


@INSTRUMENT_CHECKS.add()
def no_device(subject: InstrumentSubject) -> str:
    """Without a device, an instance can be created, and opening it raises a typed error within the time limit."""
    instrument = subject.build(address=subject.dead_address)

    def use() -> None:
        with instrument:
            instrument.identify()

    try:
        return shared.check_absent(use, subject.dead_address, subject.time_limit)
    finally:
        instrument.close()


@INSTRUMENT_CHECKS.add()
def readings(subject: InstrumentSubject) -> str:
    """A reading contains numbers, the same count each time; an unknown number is NaN, not None."""
    with subject.build() as instrument:
        three = [instrument.read() for _ in range(3)]
    require(
        all(leaf is not None for reading in three for leaf in leaves(reading)), "a reading contains None, expected NaN"
    )
    values = [numbers(reading) for reading in three]
    require(bool(values[0]), "read() returned no numbers")
    require(all(len(value) == len(values[0]) for value in values), "readings differ in their number of values")
    require(any(math.isfinite(value) for value in values[-1]), "the instrument without faults returned no finite value")
    return f"{len(values[0])} values a reading"


@INSTRUMENT_CHECKS.add(why_not=_no_bounds)
def plausible_magnitudes(subject: InstrumentSubject) -> str:
    """Readings and samples are in SI units: finite values are within plausible bounds."""
    low, high = subject.bounds or (-math.inf, math.inf)
    with subject.build() as instrument:
        values = np.array(numbers(instrument.read()))
        if subject.streams:
            values = np.concatenate([values, *(block.values.ravel() for block in first_blocks(instrument, 2))])
    values = values[np.isfinite(values)]
    require(values.size > 0, "no finite value")
    worst = values[np.argmax(np.maximum(low - values, values - high))]
    require(low <= worst <= high, f"expected {low:g} to {high:g} in SI units, found {worst:g}")
    return f"{values.min():g} to {values.max():g}"


@INSTRUMENT_CHECKS.add(why_not=_no_stream)
def stream_blocks(subject: InstrumentSubject) -> str:
    """A stream yields Samples: float64 of shape (channel, n), the same channels each time, a positive rate."""
    with subject.build() as instrument:
        blocks = first_blocks(instrument, subject.blocks)
    require(len(blocks) == subject.blocks, f"expected {subject.blocks} blocks, the stream ended after {len(blocks)}")
    for block in blocks:
        require(isinstance(block, Samples), f"expected Samples, found {type(block).__name__}")
        values = block.values
        require(values.dtype == np.float64, f"expected float64, found {values.dtype}")
        require(values.ndim == 2 and values.shape[1] > 0, f"expected shape (channel, n), found {values.shape}")
        require(values.shape[0] == blocks[0].values.shape[0], "the number of channels changes from block to block")
        require(block.rate > 0 and block.rate == blocks[0].rate, f"rates {blocks[0].rate} and {block.rate} /s")
    return f"{blocks[0].values.shape[0]} channels at {blocks[0].rate:g} /s"


@INSTRUMENT_CHECKS.add(why_not=_no_stream)
def monotonic_time(subject: InstrumentSubject) -> str:
    """Device counters have no gaps between blocks; host times do not decrease and are not in the future."""
    before = time.monotonic()
    with subject.build() as instrument:
        blocks = first_blocks(instrument, subject.blocks)
    after = time.monotonic()
    for block, following in pairwise(blocks):
        expected = block.first + block.values.shape[1]
        require(following.first == expected, f"a block starts at sample {following.first}, expected {expected}")
    times = [before, *(block.host_time for block in blocks), after]
    require(times == sorted(times), f"host times decrease, or are not from time.monotonic(): {times}")
    return f"{sum(block.values.shape[1] for block in blocks)} samples without a gap"


def _repeated(compare: Callable[[], str]) -> str:
    """Return the result of a comparison of two sessions; fail if all repetitions fail."""
    for _ in range(ATTEMPTS - 1):
        with suppress(CheckFailedError):
            return compare()
    return compare()


@INSTRUMENT_CHECKS.add(why_not=_no_splitting)
def split_reads(subject: InstrumentSubject) -> str:
    """Frames received in pieces result in the same values as complete frames."""

    def compare() -> str:
        whole, pieces = (run_session(subject, fault=fault) for fault in ("", subject.split_fault))
        require(whole.error is None, f"without a fault: {whole.error!r}")
        require(pieces.error is None, f"split frames raised {pieces.error!r}")
        one, other = (session.stream if subject.streams else session.read for session in (whole, pieces))
        require_same(one, other, "split frames changed the values")
        return f"{one.size} equal values"

    return _repeated(compare)


@INSTRUMENT_CHECKS.add(why_not=_no_dropping)
def counted_drops(subject: InstrumentSubject) -> str:
    """Samples that the device omits are NaN at their positions, and counted; other positions are unchanged."""
    later = f"{subject.drop_fault}&fault_at=10"  # a sample lost before the first one cannot be counted

    def compare() -> str:
        whole, holes = (run_session(subject, fault=fault) for fault in ("", later))
        if isinstance(holes.error, InstrumentError):
            return f"the driver stops: {type(holes.error).__name__}"
        require(holes.error is None, f"{holes.error!r}")
        missing = int(np.isnan(holes.stream).sum())
        require(holes.dropped > 0, f"no drop was counted; {missing} values are NaN")
        require(missing >= holes.dropped, f"{holes.dropped} drops counted, but only {missing} values are NaN")
        n = min(whole.stream.shape[1], holes.stream.shape[1])
        seen = np.isfinite(holes.stream[:, :n]) & np.isfinite(whole.stream[:, :n])
        same = whole.stream[:, :n][seen] == holes.stream[:, :n][seen]
        require(
            bool(same.all()), f"{(~same).sum()} of {same.size} values are not at the positions of the device counter"
        )
        return f"{holes.dropped} of {holes.stream.size} values lost and counted"

    return _repeated(compare)


@INSTRUMENT_CHECKS.add(limit=90.0, why_not=_no_faults)
def faults(subject: InstrumentSubject) -> str:
    """Each fault causes a typed error within the time limit, or a counted loss if the data continue."""
    seen: list[str] = []
    wrong: list[str] = []
    sound = run_session(subject)
    for fault in subject.menu:
        outcome = run_session(subject, fault=fault)
        complaint = _complaint(outcome, sound, subject, harmless=fault in subject.harmless)
        (wrong if complaint else seen).append(f"{fault}: {complaint or outcome.summary}")
    require(not wrong, "; ".join(wrong))
    return "; ".join(seen)


def _complaint(outcome: Session, sound: Session, subject: InstrumentSubject, harmless: bool) -> str:
    if outcome.error is not None and not isinstance(outcome.error, InstrumentError):
        return f"expected an InstrumentError, found {outcome.error!r}"
    if outcome.error is not None and outcome.seconds > subject.time_limit:
        return f"{outcome.summary}, limit {subject.time_limit:g} s"
    noticed = outcome.error is not None or outcome.lost > sound.lost or outcome.unread > sound.unread
    if harmless and noticed:
        return f"expected no effect: {outcome.summary}"
    if not harmless and not noticed:
        return "not detected: no error, and no loss counted"
    if outcome.unexplained:
        return f"{outcome.unexplained} values are NaN without a count or a reason"
    return ""


INSTRUMENT_CHECKS.add(limit=60.0, why_not=member_checks.no_members)(member_checks.members)
INSTRUMENT_CHECKS.add(limit=60.0, why_not=member_checks.no_refusals)(member_checks.refusals)
INSTRUMENT_CHECKS.add(limit=60.0, why_not=wire_checks.no_late_answers)(wire_checks.late_answers)
INSTRUMENT_CHECKS.add(why_not=wire_checks.no_time_limit)(wire_checks.time_limit)
INSTRUMENT_CHECKS.add(why_not=wire_checks.no_baudrate)(wire_checks.baudrate)


@INSTRUMENT_CHECKS.add()
def record_and_replay(subject: InstrumentSubject) -> str:
    """A replayed session has the same identity, readings and samples as its recording; other requests are refused."""
    with TemporaryDirectory() as folder:
        record = Path(folder) / "session.rec"
        original = run_session(subject, record=record)
        require(original.error is None, f"recording: {original.error!r}")
        files = list(Path(folder).iterdir())  # an instrument with several devices writes several files
        require(any(file.stat().st_size > 0 for file in files), "nothing was recorded")
        replayed = run_session(subject, address=f"replay://{record}")
        require(replayed.error is None, f"replaying: {replayed.error!r}")
        a, b = original.identity, replayed.identity
        same = (a.manufacturer, a.model, a.serial_number) == (b.manufacturer, b.model, b.serial_number)
        require(same, f"the identity changed from {a} to {b}")
        require_same(original.stream, replayed.stream, "the replayed stream differs from the recorded one")
        require_same(original.read, replayed.read, "replayed readings differ from the recorded ones")
        for file in files:
            file.unlink()
        gone = run_session(subject, address=f"replay://{record}")
        require(isinstance(gone.error, InstrumentError), f"without recording, the replay has the result {gone.summary}")
    return f"{original.stream.size + original.read.size} equal values"


INSTRUMENT_CHECKS.add(limit=fuzz_checks.limit, why_not=fuzz_checks.no_mutants)(fuzz_checks.mutants)


@INSTRUMENT_CHECKS.add()
def nothing_left(subject: InstrumentSubject) -> str:
    """After closing, also during a stream or after an error, no thread, socket or port is left open."""
    before = open_things()
    run_session(subject)
    if subject.streams:
        instrument = subject.build()
        with instrument:
            stream = iter(instrument.stream())
            next(stream)
        del stream
    for fault in subject.menu[-1:]:
        run_session(subject, fault=fault)
    return shared.check_nothing_open(before)
