"""A chapter as data: a title and a sequence of parts, each of which reads the dataset."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, cast

import numpy as np
import xarray as xr

from errormotion.report import document
from errormotion.report.document import Block, Cell, Part, Source, estimate
from errormotion.report.elements.figures import KeyFigures, chosen
from errormotion.report.elements.quantities import Of, unit_of
from errormotion.report.elements.tables import KeyValue, filled
from errormotion.report.text import DASH

_NAME = re.compile(r"\{([^{}]+)\}")


class Element(Protocol):
    """A part of a section: it returns its blocks for a dataset, none if there is nothing to show."""

    def blocks(self, source: Source, key: str) -> Sequence[Block]:
        """Return the blocks; ``key`` makes the identifiers of drawings unique."""
        ...


@dataclass(frozen=True)
class Sentence:
    """A sentence with values of the dataset, left out if one of them is missing.

    Attributes
    ----------
    template : str
        Each name in braces is replaced: by an entry of ``values``, an attribute of the dataset, a figure of merit, or
        a variable of one value. Numbers have their expanded uncertainty and unit.
    values : mapping of str to (str, `Of` or callable)
        A callable of the dataset returns a text, or None for a missing value.
    when : callable
        Whether the sentence applies to the dataset.
    kind : str
        In a section: ``plain``, ``note`` or ``warning``.
    """

    template: str
    values: Mapping[str, str | Of | Callable[[xr.Dataset], Any]] = field(default_factory=dict)
    when: Callable[[xr.Dataset], bool] | None = None
    kind: str = "plain"

    def text(self, source: Source) -> str:
        """Return the sentence; empty if it does not apply or a value is missing."""
        if self.when is not None and not self.when(source.errors):
            return ""
        found = {name: self._value(source, name) for name in _NAME.findall(self.template)}
        if any(value is None for value in found.values()):
            return ""
        return _NAME.sub(lambda match: str(found[match[1]]), self.template)

    def blocks(self, source: Source, key: str) -> list[Block]:  # noqa: ARG002 - a text has no identifiers
        """Return the sentence as a paragraph."""
        text = self.text(source)
        return [document.Text(text, self.kind)] if text else []

    def _value(self, source: Source, name: str) -> str | None:
        stated, ds = self.values.get(name, name), source.errors
        if callable(stated):
            found = stated(ds)
            return None if found is None else str(found)
        if isinstance(stated, Of):
            return _of_variable(stated, ds)
        if isinstance(ds.attrs.get(stated), str | int):
            return str(ds.attrs[stated])
        for figure in chosen(source, (stated,)):
            unit, size = unit_of(figure.unit)
            return written(estimate(figure.value / size, figure.expanded_uncertainty / size, signed=False), unit)
        return _of_variable(Of(stated), ds)


def _of_variable(of: Of, ds: xr.Dataset) -> str | None:
    """Return a variable of one value as text; None if it is missing or unknown."""
    quantity = of.read(ds)
    if quantity is None or quantity.values.size != 1:
        return None
    value = quantity.values.values.ravel()[0]
    if isinstance(value, str):
        return value
    u = np.nan if quantity.u is None else float(quantity.u.values.ravel()[0])
    return written(estimate(float(value) / quantity.size, 2 * u / quantity.size), quantity.unit)


def written(cell: Cell, unit: str) -> str | None:
    """Return a value with its uncertainty and unit as text; None for a dash."""
    if cell.text == DASH:
        return None
    return f"{cell.text}{f' ± {cell.uncertainty}' if cell.uncertainty else ''} {unit}".strip()


@dataclass(frozen=True)
class Own:
    """What a method draws or writes by hand: a function ``(source, key) -> blocks``."""

    make: Callable[[Source, str], Sequence[Block]]

    def blocks(self, source: Source, key: str) -> Sequence[Block]:
        """Return the blocks of the function."""
        return self.make(source, key)


@dataclass(frozen=True)
class On:
    """Parts that read another dataset than the whole one: a selection, or one with further variables and attributes.

    ``choose`` returns it, or several, for each of which the parts are repeated; None where the parts do not apply,
    which leaves them out. In a chapter the parts are those of a chapter.
    """

    choose: Callable[[xr.Dataset], xr.Dataset | Sequence[xr.Dataset] | None]
    parts: Sequence[Element | Head]

    def blocks(self, source: Source, key: str) -> list[Block]:
        """Return the blocks of the parts for each chosen dataset."""
        return [block for each, own in self.each(source, key) for k, part in enumerate(self.parts)
                for block in part.blocks(each, f"{own}-{k}")]  # type: ignore[union-attr] # fmt: skip

    def each(self, source: Source, key: str) -> list[tuple[Source, str]]:
        """Return the source of each chosen dataset, and its key."""
        found = self.choose(source.errors)
        if found is None or isinstance(found, xr.Dataset):
            return [] if found is None else [(replace(source, errors=found), key)]
        return [(replace(source, errors=each), f"{key}-{k}") for k, each in enumerate(found)]


@dataclass(frozen=True)
class Section:
    """A titled sequence of parts, left out if none of them has anything to show.

    ``name`` is its anchor in the page; `{name}` in it and in the title is replaced by an attribute of the dataset.
    """

    name: str
    title: str
    parts: Sequence[Element]

    def made(self, source: Source, key: str) -> document.Section | None:
        """Return the section for a dataset; None without blocks."""
        name, title = (filled(text, source.errors) for text in (self.name, self.title))
        blocks = [block for k, each in enumerate(self.parts) for block in each.blocks(source, f"{key}-{name}-{k}")]
        return document.Section(name, title, blocks) if blocks else None


Head = KeyFigures | KeyValue | Sentence | Section | On | Callable[[Source], Sequence[str]]
"""A part of a chapter."""


@dataclass(frozen=True)
class Chapter:
    """A chapter as data.

    Attributes
    ----------
    title : str
        `{name}` is replaced by an attribute of the dataset.
    parts : sequence
        In their order: key figures and values, sentences of the summary, sections, and such parts `On` selections.
    kind : str
        Title line of a report that starts with this chapter.
    overview : part
        Its first drawing stands beside the summary.
    """

    title: str
    parts: Sequence[Head]
    kind: str = "Test report"
    overview: Element | None = None

    def made(self, source: Source, key: str = "") -> Part:
        """Return the chapter of a dataset; ``key`` distinguishes its drawings, by default the key of the source."""
        made = Part(filled(self.title, source.errors), list[document.KeyFigure](), [], [], kind=self.kind)
        later = list[str]()
        _add(made, later, self.parts, source, key or source.key)
        drawn = self.overview.blocks(source, f"{key or source.key}-overview") if self.overview is not None else []
        overview = next((block for block in drawn if isinstance(block, document.Figure)), None)
        return replace(made, summary=[*made.summary, *later], overview=overview)


def _add(made: Part, later: list[str], parts: Sequence[Any], source: Source, key: str) -> None:
    """Add the parts to a chapter; sentences on large uncertainties to ``later``."""
    keys, words, sections = (cast("list[Any]", each) for each in (made.key_figures, made.summary, made.sections))
    for k, each in enumerate(parts):
        if isinstance(each, KeyFigures):
            keys += each.key_figures(source)
            later += each.sentences(source)
        elif isinstance(each, KeyValue):
            keys += each.key_figures(source)
        elif isinstance(each, On):
            for chosen_source, own in each.each(source, f"{key}-{k}"):
                _add(made, later, each.parts, chosen_source, own)
        elif isinstance(each, Section):
            section = each.made(source, key)
            sections += [section] if section is not None else []
        elif isinstance(each, Sentence):
            words += [text] if (text := each.text(source)) else []
        else:
            words += each(source)
