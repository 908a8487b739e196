"""A compensator with one fault fails the check for it."""

import json
import re
import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

from errormotion.errors import InstrumentError
from errormotion.instruments.compensator.modbus_registers import ModbusRegisters
from errormotion.instruments.compensator.offset_file import OffsetFile
from errormotion.plugins import Applied, CompensatorSubject
from errormotion.testing import CompensatorConformance
from errormotion.testing.checks.compensator import COMPENSATOR_CHECKS
from errormotion.testing.kit import CheckResult, run_check


def outcome(cls: type, name: str, **more: Any) -> CheckResult:
    subject = replace(CompensatorSubject(cls, dead_address="/nonexistent/offset.json"), **more)
    (check,) = [check for check in COMPENSATOR_CHECKS if check.name == name]
    return run_check(check, subject)


class WritesOnOpening(OffsetFile):
    def open(self) -> None:
        super().open()
        self.arm(1e-6)
        self.write((0.0, 0.0, 0.0))


class SwapsAxes(OffsetFile):
    def write(self, offset: Sequence[float]) -> None:
        super().write(tuple(offset)[::-1])


class WrongSign(OffsetFile):
    def read(self) -> Applied:
        found = super().read()
        return replace(found, offset=tuple(-x for x in found.offset))  # type: ignore[arg-type]


class NeedsNoArming(OffsetFile):
    def open(self) -> None:
        super().open()
        self._interlock.limit = 1.0


class WritesChangesOnly(OffsetFile):
    last: Any = None

    def write(self, offset: Sequence[float]) -> None:
        if offset != self.last:
            super().write(offset)
        self.last = offset


class ZeroOnClosing(OffsetFile):
    def close(self) -> None:
        if self._open and self._interlock.limit:
            super().write((0.0, 0.0, 0.0))
        super().close()


class RepeatsTheLastNumber(OffsetFile):
    def open(self) -> None:
        super().open()
        self._number = max(self._number - 1, 0)


class AnswersUnopened(OffsetFile):
    def read(self) -> Applied:
        self.open()
        return super().read()


class SaysNothingOfStops(OffsetFile):
    def read(self) -> Applied:
        return replace(super().read(), fault="")


class RaisesForeignErrors(OffsetFile):
    def read(self) -> Applied:
        try:
            return super().read()
        except InstrumentError as error:
            raise ValueError(str(error)) from None


class OverlooksDamage(OffsetFile):
    def read(self) -> Applied:
        try:
            return super().read()
        except InstrumentError:
            return Applied((0.0, 0.0, 0.0))


class LeavesThread(OffsetFile):
    def open(self) -> None:
        super().open()
        threading.Thread(target=threading.Event().wait, args=(6.0,), daemon=True).start()


class ForgetsTheOther(OffsetFile):
    def open(self) -> None:
        super().open()
        if self.path.exists():
            content = json.loads(self.path.read_text())
            self.path.write_text(json.dumps({**content, "number": 0, "X": 0.0}))
            threading.Event().wait(0.05)


class WithoutArm(OffsetFile):
    arm = None  # type: ignore[assignment]


@pytest.mark.parametrize(
    ("cls", "check", "text"),
    [
        (WithoutArm, "members", "'arm' is missing"),
        (WritesOnOpening, "nothing_on_connecting", "expected no command, found 1"),
        (SwapsAxes, "arrives", "expected 6.0000, -4.0000, 2.0000 um, found 2.0000"),
        (WrongSign, "arrives", "found -6.0000, 4.0000, -2.0000 um"),
        (NeedsNoArming, "refused_orders", r"write\(\) unarmed: expected an InstrumentError, found none"),
        (WritesChangesOnly, "heartbeat", "the machine received nothing after write"),
        (ZeroOnClosing, "closed", "closing sent a command"),
        (RepeatsTheLastNumber, "restart", "the machine received nothing after write"),
        (AnswersUnopened, "use_before_open", "expected an InstrumentError, found none"),
        (SaysNothingOfStops, "states", "fault is not reported"),
        (RaisesForeignErrors, "faults", "garbage: expected an InstrumentError, found ValueError"),
        (OverlooksDamage, "faults", "garbage: not detected"),
        (LeavesThread, "nothing_left", "still open: thread"),
        (ForgetsTheOther, "two_connections", "the second connection sent a command"),
    ],
    ids=lambda value: value.__name__ if isinstance(value, type) else "",
)
def test_it_fails(cls: type, check: str, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("errormotion.testing.compensator_sessions.ARRIVAL", 0.5)
    result = outcome(cls, check)
    assert not result.ok
    assert re.search(text, result.message), result.message


class TrustsTheWire(ModbusRegisters):
    def read(self) -> Applied:
        try:
            return super().read()
        except InstrumentError as error:
            raise ValueError(str(error)) from None


def test_an_error_of_another_kind_is_found_by_changed_frames() -> None:
    (check,) = [check for check in COMPENSATOR_CHECKS if check.name == "mutants"]
    result = run_check(check, replace(ModbusRegisters.conformance()[0], plugin=TrustsTheWire))
    assert not result.ok
    assert "expected an InstrumentError, found ValueError" in result.message


def test_nothing_is_written_to_a_real_machine(tmp_path) -> None:
    address = str(tmp_path / "offset.json")
    results = [
        run_check(check, replace(CompensatorSubject(OffsetFile), address=address)) for check in COMPENSATOR_CHECKS
    ]
    skipped = {result.name for result in results if result.skipped}
    assert {"arrives", "heartbeat", "refused_orders", "lost_connection", "faults"} <= skipped
    assert "open_and_close_twice" not in skipped
    assert list(tmp_path.iterdir()) == []


class TestAsAClass(CompensatorConformance):
    subject = CompensatorSubject(OffsetFile, dead_address="/nonexistent/offset.json", faults=("garbage",))


def test_a_class_has_one_test_for_each_check_that_applies() -> None:
    names = {check.name for check in COMPENSATOR_CHECKS} - {"lost_connection", "mutants"}
    assert {name for name in vars(TestAsAClass) if name.startswith("test_")} == {f"test_{name}" for name in names}
