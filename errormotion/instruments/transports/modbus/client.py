"""Modbus client: reading and writing registers on one line.

* ``modbus+tcp://192.168.0.9:502?unit=1`` Modbus TCP
* ``modbus+rtu:///dev/ttyUSB0?baudrate=9600&unit=1`` RTU on a serial line, 8N1
* ``modbus+rtu-tcp://192.168.0.9:4001?unit=1`` RTU frames through a serial server
* ``sim://cframe/logger?framing=rtu`` a simulated device; ``replay://session.rec`` a recorded session

Frames are built and read by PDUs and framers of pymodbus (`modbus.codec`) over the byte transports, so that sessions
can be recorded and replayed, and faults can be distinguished: the client of pymodbus owns its socket, and waits in
vain after a wrong checksum as after silence.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from errormotion.errors import InstrumentError, InstrumentTimeoutError, ProtocolError
from errormotion.instruments.transports.address import MODBUS, Address, parse_address
from errormotion.instruments.transports.base import Transport
from errormotion.instruments.transports.modbus.codec import (
    WRITE_SEVERAL,
    Framing,
    ModbusRefusal,
    decode_answer,
    decode_written,
    encode_request,
    encode_write,
    missing,
)
from errormotion.instruments.transports.quiet import after_others, await_quiet, discard_input
from errormotion.instruments.transports.reconnecting import disconnect_after_timeout, open_reconnecting
from errormotion.instruments.transports.recording import read_recording

QUIET_INTERVAL = 0.05  # s without a byte after which a transmission has ended
MAX_STRAY_BYTES = 512  # largest number of bytes discarded after a damaged answer
MAX_LATE_ANSWERS = 8  # largest number of answers skipped after a timeout
READ_HOLDING = 3

Encode = Callable[[int], bytes]
"""Returns a request with a transaction number."""
Decode = Callable[[bytes, int], list[int] | None]
"""Returns the registers of an answer to a transaction; None for a late answer to an earlier one."""


class ModbusLine(Transport):
    """A Modbus client on one line.

    Parameters
    ----------
    line : Transport
        Bytes to and from the device.
    framing : str
        ``tcp`` or ``rtu``.
    unit : int
        Address of the device.
    retries : int
        Number of repeated requests after a damaged answer.

    Attributes
    ----------
    framing, unit
        See the parameters.
    repeated : int
        Number of repeated requests.
    """

    def __init__(self, line: Transport, framing: Framing, unit: int, retries: int = 0) -> None:
        super().__init__(line.url, line.timeout)
        self.flow_control, self.simulated = line.flow_control, line.simulated
        self.framing, self.unit, self.repeated = framing, unit, 0
        self._line, self._retries, self._number = line, retries, 0
        self._unanswered_at: float | None = None
        self._passed_over = False  # whether the last unanswered request was that of `_skip_late_answers`

    def registers(self, function: int, register: int, count: int) -> list[int]:
        """Return ``count`` registers from ``register`` on, by function 3 (holding) or 4 (input).

        Raises
        ------
        ModbusRefusal
            The device answers with an exception.
        ProtocolError
            A damaged answer, also in the last retry: stray bytes, wrong checksum, another unit, too short.
        InstrumentTimeoutError
            No answer within the time limit.
        InstrumentError
            The connection is lost; the next call connects again.
        """
        return self._repeated(
            f"function {function} of unit {self.unit} for {count} registers from {register} on",
            lambda number: encode_request(self.framing, self.unit, function, register, count, number),
            lambda data, number: decode_answer(self.framing, data, self.unit, function, count, number),
            lambda: self._await_late_answer(function, register, count),
        )

    def write_registers(self, register: int, values: Sequence[int], *, function: int = WRITE_SEVERAL) -> None:
        """Write registers from ``register`` on: one by function 6, up to 123 by function 16 (the default).

        After a damaged answer it is unknown whether they were written; the retries write the same values again.

        Raises
        ------
        ModbusRefusal, ProtocolError, InstrumentTimeoutError, InstrumentError
            See `registers`.
        """
        self._repeated(
            f"function {function} of unit {self.unit} for {len(values)} registers from {register} on",
            lambda number: encode_write(self.framing, self.unit, function, register, values, number),
            lambda data, number: decode_written(self.framing, data, self.unit, function, register, values, number),
            lambda: self._await_late_answer(READ_HOLDING, register, len(values)),
        )

    def _repeated(self, what: str, encode: Encode, decode: Decode, prepare: Callable[[], None]) -> list[int]:
        for attempt in range(self._retries + 1):
            try:
                return self._exchange(what, encode, decode, prepare)
            except ProtocolError:
                if attempt == self._retries:
                    raise
                self.repeated += 1
        raise AssertionError  # not reached

    def _exchange(self, what: str, encode: Encode, decode: Decode, prepare: Callable[[], None]) -> list[int]:
        prepare()
        self._number = (self._number + 1) % (1 << 16)
        asked = encode(self._number)
        self._line.write(asked)
        end, others, answer = time.monotonic() + self.timeout, 0, b""
        try:
            while True:
                answer = self._frame(end)
                found = decode(answer, self._number)
                if found is not None:
                    return found
                others += 1
        except ModbusRefusal as error:
            raise ModbusRefusal(error.number, f"{self.url}: {what}") from None
        except ProtocolError as error:
            self._settle()
            echo = ". The line returns the request: set 'echo' to true" if answer and asked.startswith(answer) else ""
            raise ProtocolError(f"{self.url}: {error}{echo}", code=error.code) from None
        except InstrumentTimeoutError as error:
            self._unanswered_at, self._passed_over = time.monotonic(), False
            disconnect_after_timeout(self._line)
            raise after_others(error, others, what) from None

    def _await_late_answer(self, function: int, register: int, count: int) -> None:
        """Discard unread bytes; after a timeout, ensure that no late answer is mistaken for the next one.

        An RTU frame has no number. Bytes that arrive within a further time limit are discarded. If none arrive, another
        number of registers is read, so that its answer and an even later one differ in length. If the device does not
        answer this request, the next request is sent without it.
        """
        since, self._unanswered_at = self._unanswered_at, None
        if since is None or self.framing == "tcp":
            discard_input(self._line)
            return
        try:
            try:
                if await_quiet(self._line, self.timeout, since):
                    return
            except ProtocolError:
                raise
            except InstrumentError:  # the connection was dropped, and the answer with it
                return
            if not self._passed_over:
                self._skip_late_answers(function, register, 1 if count > 1 else 2)
        except (ProtocolError, InstrumentTimeoutError) as error:
            self._unanswered_at = time.monotonic()
            self._passed_over = isinstance(error, InstrumentTimeoutError)
            raise

    def _skip_late_answers(self, function: int, register: int, count: int) -> None:
        """Request a number of registers and skip answers until the answer to this request, or its refusal."""
        self._line.write(encode_request(self.framing, self.unit, function, register, count))
        end = time.monotonic() + self.timeout
        for others in range(MAX_LATE_ANSWERS):
            try:
                decode_answer(self.framing, self._frame(end), self.unit, function, count)
            except InstrumentTimeoutError as error:
                raise after_others(error, others, f"function {function} for {count} registers") from None
            except ModbusRefusal:
                return
            except ProtocolError:
                continue
            return
        raise ProtocolError(
            f"{self.url}: {MAX_LATE_ANSWERS} answers to earlier requests; expected one", code="protocol.reply.other"
        )

    def _frame(self, end: float) -> bytes:
        """Return one answer, with the length stated in its start."""
        data = b""
        while lacking := missing(self.framing, data):
            try:
                data += self._line.read(lacking, timeout=max(end - time.monotonic(), 0.0))
            except InstrumentTimeoutError:
                if data:
                    raise ProtocolError(
                        f"Expected {lacking} more bytes within {self.timeout:g} s; found {data[:24].hex(' ')}",
                        code="protocol.reply.length",
                    ) from None
                raise InstrumentTimeoutError(
                    f"{self.url}: unit {self.unit} did not answer within {self.timeout:g} s",
                    code="instrument.no_answer",
                ) from None
        return data

    def _settle(self) -> None:
        """Wait until the line is quiet, so that the rest of this answer is not mistaken for the next one."""
        count = 0
        with suppress(InstrumentError):
            while count < MAX_STRAY_BYTES:
                count += len(self._line.read(MAX_STRAY_BYTES, timeout=QUIET_INTERVAL))

    def _send(self, data: bytes) -> None:
        self._line.write(data)

    def _receive(self, max_bytes: int, timeout: float) -> bytes:
        return self._line.read(max_bytes, timeout)

    def close(self) -> None:
        """Close the line; idempotent."""
        self._line.close()


def open_modbus(
    url: str,
    *,
    unit: int = 1,
    simulator: str | None = None,
    record: Path | None = None,
    timeout: float = 1.0,
    retry: float = 1.0,
    retries: int = 0,
    baudrate: int | None = None,
    echo: bool = False,
    zeros: bool = False,
) -> ModbusLine:
    """Open the Modbus line at an address; its ``unit`` and ``baudrate`` take precedence.

    Parameters
    ----------
    url : str
        See the module.
    unit, retries
        See `ModbusLine`.
    simulator, record, timeout, retry, baudrate, echo, zeros
        See `open_reconnecting`; ``echo`` and ``zeros`` have no effect on Modbus TCP.

    Raises
    ------
    InstrumentError
        No device answers, or the address is not for Modbus.
    """
    address = parse_address(url)
    device = original(address)
    framing, unit = framing_of(device), device.whole("unit", unit, 255)
    wires = {"echo": echo, "zeros": zeros} if framing == "rtu" else {}
    line = open_reconnecting(
        _of_bytes(address), simulator=simulator, record=record, timeout=timeout, retry=retry, baudrate=baudrate, **wires
    )
    return ModbusLine(line, framing, unit, retries)


def original(address: Address) -> Address:
    """Return the address of the device, also from the address of a recording."""
    return parse_address(read_recording(Path(address.path))[0]) if address.scheme == "replay" else address


def framing_of(address: Address) -> Framing:
    """Return the framing at an address."""
    if address.scheme == "sim":
        serial = address.params.get("wire") == "pty"
        framing = address.params.get("framing", "rtu" if serial else "tcp")
        if framing not in ("tcp", "rtu") or (serial and framing == "tcp"):
            raise InstrumentError(
                f"'framing' in '{address.url}': expected 'tcp' or 'rtu', and 'rtu' on a pty", code="address.form"
            )
        return "rtu" if framing == "rtu" else "tcp"
    if address.scheme not in MODBUS:
        raise InstrumentError(
            f"Expected an address for Modbus, such as modbus+tcp://HOST:502?unit=1, modbus+rtu:///dev/NAME?unit=1 or "
            f"modbus+rtu-tcp://HOST:PORT?unit=1; found '{address.url}'",
            code="address.form",
        )
    return "tcp" if address.scheme == "modbus+tcp" else "rtu"


def _of_bytes(address: Address) -> Address:
    """Return the address of the byte transport; its URL remains that in the bench file."""
    if address.scheme == "modbus+rtu":
        return replace(address, scheme="serial")
    return replace(address, scheme="tcp") if address.scheme in MODBUS else address
