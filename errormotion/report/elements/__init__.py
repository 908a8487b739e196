"""Chapters as data: a method states which quantities a chapter shows, and the parts read the dataset.

Field units, intervals, reasons of missing values, translation, and the tables as CSV and XLSX come with the parts. A
method draws by hand only what is its own, and adds it by `Own`.
"""

from errormotion.report.elements.across import Across
from errormotion.report.elements.chapter import Chapter, Element, On, Own, Section, Sentence
from errormotion.report.elements.drawings import Curves, Map, PolarPlot
from errormotion.report.elements.figures import FigureBudget, FigureTable, KeyFigures
from errormotion.report.elements.limits import AgainstLimits
from errormotion.report.elements.quantities import Of
from errormotion.report.elements.sensors import Sensors
from errormotion.report.elements.standard import (
    NOT_DETERMINED,
    PROVENANCE,
    UNCERTAINTY,
    Budget,
    Further,
    Notes,
    Provenance,
    Reliability,
    Spans,
)
from errormotion.report.elements.tables import Column, KeyValue, Table
from errormotion.report.elements.timelines import LargestAndLast, Timeline, TimePanel

__all__ = [
    "NOT_DETERMINED",
    "PROVENANCE",
    "UNCERTAINTY",
    "Across",
    "AgainstLimits",
    "Budget",
    "Chapter",
    "Column",
    "Curves",
    "Element",
    "FigureBudget",
    "FigureTable",
    "Further",
    "KeyFigures",
    "KeyValue",
    "LargestAndLast",
    "Map",
    "Notes",
    "Of",
    "On",
    "Own",
    "PolarPlot",
    "Provenance",
    "Reliability",
    "Section",
    "Sensors",
    "Sentence",
    "Spans",
    "Table",
    "TimePanel",
    "Timeline",
]
