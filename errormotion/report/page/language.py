"""The language of a report: the catalogue of a language translates each text of a page.

In every language, micrometres and microradians have the sign µ, also where a text of the terminal states ``um``.

A catalogue is a TOML file ``LANGUAGE.toml`` with one table: English text = its translation. ``{}`` replaces a variable
part, such as a value or a name, in the order of the English text; ``{2}`` is the second one. A text of several
sentences may be listed by sentence. Texts without entry stay English. Plugins have their own catalogues,
``texts(language)``.
"""

from __future__ import annotations

import itertools
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from html import escape, unescape
from importlib.resources import files
from typing import Any, TypeVar

from markupsafe import Markup

from errormotion.report.document import Block, Cell, Figure, Part, Section, Table, Text
from errormotion.report.text import signs

LANGUAGES = ("en", "de")
COMMA = ("de",)
"""Languages with a decimal comma."""
TO = {"de": " bis "}
"""Text between the ends of a range of numbers."""
LONGEST = 4000
"""Characters of a text that is compared with the catalogue."""

_SENTENCES = re.compile(r"(?<=[.!?]) (?=[A-ZÄÖÜ(|±])")
_DECIMAL = re.compile(r"[+−-]?\d+\.\d+")
_WORD = re.compile(r"[a-z]{3}")
_LETTERS = re.compile(r"[a-z]{2}")
_BEFORE_UNIT = re.compile(r"(?<![\w.])\d+\.\d+(?= (?:[uµ]?m|mm|[uµm]?rad|arcsec|%|K|min|s|±)(?!\w)|°)")
_NUMBER = re.compile(r"(?<![\w.])\d+\.\d+(?!\w|\.\d)")
_RANGE = re.compile(r"(?<=[\d%∞]) to (?=[+−]?[\d∞])")
_LIST = re.compile(r"(, | und )")
_UNITS = re.compile(r"\b(?:arcsec|min|m?rad|days)\b")
_SVG_TEXT = re.compile(r"(?<=>)([^<>]*[^<>\s][^<>]*)(?=</(?:text|span|label)>)")
_SVG_NAME = re.compile(r'(?:(?<= data-x-name=")|(?<= aria-label="))([^"]+)(?=")')
_AnyBlock = TypeVar("_AnyBlock", bound=Block)


def texts_of(package: str, language: str) -> dict[str, str]:
    """Return the catalogue of a package, its file ``LANGUAGE.toml``; empty if it has none."""
    if language not in LANGUAGES or language == "en":
        return {}
    file = files(package) / f"{language}.toml"
    return dict(tomllib.loads(file.read_text(encoding="utf-8"))) if file.is_file() else {}


@cache
def _own(language: str) -> dict[str, str]:
    return texts_of("errormotion.report.page.catalogues", language)


