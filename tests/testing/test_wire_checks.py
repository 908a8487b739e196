"""A driver that uses late answers, or ignores its time limit or baud rate, fails only the check for it."""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from coded import raises
from pydantic import Field

from errormotion.datasets.units import Time
from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.controller.virtual import VirtualController, decode_answer, encode_request
from errormotion.instruments.driver import Driver
from errormotion.instruments.point_lds.keyence_lk import KeyenceLK
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.thermometer.modbus_temperature import ModbusTemperature
from errormotion.instruments.transports import Address, Transport, open_transport, parse_address
from errormotion.instruments.transports.modbus.client import ModbusLine
from errormotion.instruments.transports.serial_line import SerialTransport
from errormotion.plugins import Identity, InstrumentInfo, PluginSettings
from errormotion.testing import InstrumentConformance, InstrumentSubject, run_checks
from errormotion.testing.checks import fuzz as fuzz_checks
from errormotion.testing.checks import wire as wire_checks
from errormotion.testing.kit import CheckFailedError

ADDRESS = "sim://cframe/dial?seed=3"


class DialSettings(PluginSettings):
    timeout: Time = Field(1.0, gt=0)
    baudrate: int = Field(9600, gt=0)


class Dial(Driver):
    """It answers ``R`` with a distance in m, and ``N`` with its name. Answers have no number."""

    info = InstrumentInfo(
        "dial",
        "point_lds",
        "A dial that answers lines of text",
        "simulated_only",
        simulator=f"{__name__}:SimulatedDial",
    )
    Settings = DialSettings
    measuring_range, mid_range = (0.0, 2e-3), 1e-3

    def identify(self) -> Identity:
        return Identity("Nobody", "Dial", self.ask("N"), simulated=self.transport.simulated)

    def read(self) -> float:
        text = self.ask("R")
        try:
            return float(text)
        except ValueError:
            raise ProtocolError(f"expected a number, found {text!r}") from None

    def ask(self, request: str) -> str:
        with self.exchange() as line:
            line.write(request.encode() + b"\r")
            text = line.read_until(b"\r")[:-1].decode(errors="replace")
            if not text.isascii() or (request == "N") != text.startswith("dial"):
                raise ProtocolError(f"expected an answer to {request!r}, found {text!r}")
            return text


class SimulatedDial(SimulatedDevice):
    faults = ("silence", "split", "late")

    def __init__(self, address: Address) -> None:
        super().__init__(address, line_end=b"\r", default_name="dial")

    def answer(self, request: bytes) -> bytes:
        return b"dial 7\r" if request == b"N" else f"{1e-3 + 1e-6 * self._answers:.6f}\r".encode()


class TestDial(InstrumentConformance):
    subject = InstrumentSubject(Dial, ADDRESS)


class TestDialOnALine(InstrumentConformance):
    subject = InstrumentSubject(Dial, f"{ADDRESS}&wire=pty", faults=("silence", "split"))


class TakesTheLateAnswer(Dial):
    @contextmanager
    def exchange(self) -> Iterator[Transport]:
        yield self.transport


class DiscardsWhatIsThereOnly(Dial):
    def resynchronise(self) -> None:
        pass


class HasItsOwnTimeLimit(Dial):
    def _connect(self) -> Transport:
        simulator, speed = self.info.simulator, self.settings.baudrate
        return open_transport(self.address, simulator=simulator, recorder=self._record, baudrate=speed)


class HasItsOwnBaudrate(Dial):
    def _connect(self) -> Transport:
        simulator, limit = self.info.simulator, self.settings.timeout
        return open_transport(self.address, simulator=simulator, recorder=self._record, timeout=limit)


class RaisesValueErrors(Dial):
    def read(self) -> float:
        return float(self.ask("R"))


class TakesAnySize(Dial):
    """Uses a received number as the size of an array."""

    def read(self) -> float:
        value = super().read()
        return value if abs(value) < 1.0 else float(np.ones(int(min(abs(value), 2e7))).sum())


class NeedsTime(Dial):
    """Searches long for a number in a line of unknown format."""

    def read(self) -> float:
        try:
            return super().read()
        except ProtocolError:
            end = time.thread_time() + 0.08
            while time.thread_time() < end:
                pass
            raise


class NeedsMemory(Dial):
    def read(self) -> float:
        try:
            return super().read()
        except ProtocolError:
            np.ones(1 << 20)
            raise


class Hangs(Dial):
    def read(self) -> float:
        try:
            return super().read()
        except ProtocolError:
            time.sleep(5.0)
            raise


class AsksTwice(Dial):
    """Opens with a request, so that a silent device is detected."""

    def _start_session(self) -> None:
        self.identify()


class WithItsOwnTimeLimit(HasItsOwnTimeLimit, AsksTwice):
    pass


class WithItsOwnBaudrate(HasItsOwnBaudrate, AsksTwice):
    pass


@pytest.mark.parametrize(
    ("check", "plugin"),
    [
        ("late_answers", TakesTheLateAnswer),
        ("late_answers", DiscardsWhatIsThereOnly),
        ("time_limit", WithItsOwnTimeLimit),
        ("baudrate", WithItsOwnBaudrate),
        ("mutants", RaisesValueErrors),
        ("mutants", TakesAnySize),
    ],
)
def test_a_broken_driver_fails_exactly_its_check(check: str, plugin: type[Dial]) -> None:
    subject = InstrumentSubject(plugin, ADDRESS, mutants=100 if check == "mutants" else 0)
    failed = {result.name for result in run_checks(subject) if not result.ok}
    assert failed == {check}


