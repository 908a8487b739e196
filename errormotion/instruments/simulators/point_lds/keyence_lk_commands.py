"""The commands and the state of an LK controller."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from errormotion.instruments.simulators.point_lds import keyence_lk_grammar as grammar
from errormotion.instruments.simulators.point_lds.keyence_lk_grammar import Controller, Mistake, Setting

GENERAL, COMMUNICATION = "R0", "Q0"
MAX_STORED = 65536
"""Capacity of the data storage in values; the device stores 1.2 million."""


Command = Callable[[list[str]], str]
"""Returns the answer to a command from its parameters."""
Outputs = Callable[[list[str]], list[int]]
"""Returns the output numbers in the parameters."""


class MistakeError(Exception):
    """A command that is answered with an error."""

    def __init__(self, kind: Mistake) -> None:
        super().__init__(kind.name)
        self.kind = kind


class Commands:
    """The commands of a controller.

    Parameters
    ----------
    controller : Controller
    value : callable
        Returns the value of the head, m, or the text that replaces a missing value.
    output, outputs : int
        Output of the head, and number of active outputs.
    display : int
        Display unit.

    Attributes
    ----------
    offset, zero : float
        Added to and subtracted from the reading, m.
    """

    def __init__(
        self, controller: Controller, value: Callable[[], float | str], *, output: int, outputs: int, display: int
    ) -> None:
        self.controller = controller
        self.offset = self.zero = 0.0
        self._value = value
        self._output, self._outputs, self._display = output, outputs, display
        self._mode = GENERAL
        self._held: str | None = None  # value while timing is on
        self._program = 0
        self._stored: list[str] = []
        self._written: dict[tuple[str, str, str], list[str]] = {}
        several = controller.digits == 2
        self._commands: Mapping[str, Command] = self._of_g5000() if several else self._of_g3000()

    def execute(self, text: str) -> str:
        """Return the answer to a command, without its end."""
        word, *words = text.split(",")
        if word in (GENERAL, COMMUNICATION) and not words:
            if word == self._mode:
                raise MistakeError(Mistake.STATE)
            self._mode = word
            return word
        if word in ("SR", "SW"):
            self._require_mode(COMMUNICATION, text)
            return self._read(words) if word == "SR" else self._write(words)
        if word not in self._commands:
            raise MistakeError(Mistake.COMMAND)
        self._require_mode(GENERAL, text)
        return self._commands[word](words)

    def _require_mode(self, mode: str, text: str) -> None:
        if len(text) > grammar.MAX_BYTES:
            raise MistakeError(Mistake.LENGTH)
        if self._mode != mode:
            raise MistakeError(Mistake.STATE)

    # ------------------------------------------------------------------ tables

    def _of_g5000(self) -> dict[str, Command]:
        commands: dict[str, Command] = {
            "MS": lambda words: self._values("MS", words, [self._number(words)]),
            "MM": lambda words: self._values("MM", words, self._flagged(words)),
            "MA": lambda words: self._values("MA", words, self._all(words)),
            "TS": lambda words: self._time("TS", words[:1], [self._number(words[1:])]),
            "TM": lambda words: self._time("TM", words[:1], self._flagged(words[1:])),
            "TA": lambda words: self._time("TA", words[:1], self._all(words[1:])),
        }
        for letter, action in (("V", self._set_zero), ("W", self._clear_zero), ("R", self._reset)):
            commands[f"{letter}S"] = partial(self._act, action, f"{letter}S", lambda words: [self._number(words)])
            commands[f"{letter}M"] = partial(self._act, action, f"{letter}M", self._flagged)
            commands[f"{letter}A"] = partial(self._act, action, f"{letter}A", self._all)
        return commands | self._of_both()

    def _of_g3000(self) -> dict[str, Command]:
        commands: dict[str, Command] = {
            "T0": lambda words: self._time("T0", ["0"], self._one_or_both(words)),
            "T1": lambda words: self._time("T1", ["1"], self._one_or_both(words)),
            "VR": partial(self._act, self._reset, "VR", self._one_or_both),
            "DO": lambda words: self._statistics(self._number(words)),
            "DQ": lambda words: self._done("DQ", words),
        }
        for digit, chosen in (("0", [1, 2]), ("1", [1]), ("2", [2])):
            no_words = partial(self._none_but, result=chosen)
            commands[f"M{digit}"] = partial(self._measure, f"M{digit}", no_words)
            commands[f"V{digit}"] = partial(self._act, self._set_zero, f"V{digit}", no_words)
            commands[f"W{digit}"] = partial(self._act, self._clear_zero, f"W{digit}", no_words)
        return commands | self._of_both()

    def _of_both(self) -> dict[str, Command]:
        return {
            "KL": self._lock,
            "PW": self._change_program,
            "PR": lambda words: f"PR,{self._none_but(words, [self._program])[0]}",
            "AS": self._store,
            "AP": lambda words: self._done("AP", words),
            "AQ": self._clear_storage,
            "AO": self._output_storage,
            "AN": self._storage_status,
        }

    # ------------------------------------------------------------------ identifiers

    def _none_but(self, words: list[str], result: list[int]) -> list[int]:
        """Return a result if the command has no parameters."""
        if words:
            raise MistakeError(Mistake.COUNT)
        return result

    def _done(self, header: str, words: list[str]) -> str:
        """Return the answer to a command without effect in the simulator."""
        self._none_but(words, [])
        return header

    def _word(self, words: list[str], length: int) -> str:
        if len(words) != 1 or not words[0]:
            raise MistakeError(Mistake.COUNT)
        if len(words[0]) != length:
            raise MistakeError(Mistake.LENGTH)
        if not (words[0].isascii() and words[0].isdigit()):
            raise MistakeError(Mistake.RANGE)
        return words[0]

    def _number(self, words: list[str]) -> int:
        """Return the output number in one word."""
        number = int(self._word(words, self.controller.digits))
        if not 1 <= number <= self._outputs:
            raise MistakeError(Mistake.RANGE)
        return number

    def _one_or_both(self, words: list[str]) -> list[int]:
        """Return the output numbers for one digit; 0: both."""
        word = self._word(words, 1)
        if word not in "012":
            raise MistakeError(Mistake.RANGE)
        return [1, 2] if word == "0" else [int(word)]

    def _flagged(self, words: list[str]) -> list[int]:
        """Return the output numbers of a sequence of flags, starting with output 1."""
        flags = self._word(words, self.controller.outputs)
        chosen = [k for k, flag in enumerate(flags, 1) if flag == "1"]
        if set(flags) - set("01") or not chosen or chosen[-1] > self._outputs:
            raise MistakeError(Mistake.RANGE)
        return chosen

    def _all(self, words: list[str]) -> list[int]:
        return self._none_but(words, list(range(1, self._outputs + 1)))

    def _switch(self, words: list[str]) -> str:
        word = self._word(words, 1)
        if word not in "01":
            raise MistakeError(Mistake.RANGE)
        return word

    # ------------------------------------------------------------------ measurement

    def _measure(self, header: str, outputs: Outputs, words: list[str]) -> str:
        return self._values(header, words, outputs(words))

    def _act(self, action: Callable[[str, list[int]], str], header: str, outputs: Outputs, words: list[str]) -> str:
        return action(header, outputs(words))

    def _values(self, header: str, words: list[str], outputs: list[int]) -> str:
        return ",".join([header, *words, *map(self._value_of, outputs)])

    def _value_of(self, output: int) -> str:
        """Return the value of an output."""
        if output != self._output:
            return grammar.NO_VALUE
        return self._held if self._held is not None else self._fresh()

    def _fresh(self) -> str:
        value = self._value()
        if isinstance(value, str):
            return value
        return grammar.value_text(value + self.offset - self.zero, self._display)

    def _set_zero(self, word: str, outputs: list[int]) -> str:
        value = self._value() if self._output in outputs else ""
        if not isinstance(value, str):
            self.zero = value + self.offset
        return word

    def _clear_zero(self, word: str, outputs: list[int]) -> str:
        if self._output in outputs:
            self.zero = 0.0
        return word

    def _reset(self, word: str, outputs: list[int]) -> str:
        if self._output in outputs:
            self._held = None
        return word

    def _time(self, word: str, switch: list[str], outputs: list[int]) -> str:
        """Hold the value while timing is on."""
        on = self._switch(switch) == "1"
        if self._output in outputs:
            self._held = self._fresh() if on else None
        return word

    def _statistics(self, output: int) -> str:
        """Return limits, mean, largest, smallest, difference, deviation and four counts of an empty statistic."""
        return ",".join(["DO", str(output), *[grammar.NO_VALUE] * 7, *["0"] * 4])

    def _lock(self, words: list[str]) -> str:
        self._switch(words)
        return "KL"

    def _change_program(self, words: list[str]) -> str:
        program = int(self._word(words, 1))
        if program >= self.controller.programs:
            raise MistakeError(Mistake.RANGE)
        self._program = program
        return "PW"

    # ------------------------------------------------------------------ data storage

    @property
    def _points(self) -> int:
        name, index = (grammar.STORAGE, 0) if self.controller.digits == 2 else ("CI", 1)
        setting = next(each for each in self.controller.settings if each.name == name)
        return int(self._written.get((name, "", ""), list(setting.delivered))[index])

    def _store(self, words: list[str]) -> str:
        self._none_but(words, [])
        self._stored = [self._fresh() for _ in range(self._points)]
        return "AS"

    def _clear_storage(self, words: list[str]) -> str:
        self._none_but(words, [])
        self._stored = []
        return "AQ"

    def _output_storage(self, words: list[str]) -> str:
        output = self._number(words)
        if not self._stored or output != self._output:
            raise MistakeError(Mistake.STATE)
        return ",".join(["AO", *self._stored])

    def _storage_status(self, words: list[str]) -> str:
        """Return whether values are being stored, and the number of stored values of each output."""
        width = 7 if self.controller.digits == 2 else 5
        counts = [len(self._stored) if k == self._output else 0 for k in self._all(words)]
        return ",".join(["AN", "0", *(f"{count:0{width}d}" for count in counts)])

    # ------------------------------------------------------------------ settings

    def _setting(self, words: list[str]) -> tuple[Setting, str, list[str]]:
        """Return a setting, the number of its output or head, and the remaining words."""
        if not words or not words[0]:
            raise MistakeError(Mistake.COUNT)
        found = self.controller.find(words)
        if found is None:
            raise MistakeError(Mistake.RANGE)
        setting, rest = found
        if not setting.per_output:
            return setting, "", rest
        number = self._number(rest[:1])
        return setting, f"{number:0{self.controller.digits}d}", rest[1:]

    def _read(self, words: list[str]) -> str:
        setting, number, rest = self._setting(words)
        if rest:
            raise MistakeError(Mistake.COUNT)
        values = self._written.get((setting.name, setting.part, number), list(setting.delivered))
        if number and int(number) == self._output:
            unit, decimals = grammar.DISPLAYS[self._display]
            if setting.name == grammar.DISPLAY:
                values = [str(self._display)]
            elif setting.name == grammar.OFFSET:
                steps = round(self.offset / unit * 10**decimals)
                values = [f"{steps:+07d}"]
        return ",".join(["SR", *words, *map(self._formatted, values)])

    def _formatted(self, value: str) -> str:
        """Return a value as it is read back: signed values have a decimal point."""
        return grammar.steps_text(int(value), self._display) if value[0] in "+-" else value

    def _write(self, words: list[str]) -> str:
        setting, number, values = self._setting(words)
        if len(values) != len(setting.forms):
            raise MistakeError(Mistake.COUNT)
        for form, value in zip(setting.forms, values, strict=True):
            if not grammar.fits(form, value):
                signed = form.startswith("[+-]")
                raise MistakeError(Mistake.LENGTH if signed and len(value) != 7 else Mistake.RANGE)
        if setting.name == grammar.STORAGE and int(values[0]) > MAX_STORED:
            raise MistakeError(Mistake.RANGE)
        self._written[setting.name, setting.part, number] = values
        if number and int(number) == self._output:
            if setting.name == grammar.DISPLAY:
                self._display = int(values[0])
            elif setting.name == grammar.OFFSET:
                unit, decimals = grammar.DISPLAYS[self._display]
                self.offset = int(values[0]) * unit / 10**decimals
        return f"SW,{setting.name}"
