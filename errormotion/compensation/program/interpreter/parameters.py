"""Parameters of a program for the interpreter: in units of the machine, where the inputs or the program state them.

The interpreter knows no machine: it takes lengths in inches, and every parameter that no file states is 0. So each
reference to a parameter (``#``) is checked against what is known, and rewritten: a length of the control becomes one in
units of the machine, and a value that only the program can set gets a guard that ends the interpreter with an error
while the program has not set it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from errormotion.compensation.program.reading.offsets import SYSTEMS, Offsets
from errormotion.errors import ProgramError
from errormotion.instruments.nc_words import COMMENT, MAX_BLOCK, code_of, refusal, words_of

UNSTATED = -98765.4321
"""Value of the parameters that nothing states."""

UNKNOWN_TOOL = 2147400123
"""Number of the tool in the spindle before the program changes it; no program states it."""

GUARD = "Argument to acos out of range"
"""Error of the interpreter for a value that is not known."""

_DEBUG = re.compile(r"\(\s*DEBUG\s*,", re.IGNORECASE)
_IN_COMMENT = re.compile(r"#(?:<[^>]*>|\d+)")
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)")
_FUNCTION = re.compile(r"[a-z]+(?=\[)")
_NAME = re.compile(r"(?:#|(?<=o))<[^>]*>")
_WORD = re.compile(
    r"^/?(?:n\d+)?o(\d+|<[^>]*>|\[[^\]]*\]|#<[^>]*>|#\d+)"
    r"(sub|endsub|if|elseif|else|endif|while|endwhile|do|repeat|endrepeat|call|return|break|continue)?"
)
_OPENS = {"sub", "if", "while", "do", "repeat"}
_CLOSES = {"endsub", "endif", "endwhile", "endrepeat"}
_NO_TOOL = re.compile(r"(?<![a-z<_])t0+(?![\d.])")
_COMPENSATES = re.compile(r"g0*4[12](?![.\d])")
_RADIUS = re.compile(r"(?<![a-z<_])d[-+\d.\[#]")
_OF_MACHINE = {*range(5061, 5071), 5399, *range(5420, 5440)}
_TOOL_SCALED = {5401, 5402, 5403, 5407, 5408, 5409, 5410}
_TOOL = range(5400, 5414)
_FREE = {"_value", "_value_returned", "_call_level", "_task"}
_STATED_BY = {
    "_metric": {"g20", "g21"},
    "_imperial": {"g20", "g21"},
    "_absolute": {"g90", "g91"},
    "_incremental": {"g90", "g91"},
    "_inverse_time": {"g93", "g94", "g95"},
    "_units_per_minute": {"g93", "g94", "g95"},
    "_units_per_rev": {"g93", "g94", "g95"},
    "_retract_r_plane": {"g98", "g99"},
    "_retract_old_z": {"g98", "g99"},
    "_spindle_on": {"m3", "m4", "m5"},
    "_spindle_cw": {"m3", "m4", "m5"},
    "_plane": {"g17", "g18", "g19"},
    "_ccomp": {"g40", "g41", "g42", "g41.1", "g42.1"},
    "_coord_system": {name.lower() for name in SYSTEMS},
    "_tool_offset": {"g43", "g43.1", "g49"},
    "_ijk_absolute_mode": {"g90.1", "g91.1"},
    "_motion_mode": {"g0", "g1", "g2", "g3", "g80"},
    "_mist": {"m7", "m9"},
    "_flood": {"m8", "m9"},
    "_feed": {"f"},
    "_rpm": {"s"},
}
"""Named parameters of the interpreter, and the codes of which one must precede, because the start of a program does not
determine the value."""


@dataclass
class _Scope:
    """What is set on all ways to a line."""

    numbers: set[int]
    names: set[str] = field(default_factory=set)
    codes: set[str] = field(default_factory=set)

    def copy(self) -> _Scope:
        return _Scope(set(self.numbers), set(self.names), set(self.codes))


class Parameters:
    """Rewrites the references to parameters in a program.

    Parameters
    ----------
    source : sequence of str
        Lines of the program.
    offsets : Offsets
        State of the control before the program starts.
    """

    def __init__(self, source: Sequence[str], offsets: Offsets) -> None:
        if UNKNOWN_TOOL in offsets.tools:
            raise ProgramError(f"tool {UNKNOWN_TOOL}: expected another number of a tool", code="program.tool.number")
        self._source, self._offsets = source, offsets
        self._scale = "*25.4" if offsets.unit == "mm" else ""
        self._guarded: dict[int, list[str]] = {}
        plain = [_code(text) for text in source]
        everything = _NAME.sub("", "\n".join(plain))
        self._sets_g92 = re.search(r"g92(?![.\d])", everything) is not None
        self._changes_g92 = "g92" in everything
        self._sets_origins = re.search(r"l0*20(?![.\d])", everything) is not None
        self.reads_tool = False
        self._first_call = self._codes_before_a_call(plain)
        self._assigned = {found[1] for text in plain for found in re.finditer(r"#<([^>]*)>=", text)}

    def lines(self) -> list[str]:
        """Return the lines of the program for the interpreter.

        Raises
        ------
        ProgramError
            A line reads a parameter that is not known, or sets one of the control.
        """
        known = {number for number in self._offsets.parameters if number <= 5000}
        scope = _Scope(set(known))
        outer: list[tuple[str, str, _Scope]] = []
        lines = []
        for number, text in enumerate(self._source, 1):
            plain = _code(text)
            word = _WORD.match(plain)
            label, kind = word.groups() if word is not None else ("", None)
            if kind in ("else", "elseif") and outer:
                scope = outer[-1][2].copy()
            lines.append(self._line(number, text, scope))
            if word is not None and kind is None:  # a subroutine of M98: what is set before is not known
                scope, outer = _Scope(set(known), set(), set(self._first_call)), []
            elif kind in _CLOSES or (kind == "while" and outer and outer[-1][:2] == (label, "do")):
                scope = outer.pop()[2] if outer else scope
            elif kind in _OPENS:
                outer.append((label, kind, scope))
                sub = _Scope(known | set(range(1, 31)), set(), set(self._first_call))
                scope = sub if kind == "sub" else scope.copy()
            if not plain.startswith("/"):
                self._note(plain, scope)
        return lines

    def refused(self, line: int) -> ProgramError | None:
        """Return the error of a line whose guard ended the interpreter; None if it has none."""
        names = self._guarded.get(line)
        if not names:
            return None
        what = " or ".join(dict.fromkeys(names))
        return refusal(
            line,
            self._source[line - 1],
            f"reads {what}, which neither the inputs nor the program state",
            code="program.parameter.unknown",
        )

    def _note(self, plain: str, scope: _Scope) -> None:
        """Add what a line sets."""
        scope.numbers |= {int(found[1]) for found in re.finditer(r"#(\d+)=", plain)}
        scope.names |= {found[1] for found in re.finditer(r"#<([^>]*)>=", plain)}
        scope.codes |= _codes(plain)

    def _codes_before_a_call(self, plain: Iterable[str]) -> set[str]:
        found: set[str] = set()
        depth: list[tuple[str, str]] = []
        for text in plain:
            word = _WORD.match(text)
            label, kind = word.groups() if word is not None else ("", None)
            if not depth and (kind == "call" or "m98" in text):
                break
            if kind in _CLOSES or (kind == "while" and depth[-1:] == [(label, "do")]):
                del depth[-1:]
            elif kind in _OPENS:
                depth.append((label, kind))
            elif not depth and not text.startswith("/"):
                found |= _codes(text)
        return found

    def _line(self, number: int, text: str, scope: _Scope) -> str:
        for comment in COMMENT.finditer(text):
            if _DEBUG.match(comment[0]):
                for found in _IN_COMMENT.finditer(_squeezed(comment[0])):
                    if self._value(number, text, found[0], scope) != found[0]:
                        raise refusal(
                            number,
                            text,
                            f"shows {found[0]}, which is unknown before the program runs",
                            code="program.prints_unknown",
                        )
        code = _code(text)
        compensates = _COMPENSATES.search(code) and not _RADIUS.search(code)
        if "#" not in code and not compensates and not _NO_TOOL.search(code):
            return text
        pieces: list[str] = []
        at = 0
        ends = [*((comment.start(), comment.end()) for comment in COMMENT.finditer(text)), (len(text), len(text))]
        for start, end in ends:
            piece = text[at:start]
            new = self._rewritten(number, text, _NO_TOOL.sub(f"t{UNKNOWN_TOOL}", _squeezed(piece)), scope)
            if compensates and _COMPENSATES.search(new):
                self.reads_tool = True
                new += "d" + self._guard(number, "#5400", "the number of the tool in the spindle", UNKNOWN_TOOL)
            pieces.append(new)
            pieces.append(text[start:end])
            at = end
        new = "".join(pieces)
        if len(new) > max(len(text), MAX_BLOCK - 10):
            raise refusal(
                number,
                text,
                "too many parameters in one line to check that the program sets all of them",
                code="program.parameters.too_many",
            )
        return new

    def _rewritten(self, number: int, text: str, code: str, scope: _Scope) -> str:
        """Return code with references that are checked and in units of the machine."""
        new, k = "", 0
        while (start := code.find("#", k)) >= 0:
            new += code[k:start]
            end = _operand(code, start + 1)
            if end < 0:
                raise refusal(number, text, "expected a parameter after #", code="program.parameter.form")
            reference, operand = code[start:end], code[start + 1 : end]
            k = end
            if code[end : end + 1] == "=":
                new += self._target(number, text, operand, scope)
            elif new.endswith("exists["):
                self._exists(number, text, operand, scope)
                new += reference
            elif _direct(operand):
                new += self._value(number, text, reference, scope)
            else:
                inner = self._rewritten(number, text, operand, scope)
                value = f"#{inner}"
                self._guarded.setdefault(number, []).append("a parameter with a computed number")
                new += f"[{value}+acos[1+[{value}EQ{UNSTATED}]+[{inner}GT5000]]]"
        return new + code[k:]

    def _target(self, number: int, text: str, operand: str, scope: _Scope) -> str:
        if operand.startswith("<"):
            return f"#{operand}"
        if _direct(operand):
            if float(operand) > 5000:
                raise refusal(number, text, "sets a parameter of the control", code="program.parameter.of_control")
            return f"#{operand}"
        inner = self._rewritten(number, text, operand, scope)
        self._guarded.setdefault(number, []).append("or sets a parameter of the control with a computed number")
        return f"#[{inner}+acos[1+[{inner}GT5000]]]"

    def _exists(self, number: int, text: str, operand: str, scope: _Scope) -> None:
        name = operand[1:-1]
        if name.startswith("_") and name not in scope.names:
            raise refusal(
                number,
                text,
                f"whether #<{name}> exists depends on the programs that ran before",
                code="program.parameter.may_exist",
            )

    def _value(self, number: int, text: str, reference: str, scope: _Scope) -> str:
        """Return the expression that replaces a reference to a parameter with a stated number or name."""
        operand = reference[1:]
        if operand.startswith("<"):
            return self._named(number, text, operand[1:-1], scope)
        index = round(float(operand))
        if abs(index - float(operand)) > 1e-4 or index < 1:
            raise refusal(number, text, f"#{operand} is not a parameter", code="program.parameter.form")
        if index <= 5000:
            if index in scope.numbers:
                return reference
            return self._guard(number, reference, f"#{index}", UNSTATED)
        return self._of_control(number, text, index)

    def _guard(self, number: int, reference: str, name: str, unstated: float, value: str = "") -> str:
        """Return a value with an error while a parameter has the value of one that nothing states."""
        self._guarded.setdefault(number, []).append(name)
        return f"[{value or reference}+acos[1+[{reference}EQ{unstated}]]]"

    def _named(self, number: int, text: str, name: str, scope: _Scope) -> str:
        reference = f"#<{name}>"
        if not name.startswith("_") or name in _FREE:
            return reference
        if name == "_current_tool":
            return self._of_control(number, text, 5400)
        codes = _STATED_BY.get(name)
        if codes is not None:
            if codes & scope.codes or (name == "_coord_system" and 5220 in self._offsets.parameters):
                return reference
            raise refusal(
                number,
                text,
                f"reads {reference}, which depends on what the control did before; expected one of "
                f"{', '.join(sorted(codes)).upper()} before it",
                code="program.parameter.of_earlier",
            )
        if name in self._assigned:
            return reference
        if re.match(r"_(hal\[|[xyzabcuvw]$|abs_)", name):
            raise refusal(
                number,
                text,
                f"reads {reference}, a parameter that the running machine sets",
                code="program.parameter.of_control",
            )
        raise refusal(
            number,
            text,
            f"reads {reference}, which neither the inputs nor the program state",
            code="program.parameter.unknown",
        )

    def _of_control(self, number: int, text: str, index: int) -> str:
        """Return the expression for a parameter above 5000, in units of the machine."""
        offsets, reference = self._offsets, f"#{index}"
        if index in _OF_MACHINE:
            raise refusal(
                number,
                text,
                "a parameter that the running machine sets (position, probe, input)",
                code="program.parameter.of_control",
            )
        if index in _TOOL:
            self.reads_tool = True
            value = reference + (self._scale if index in _TOOL_SCALED else "")
            return self._guard(number, "#5400", f"{reference} before a tool is changed (M6)", UNKNOWN_TOOL, value)
        stated = offsets.parameters.get(index, math.nan)
        length = 1e3 if offsets.unit == "mm" else 1e3 / 25.4
        axis, literal, native = -1, False, False
        if 5161 <= index <= 5169 or 5181 <= index <= 5189:
            axis = (index - 5161) % 20
            stated = float(offsets.homes[(index - 5161) // 20, axis]) * length if axis < 3 else stated
            literal = True
        elif 5211 <= index <= 5219:
            axis = index - 5211
            stated = float(offsets.stored[axis]) * length if axis < 3 else stated
            if self._sets_g92 or (axis > 2 and self._changes_g92):
                raise refusal(
                    number,
                    text,
                    f"reads {reference}, which G92 sets at a position that may be unknown",
                    code="program.parameter.of_position",
                )
            native, literal = axis < 3, axis > 2
        elif index in (5210, 5220):
            native = True
        elif 5221 <= index <= 5390 and (index - 5221) % 20 < 10 and (index - 5221) // 20 < len(SYSTEMS):
            axis, system = (index - 5221) % 20, (index - 5221) // 20
            stated = float(offsets.systems[system, axis]) * length if axis < 3 else stated
            if self._sets_origins:
                raise refusal(
                    number,
                    text,
                    f"reads {reference}, which G10 L20 sets at a position that may be unknown",
                    code="program.parameter.of_position",
                )
            native, literal = axis < 3 or axis == 9, 3 <= axis < 9
        else:
            raise refusal(
                number,
                text,
                f"reads {reference}, whose value is not known before the program runs",
                code="program.parameter.unknown",
            )
        if stated != stated:
            raise refusal(
                number,
                text,
                f"reads {reference}, which is not stated: state --parameters FILE.var with this parameter",
                code="program.parameter.not_stated",
            )
        if literal:
            return f"[{stated:.9f}]"
        return f"[{reference}{self._scale}]" if native and 0 <= axis < 3 else reference


def _codes(plain: str) -> set[str]:
    """Return the codes of a line in a canonical form, such as ``g1`` and ``m3``, and ``t``, ``f``, ``s``."""
    found = words_of(plain)
    codes = {f"{letter}{float(number):g}" for letter, number in found if letter in "GM" and number}
    return {code.lower() for code in codes | ({letter for letter, _ in found} & set("TFS"))}


def _code(text: str) -> str:
    """Return a line as the interpreter reads it: in lower case, without comments and spaces."""
    return code_of(text).lower()


def _squeezed(text: str) -> str:
    return re.sub(r"\s", "", text).lower()


def _direct(operand: str) -> bool:
    return operand.startswith("<") or _NUMBER.fullmatch(operand) is not None


def _operand(code: str, k: int) -> int:
    """Return the end of the value that starts at an index; -1 if there is none."""
    if code[k : k + 1] == "<":
        return code.find(">", k) + 1 or -1
    if code[k : k + 1] == "#":
        return _operand(code, k + 1)
    if code[k : k + 1] == "[":
        depth = 0
        for end in range(k, len(code)):
            depth += {"[": 1, "]": -1}.get(code[end], 0)
            if not depth:
                return end + 1
        return -1
    if found := _FUNCTION.match(code, k):
        end = _operand(code, found.end())
        if found[0] == "atan" and end > 0 and code[end : end + 2] == "/[":
            return _operand(code, end + 1)
        return end
    found = _NUMBER.match(code, k)
    return found.end() if found is not None else -1