@pytest.mark.parametrize(
    ("plugin", "limit", "message"),
    [
        (NeedsTime, 5.0, "ms of processor time more than the recorded session"),
        (NeedsMemory, 5.0, "KiB, limit"),
        (Hangs, 0.2, r"took 0\.\d s, limit 0.2 s"),
    ],
)
def test_a_driver_with_excessive_time_or_memory_for_a_damaged_frame_fails(
    plugin: type[Dial], limit: float, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuzz_checks, "MEASURED", 2)
    subject = InstrumentSubject(plugin, ADDRESS, mutants=100, time_limit=limit)
    with pytest.raises(CheckFailedError, match=message):
        fuzz_checks.mutants(subject)


def test_the_requested_number_of_mutants_is_tried_without_a_total_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fuzz_checks, "MUTANTS", 20)
    monkeypatch.setattr(fuzz_checks, "BUDGET", 0.0)
    few, many = (InstrumentSubject(Dial, ADDRESS, mutants=number) for number in (20, 60))
    assert fuzz_checks.mutants(few).startswith("0 mutants")
    assert fuzz_checks.mutants(many).startswith("60 mutants")
    assert (fuzz_checks.limit(few), fuzz_checks.limit(many)) == (fuzz_checks.LIMIT, math.inf)


class TakesAnyLine(KeyenceLK):
    def _query(self, request: str, header: str | None = None) -> str:
        self._synchronised = True  # whatever was missed
        return super()._query(request, header)


class TakesAnyNumber(VirtualController):
    def _call(self, op: str, **arguments: object) -> object:
        self.transport.write(encode_request(1, op, arguments))
        answer = self.transport.read_until(b"\n", limit=1 << 16)
        return decode_answer(answer, 1).result


class TakesAnyRegisters(ModbusTemperature):
    def _connect(self) -> ModbusLine:
        line = super()._connect()
        line._await_late_answer = lambda *_: None  # type: ignore[method-assign]
        return line


@pytest.mark.parametrize(
    ("sound", "broken"),
    [
        (KeyenceLK.conformance(), TakesAnyLine),
        (VirtualController.conformance(), TakesAnyNumber),
        (
            replace(ModbusTemperature.conformance(), address="sim://cframe?seed=3&noise=1&wire=pty"),
            TakesAnyRegisters,
        ),
    ],
    ids=lambda each: getattr(each, "__name__", "sound"),
)
def test_a_used_late_answer_is_detected_with_different_readings(sound: InstrumentSubject, broken: type) -> None:
    assert wire_checks.late_answers(sound).count("correct readings") == 2
    with pytest.raises(CheckFailedError, match="was used for the next request"):
        wire_checks.late_answers(replace(sound, plugin=broken))


def test_equal_readings_can_be_varied() -> None:
    class Still(Dial):
        """Has a resolution of only 0.1 mm."""

        def read(self) -> float:
            return round(super().read(), 4)

    subject = InstrumentSubject(Still, ADDRESS)
    assert wire_checks.late_answers(subject).count("equal readings, so that their order is unknown: state 'vary'") == 2
    assert wire_checks.late_answers(replace(subject, repeats=True)).count("repeats lost readings") == 2

    moved: list[int] = []
    found = wire_checks.late_answers(replace(subject, plugin=Dial, vary=moved.append))
    assert found.count("correct readings") == 2
    assert moved[: wire_checks.READINGS] == list(range(wire_checks.READINGS))


@pytest.mark.parametrize("wire", ["tcp", "pty"])
def test_readings_have_the_correct_order_after_a_late_answer(wire: str) -> None:
    address = f"{ADDRESS}&wire={wire}&fault=late&fault_at=2&late_by=0.3"
    with Dial(address, DialSettings(timeout=0.2)) as dial:
        assert [dial.read(), dial.read()] == [0.001, 0.001001]
        with pytest.raises(InstrumentTimeoutError):
            dial.read()
        assert [dial.read(), dial.read()] == [0.001003, 0.001004]


def test_a_very_late_answer_is_lost_with_its_connection() -> None:
    with Dial(f"{ADDRESS}&fault=late&fault_at=1", DialSettings(timeout=0.2)) as dial:
        dial.read()
        with pytest.raises(InstrumentTimeoutError):
            dial.read()
        assert dial.read() == 0.001002


def test_a_device_that_does_not_stop_sending_is_an_error() -> None:
    class Babbling(SimulatedDial):
        def answer(self, request: bytes) -> bytes:
            return b"?" * 100_000 if request == b"R" else b"dial 7\r"

        def reply(self, data: bytes) -> None:
            for _ in range(30):
                super().reply(data)

    globals()["Babbling"] = Babbling

    class Asking(Dial):
        info = InstrumentInfo(
            "asking", "point_lds", "Asks a device that babbles", "simulated_only", simulator=f"{__name__}:Babbling"
        )

    with Asking(ADDRESS, DialSettings(timeout=0.2)) as dial:
        with pytest.raises(ProtocolError):
            dial.read()
        with raises("protocol.unrequested"):
            dial.read()


def test_settings_are_passed_to_the_transport_by_the_base_class(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, object] = {}

    def opened(self: SerialTransport, address: Address, **options: object) -> None:
        given.update(options, url=address.url)
        raise InstrumentError("no such line")

    monkeypatch.setattr(SerialTransport, "__init__", opened)
    with raises("instrument.other"):
        Dial("serial:///dev/ttyUSB7", DialSettings(timeout=0.7, baudrate=57600)).open()
    assert given == {"url": "serial:///dev/ttyUSB7", "timeout": 0.7, "baudrate": 57600}
    assert parse_address("serial:///dev/ttyUSB7?baudrate=300").params == {"baudrate": "300"}
