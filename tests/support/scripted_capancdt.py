"""A controller that answers from a table: what a driver of a capaNCDT 6200 sends and gets, byte by byte."""

from __future__ import annotations

import re
import threading

import numpy as np

from errormotion.instruments.point_lds.capancdt.blocks import HEADER
from errormotion.instruments.transports.loopback.serving import TcpServer

WELCOME = b"Welcome to capaNCDT 6200\r\nDevice:DT6230\r\nS/N:1234\r\n"
CHANNEL = "ANO2303018,NAMDL6230,SNO0815,OFS0,RNG2000,UNTµm"


class ScriptedController:
    """Answers commands from ``answers`` (without echo and ``OK``), refuses others; sends blocks on its data port.

    Each GMD sends the next of ``readings``, then ``always``; TRG0 sends ``blocks``. The next command that is in
    ``late`` is carried out and answered when another one comes, ahead of it.
    """

    def __init__(self, **answers: str) -> None:
        self.answers = {
            "TRG?": "1",
            "TRG0": "",
            "TRG1": "",
            "CHS": "1,1,0,0",
            "CHI1": f":{CHANNEL}",
            "CHI2": f":{CHANNEL.replace('2000', '500')}",
            "AVT?": "0",
            "STI?": "1000",
            "LIN?": "0,0,0,0",
            "COI": "ANO2404072,NAMDT6230,SNO1234,OPT000,VER1.2a",
            "GMD": "",
            **answers,
        }
        self.echo = True
        self.received: list[str] = []
        self.readings: list[bytes] = []
        self.always = b""
        self.late: set[str] = set()
        self._held: list[str] = []
        self.blocks: list[bytes] = []
        self.welcomed = False
        self._buffer = b""
        self._lock = threading.Lock()
        self.data = TcpServer("data", lambda data: None)
        self.command = TcpServer("command", self._on_data)
        for server in (self.command, self.data):
            server.start()
        self.address = f"{self.command.url}?data={self.data.url.rpartition(':')[2]}"

    def _on_data(self, data: bytes) -> None:
        if not self.welcomed:
            self.welcomed = True
            self.command.send(WELCOME)
        self._buffer += data
        while b"\r\n" in self._buffer:
            line, _, self._buffer = self._buffer.partition(b"\r\n")
            self._answer(line.decode().removeprefix("$"))

    def _answer(self, command: str) -> None:
        with self._lock:
            self.received.append(command)
        if command in self.late:
            self.late.remove(command)
            self._held.append(command)
            return
        held, self._held = self._held, []
        for each in [*held, command]:
            self._carry_out(each)

    def _carry_out(self, command: str) -> None:
        known = self.answers.get(command)
        if known is None and re.fullmatch(r"(AVT|AVN|STI)\d+", command):
            known = "," + command[3:] if command.startswith("STI") else ""
        echo = f"${command}" if self.echo else ""
        text = f"{echo}$UNKNOWN COMMAND\r\n" if known is None else f"{echo}{known}OK\r\n"
        self.command.send(text.encode("latin-1"))
        reading = self.readings.pop(0) if command == "GMD" and self.readings else self.always
        if command == "GMD" and reading and self.data.await_present_client(1.0):
            self.data.send(reading)
        if command == "TRG0" and self.data.await_present_client(1.0):
            for block in self.blocks:
                self.data.send(block)

    def close(self) -> None:
        """End both ports."""
        self.command.close()
        self.data.close()


def block(counter: int, *frames: tuple[int, ...]) -> bytes:
    """Return the bytes of a block of the channels 1, 2, ..."""
    width, field = len(frames[0]), sum(1 << 2 * number for number in range(len(frames[0])))
    header = HEADER.pack(b"SAEM", 4711, 815, field, 0, 4 * width, len(frames), counter)
    return header + np.array(frames, dtype="<i4").tobytes()