class Catalogue:
    """Translates the texts of a page.

    Parameters
    ----------
    language : str
        One of `LANGUAGES`.
    more : sequence of mapping
        Catalogues of plugins.

    Attributes
    ----------
    missing : dict of str to None
        Texts that were not found, in their order.
    """

    def __init__(self, language: str, more: Sequence[Mapping[str, str]] = ()) -> None:
        self.language = language if language in LANGUAGES else "en"
        self.missing: dict[str, None] = {}
        known = {str(key): str(text) for each in (*more, _own(self.language)) for key, text in each.items()}
        self._exact = {key: text for key, text in known.items() if "{" not in key}
        patterns = sorted((key for key in known if "{}" in key), key=lambda key: -len(key))
        self._patterns = [(_pattern(key), known[key]) for key in patterns]

    def __call__(self, text: Any) -> Any:
        """Return a text in the language; sentences one by one if it is not listed as a whole."""
        if not isinstance(text, str) or isinstance(text, Markup) or not text.strip():
            return text
        if self.language == "en":
            return signs(text)
        sentences = _SENTENCES.split(text)
        if len(sentences) > 1 and text not in self._exact:
            return " ".join(str(self(each)) for each in sentences)
        found = self._found(text)
        if found is None:
            self.missing[text] = None
        return text if found is None else found

    def word(self, text: Any) -> Any:
        """Return a name or a number in the language; a text without entry is a name of the data and stays unchanged."""
        if not isinstance(text, str) or isinstance(text, Markup):
            return text
        if self.language == "en":
            return signs(text)
        found = self._found(text)
        if found is not None:
            return found
        pieces = _LIST.split(text)
        made = [self._found(piece) for piece in pieces[::2]]
        if len(made) < 2 or all(each is None for each in made):
            return self._with_units(text)
        pieces[::2] = [piece if each is None else each for piece, each in zip(pieces[::2], made, strict=True)]
        return "".join(pieces)

    def _with_units(self, text: str, decimals: re.Pattern[str] = _BEFORE_UNIT) -> str:
        """Return a text with the decimal sign of the language at ``decimals``, and the signs of all pages."""
        text = signs(text)
        if self.language in COMMA:
            text = decimals.sub(lambda found: found[0].replace(".", ","), text)
        return _RANGE.sub(TO.get(self.language, " to "), text)

    def _found(self, text: str) -> str | None:
        plain = " ".join(text.split()) if len(text) <= LONGEST else ""
        if _DECIMAL.fullmatch(plain):
            return plain.replace(".", ",") if self.language in COMMA else plain
        if plain in self._exact:
            return self._exact[plain]
        if not _LETTERS.search(_UNITS.sub("", plain)):
            return self._with_units(text, _NUMBER)  # a symbol, numbers, a unit
        name, slash, unit = plain.rpartition(" / ")
        if slash and name in self._exact:  # the head of a column
            return f"{self._exact[name]} / {self.word(unit)}"
        for pattern, made in self._patterns:
            match = pattern.fullmatch(plain)
            if match is not None:
                return _filled(made, [str(self.word(each)) for each in match.groups()])
        if not _WORD.search(_UNITS.sub("", plain)):
            return self._with_units(text, _NUMBER)
        pieces = plain.split("; ")
        found = [self._found(each) for each in pieces] if len(pieces) > 1 else []
        if any(each is not None and each != piece for each, piece in zip(found, pieces, strict=False)):
            return "; ".join(each or piece for each, piece in zip(found, pieces, strict=True))
        return None

    def svg(self, drawing: Markup) -> Markup:
        """Return a drawing with its texts in the language."""
        text = _SVG_TEXT.sub(lambda found: escape(str(self._label(unescape(found[1]))), quote=False), str(drawing))
        return Markup(_SVG_NAME.sub(lambda found: escape(str(self.word(unescape(found[1])))), text))

    def _label(self, text: str) -> Any:
        """Return a text of a drawing: an axis has a quantity and a unit, other texts may be names of the data."""
        return self(text) if " / " in text else self.word(text)

    def cell(self, cell: Cell | str) -> Cell | str:
        """Return a cell with its text and its reason in the language."""
        if not isinstance(cell, Cell):
            return str(self.word(cell)) if not isinstance(cell, Markup) else cell
        return Cell(self.word(cell.text), self.word(cell.uncertainty), self(cell.reason))

    def block(self, block: _AnyBlock, *, rows: bool = True) -> _AnyBlock:
        """Return a block in the language; without ``rows``, the rows of a table stay unchanged."""
        made: Block
        if isinstance(block, Text):
            made = replace(block, text=self(block.text))
        elif isinstance(block, Figure):
            made = Figure(self.svg(block.svg), self(block.caption), self(block.alt))
        else:
            made = replace(
                block,
                caption=self(block.caption),
                head=[self(name) for name in block.head],
                groups=[(self(name), span) for name, span in block.groups],
                rows=[[self.cell(cell) for cell in row] for row in block.rows] if rows else self._reasons(block),
                notes=[self(note) for note in block.notes],
            )
        return made  # type: ignore[return-value]

    def _reasons(self, table: Table) -> list[list[Cell | str]]:
        """Return the rows of a table with only the reasons of missing values in the language."""
        return [
            [Cell(cell.text, cell.uncertainty, self(cell.reason)) if isinstance(cell, Cell) else cell for cell in row]
            for row in table.rows
        ]

    def section(self, section: Section, *, rows: bool = True) -> Section:
        """Return a section in the language."""
        blocks = [self.block(block, rows=rows) for block in section.blocks]
        return replace(section, title=self(section.title), blocks=blocks)

    def part(self, part: Part) -> Part:
        """Return a chapter in the language."""
        return replace(
            part,
            title=self(part.title),
            kind=self(part.kind),
            key_figures=[
                replace(
                    each,
                    label=self.word(each.label) if each.named else self(each.label),
                    value=Cell(**vars(self.cell(each.value))),
                    unit=self.word(each.unit),
                    note=self(each.note),
                )
                for each in part.key_figures
            ],
            summary=[self(sentence) for sentence in part.summary],
            sections=[self.section(section) for section in part.sections],
            overview=self.block(part.overview) if part.overview is not None else None,
        )


@cache
def _pattern(key: str) -> re.Pattern[str]:
    parts = key.split("{}")
    made = re.escape(parts[0])
    for before, after in itertools.pairwise(parts):
        listing = before.endswith(": ") and after in ("", ".")  # the end of a sentence may be an enumeration
        made += rf"((?:(?!{_SENTENCE_END if listing else _PIECE_END}).)+?)" + re.escape(after)
    return re.compile(made, re.DOTALL)


_SENTENCE_END, _PIECE_END = r"\. [A-Z]", r"\. [A-Z]|; "


def _filled(text: str, values: Sequence[str]) -> str:
    """Return a text with its values: ``{}`` in order, ``{2}`` the second one."""
    rest = iter(values)

    def value(found: re.Match[str]) -> str:
        if not found[1]:
            return next(rest, "")
        number = int(found[1])
        return values[number - 1] if 0 < number <= len(values) else ""

    return re.sub(r"\{(\d{0,2})\}", value, text)
