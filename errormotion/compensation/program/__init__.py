"""NC programs (RS-274, ISO 6983) rewritten so that their cuts are where they were meant.

``compensate(program, out, correcting, offsets)`` reads a program, line by line, with the plain reader, or expanded by
LinuxCNC's own interpreter where that is installed; changes every commanded position by the correction; and divides
lines and arcs where that is needed for the tolerance. What neither reader understands is refused by its line.
"""

from errormotion.compensation.program.compensating import Outcome, Settings, compensate
from errormotion.compensation.program.reading.items import LEFT
from errormotion.compensation.program.reading.offsets import Offsets, read_parameters, read_tools
from errormotion.compensation.program.reading.reader import Reader
from errormotion.compensation.program.tools import ByTool
from errormotion.compensation.program.writing.rewriting import Rewriting, Summary

__all__ = [
    "LEFT",
    "ByTool",
    "Offsets",
    "Outcome",
    "Reader",
    "Rewriting",
    "Settings",
    "Summary",
    "compensate",
    "read_parameters",
    "read_tools",
]
