"""Commands, settings, formats and errors of LK-G5000 and LK-G3000 controllers on RS-232C.

Formats and the errors of the LK-G3000: LK-G Series user's manual (LK-G-M-NO5-E) p. 5-5 and 5-6. Commands and errors of
the LK-G5000, and the names of settings: from other clients, see the page of the device. What is not in a public
document is listed on that page as assumed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto

LINE_END = b"\r"
MAX_BYTES = 64
"""Longest command, bytes; a longer one is a length error."""

HEADS: Mapping[str, float] = {
    name: 1e-3 * half
    for name, half in {
        "LK-H008": 0.5,
        "LK-H020": 3.0,
        "LK-H050": 10.0,
        "LK-H080": 18.0,
        "LK-H150": 40.0,
        "LK-G10": 1.0,
        "LK-G15": 1.0,
        "LK-G30": 5.0,
        "LK-G80": 15.0,
        "LK-G150": 40.0,
        "LK-G400": 100.0,
    }.items()
}
"""Half the measuring range of heads, m."""

DISPLAYS: tuple[tuple[float, int], ...] = (
    (1e-3, 2),
    (1e-3, 3),
    (1e-3, 4),
    (1e-3, 5),
    (1e-6, 1),
    (1e-6, 2),
    (1e-6, 3),
)
"""Unit (m) and decimals of the display units 0..6: LKIF_DISPLAYUNIT of the manufacturer's header LKIF2.h."""

NO_VALUE, OVER, UNDER = "XXXXXXXX", "+FFFFFFF", "-FFFFFFF"
WIDTH = 7
"""Characters of a value after its sign."""


class Mistake(Enum):
    """Reason for which a controller answers with an error."""

    COMMAND = auto()
    STATE = auto()
    LENGTH = auto()
    COUNT = auto()
    RANGE = auto()


@dataclass(frozen=True)
class Setting:
    """One setting.

    ``part`` is a letter after its name, ``per_output`` whether the number of an output or head follows, ``forms`` a
    regular expression for each value, ``delivered`` the values as delivered.
    """

    name: str
    part: str = ""
    per_output: bool = True
    forms: tuple[str, ...] = (r"\d+",)
    delivered: tuple[str, ...] = ("0",)


@dataclass(frozen=True)
class Controller:
    """One series of controllers."""

    name: str
    outputs: int
    digits: int
    errors: Mapping[Mistake, str]
    settings: tuple[Setting, ...]
    programs: int = 8

    def find(self, words: list[str]) -> tuple[Setting, list[str]] | None:
        """Return the setting that the words start with and the words after its name; None if it is unknown."""
        for setting in self.settings:
            head = [setting.name, setting.part] if setting.part else [setting.name]
            if words[: len(head)] == head:
                return setting, words[len(head) :]
        return None


_VALUE = r"[+-]\d{6}"
_SWITCH = r"[01]"
DISPLAY, OFFSET, STORED, STORAGE = "OI", "OF", "OK", "CD"
"""Names of settings: display unit and offset (both assumed), whether an output is stored, and the data storage."""


def _unknown(names: str, *, per_output: bool = True) -> tuple[Setting, ...]:
    """Return settings of which only the name is known; their value is a number."""
    pairs = (word.partition(":") for word in names.split())
    return tuple(Setting(name, part, per_output) for name, _, part in pairs)


LK_G5000 = Controller(
    "LK-G5000",
    outputs=12,
    digits=2,
    errors={
        Mistake.COMMAND: "50",
        Mistake.STATE: "51",
        Mistake.LENGTH: "60",
        Mistake.COUNT: "61",
        Mistake.RANGE: "62",
    },
    settings=(
        Setting("LM", forms=(_VALUE, _VALUE, _VALUE), delivered=("+000000",) * 3),
        Setting("HA", "M", forms=(_SWITCH,)),
        Setting("HB", "M", forms=(r"[0-4]",)),
        Setting("HB", "B", forms=(_SWITCH,)),
        Setting("OC", forms=(r"[0-2]", r"\d"), delivered=("0", "0")),
        Setting("OE", "M", forms=(_SWITCH,)),
        Setting(OFFSET, forms=(_VALUE,), delivered=("+000000",)),
        Setting(DISPLAY, forms=(r"[0-6]",), delivered=("2",)),
        Setting("OJ", forms=(_SWITCH,)),
        Setting(STORED, forms=(_SWITCH,), delivered=("1",)),
        Setting("CG", forms=(r"0[1-9]|1[0-2]",), delivered=("01",)),
        Setting("CA", per_output=False, forms=(r"[0-8]",), delivered=("6",)),
        Setting(STORAGE, per_output=False, forms=(r"\d{7}", r"0\d|10"), delivered=("0000100", "00")),
        Setting("EF", per_output=False, forms=(r"0[1-9]|1[0-2]",), delivered=("01",)),
        *_unknown("HA:R HC:N HC:L HE HF HG HH HI HJ OA:H OA:T OA:C OA:M OB OD OG OH"),
        *_unknown("CB CE CF CH EE EG EH:I EH:M EH:G", per_output=False),
    ),
)

LK_G3000 = Controller(
    "LK-G3000",
    outputs=2,
    digits=1,
    errors={
        Mistake.COMMAND: "00",
        Mistake.STATE: "01",
        Mistake.LENGTH: "20",
        Mistake.COUNT: "21",
        Mistake.RANGE: "22",
    },
    settings=(
        Setting("LM", forms=(_VALUE, _VALUE, _VALUE), delivered=("+000000",) * 3),
        Setting("HA", "M", forms=(_SWITCH,)),
        Setting("HB", forms=(r"[0-4]",)),
        Setting("HE", forms=(_SWITCH,)),
        Setting("OC", forms=(r"[0-2]", r"\d"), delivered=("0", "0")),
        Setting(OFFSET, forms=(_VALUE,), delivered=("+000000",)),
        Setting(DISPLAY, forms=(r"[0-6]",), delivered=("2",)),
        Setting("CA", per_output=False, forms=(r"[0-5]",)),
        Setting("CI", per_output=False, forms=(r"[0-3]", r"\d{5}", r"\d+"), delivered=("3", "00100", "0")),
        *_unknown("HA:R HC:N HC:L OA OB OD OE OG OH"),
        *_unknown("CB CD CE CF CG CH", per_output=False),
    ),
)

CONTROLLERS: Mapping[str, Controller] = {each.name: each for each in (LK_G5000, LK_G3000)}


def value_text(value: float, display: int) -> str:
    """Return a value (m) as it is sent: its sign and seven characters with leading zeros."""
    unit, decimals = DISPLAYS[display]
    text = f"{abs(value) / unit:0{WIDTH}.{decimals}f}"
    if len(text) > WIDTH:
        return OVER if value > 0 else UNDER
    negative = math.copysign(1.0, value) < 0 and float(text) != 0.0
    return ("-" if negative else "+") + text


def steps_text(steps: int, display: int) -> str:
    """Return a setting value as it is sent: its sign and six digits with a decimal point."""
    decimals = DISPLAYS[display][1]
    digits = f"{abs(steps):06d}"
    return f"{'-' if steps < 0 else '+'}{digits[:-decimals]}.{digits[-decimals:]}"


def fits(form: str, text: str) -> bool:
    """Whether a word matches a form."""
    return re.fullmatch(form, text, re.ASCII) is not None
