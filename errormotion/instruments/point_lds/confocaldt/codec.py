"""Answers of a confocalDT 24x1, apart from the grammar that it shares with the optoNCDT.

Pages: operating instructions confocalDT 24x1 of Micro-Epsilon. Commands, prompt and errors are those of
`optoncdt.commands` (p. 92).
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from errormotion.errors import InstrumentError, ProtocolError
from errormotion.instruments.point_lds.optoncdt.commands import parse_info, reported_range, setting

COMMAND_PORT = 23
DATA_PORT = 1024
"""Port of the values; the one that a client of the related IFC2421 uses (assumption)."""

INFO, SENSOR = "GETINFO", "SENSORINFO"
OUTPUT, ADDITIONAL, STATISTICS, REDUCTION = "OUTPUT", "OUTADD_ETH", "OUTSTATISTIC_ETH", "OUTREDUCE"
RATE, MASTER, TRANSFER = "MEASRATE", "MASTERMV", "MEASTRANSFER"

MODELS = ("IFC2451", "IFC2461", "IFC2471")
RATES = (100.0, 70_000.0)
"""Lowest and highest measuring rate of any model, Hz (p. 102)."""
RATE_STEP = 100.0
"""Hz; a rate in kHz has at most one decimal (p. 102)."""

_NUMBER = re.compile(r"\d{1,6}(?:\.\d{1,6})?")


def facts_of(lines: Sequence[str]) -> dict[str, str]:
    """Return the facts of an answer to GETINFO or SENSORINFO (p. 95, 97) by their names in lower case.

    A value on the line after its name, as the manual prints it, is also read.
    """
    joined: list[str] = []
    for line in lines:
        if joined and joined[-1].endswith(":") and ":" not in line:
            joined[-1] = f"{joined[-1]} {line}"
        else:
            joined.append(line)
    return parse_info(joined)


def model_of(facts: dict[str, str]) -> str:
    """Return the model of the controller.

    Raises
    ------
    InstrumentError
        The commands of this model are unknown.
    """
    name = facts.get("name", "")
    if not name.startswith(MODELS):
        raise InstrumentError(
            f"The controller states the name '{name[:40]}'; expected {', '.join(MODELS)}, since others differ",
            code="sensor.model.unknown",
        )
    return name


def range_of(facts: dict[str, str]) -> float:
    """Return the measuring range of the sensor, m.

    Raises
    ------
    ProtocolError
        The controller states no range, or one that is not a length in mm.
    """
    found = reported_range(facts)
    if found is None:
        raise ProtocolError(
            f"Expected 'Measuring range' in the answer to {SENSOR}; found {', '.join(facts)[:80]!r}",
            code="protocol.reply.field",
        )
    return found


def rate_of(lines: Sequence[str]) -> float:
    """Return the measuring rate, Hz, from an answer to MEASRATE in kHz (p. 102)."""
    rate = _number(RATE, lines) * 1000.0
    if not 0 < rate <= 10 * RATES[1]:
        raise ProtocolError(
            f"Expected a measuring rate up to {RATES[1]:g} Hz; found {rate:g} Hz", code="protocol.reply.range"
        )
    return rate


def reduction_of(lines: Sequence[str]) -> int:
    """Return the reduction n, from an answer to OUTREDUCE: one of n values is sent (p. 105)."""
    return int(_number(REDUCTION, lines))


def rate_request(rate: float) -> str:
    """Return the command that sets a rate, Hz."""
    return f"{RATE} {max(1, round(rate / RATE_STEP)) * RATE_STEP / 1000.0:.1f}"


def _number(command: str, lines: Sequence[str]) -> float:
    words = (
        setting(command, lines).split(" ")[1:] or " ".join(lines).split(" ")[:1]
    )  # with ECHO OFF the name is missing
    if not words or not _NUMBER.fullmatch(words[0]):
        raise ProtocolError(
            f"Expected a number as the answer to '{command}'; found {' '.join(lines)[:80]!r}",
            code="protocol.reply.number_form",
        )
    return float(words[0])
