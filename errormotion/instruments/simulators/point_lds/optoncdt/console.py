"""Command lines of the optoNCDT and confocalDT families: settings, echo, prompt and errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from errormotion.errors import InstrumentError
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.point_lds.optoncdt.grammar import MAX_LINE, Command, RefusalError, split
from errormotion.instruments.transports import Address

LINE_END = b"\n"
PROMPT = b"->"
MAX_PARAMETER = 31


class ConsoleDevice(SimulatedDevice):
    """A device with the command lines of these families.

    Parameters of the address: ``user`` (PROFESSIONAL or USER: user level after power-on), ``password`` (000) and
    ``left`` (settings of an earlier user, as commands separated by semicolons, with ``+`` for a space).
    """

    _commands: Mapping[str, Command]
    _errors: Mapping[str, str]
    longest_parameter = MAX_LINE

    def _set_up_console(self, address: Address) -> None:
        self._password = address.params.get("password", "000")
        self._user = "USER" if address.params.get("user") == "USER" else "PROFESSIONAL"
        self._left = [split(line) for line in address.params.get("left", "").split(";") if line.strip()]

    def _boot(self) -> None:
        """Set the settings as delivered, then those of an earlier user."""
        self._settings = {name: tuple(split(each.default)) for name, each in self._commands.items() if each.default}
        self._level = self._user
        self._settings["STDUSER"] = (self._level,)
        for name, *words in self._left:
            text = " ".join([name, *words])
            command = self._commands.get(name)
            if command is None or command.default is None:
                raise InstrumentError(f"'left={text}': this device has no such setting", code="simulator.setting")
            try:
                command.check(words)
            except RefusalError as refused:
                raise InstrumentError(
                    f"'left={text}': {self._errors[refused.reason]}", code="simulator.setting"
                ) from None
            self._settings[name] = tuple(words)

    def _on_data(self, data: bytes) -> None:
        super()._on_data(data)
        if len(self._buffer) > MAX_LINE:  # without a line end
            self._buffer = b""
            self.reply(self._errors["long"].encode() + b"\r\n" + PROMPT)

    def answer(self, request: bytes) -> bytes:
        """Return the answer to one command; with ECHO ON it repeats the command."""
        echo = self._settings["ECHO"] == ("ON",)
        line = request.removesuffix(b"\r").decode("latin-1").strip()
        text = self._text(line) if line else ""
        if echo and line and line.isascii() and line.isprintable():
            text = f"{line}\r\n{text}" if text else f"{line} ok"
        return text.encode("latin-1") + b"\r\n" + PROMPT

    def _text(self, line: str) -> str:
        errors = self._errors
        if len(line) > MAX_LINE:
            return errors["long"]
        if not (line.isascii() and line.isprintable()):
            return errors.get("character", errors["command"])
        name, *words = split(line)
        command = self._commands.get(name)
        if command is None:
            return errors["command"]
        if any(len(word) > self.longest_parameter for word in words):
            return errors["long"]
        try:
            return self._execute(name, command, words)
        except RefusalError as refused:
            return errors[refused.reason]

    def _execute(self, name: str, command: Command, words: Sequence[str]) -> str:
        if not words and command.default is not None:
            return " ".join([name, *self._setting(name)])
        if words or command.forms:
            command.check(words)
        if self._level != "PROFESSIONAL" and command.writes:
            raise RefusalError("access")
        return self._act(name, words) if command.default is None else self._set(name, tuple(words))

    def _setting(self, name: str) -> tuple[str, ...]:
        return self._settings[name]

    def _set(self, name: str, words: tuple[str, ...]) -> str:
        """Change a setting; return the answer."""
        raise NotImplementedError

    def _act(self, name: str, words: Sequence[str]) -> str:
        """Execute a command that is not a setting; return the answer."""
        match name:
            case "HELP":
                return "\r\n".join(sorted(self._commands))
            case "GETUSERLEVEL":
                return f"{name} {self._level}"
            case "LOGIN":
                if words[0] != self._password:
                    raise RefusalError("access")
                self._level = "PROFESSIONAL"
            case "LOGOUT":
                self._level = "USER"
            case "PASSWD":
                self._change_password(*words)
        return ""

    def _change_password(self, old: str, new: str, again: str) -> None:
        if old != self._password:
            raise RefusalError("access")
        if new != again:
            raise RefusalError("passwords")
        if len(new) > MAX_PARAMETER:
            raise RefusalError("long")
        self._password = new
