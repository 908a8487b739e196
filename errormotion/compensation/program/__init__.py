"""NC programs (RS-274, ISO 6983) rewritten so that the tool follows the programmed path.

``compensate(program, out, correcting, offsets)`` reads a program line by line with the plain reader, or expanded by the
interpreter of LinuxCNC if it is installed, adds the correction to every commanded position, and divides lines and arcs
as the tolerance requires. A line that neither reader supports raises an error with its number.
"""

from errormotion.compensation.program.compensating import Outcome, ProgramSettings, compensate
from errormotion.compensation.program.reading.items import UNCHANGED
from errormotion.compensation.program.reading.offsets import Offsets, read_parameters, read_tools
from errormotion.compensation.program.reading.reader import Reader
from errormotion.compensation.program.tools import ByTool
from errormotion.compensation.program.writing.rewriting import Rewriting, Summary

__all__ = [
    "UNCHANGED",
    "ByTool",
    "Offsets",
    "Outcome",
    "ProgramSettings",
    "Reader",
    "Rewriting",
    "Summary",
    "compensate",
    "read_parameters",
    "read_tools",
]
