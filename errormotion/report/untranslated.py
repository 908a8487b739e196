"""Texts of chapters that are missing in the catalogues of a language."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import xarray as xr

from errormotion.report import provenance
from errormotion.report.document import Part, Section, Source
from errormotion.report.page import annex
from errormotion.report.page.language import Catalogue
from errormotion.report.text import written_in
from errormotion.report.write import chapters


def untranslated(plugin: Any, dataset: xr.Dataset, raw: xr.Dataset | None = None, *, language: str) -> list[str]:
    """Return the texts of a dataset's chapters that neither the page nor the plugin translates.

    Parameters
    ----------
    plugin : object
        The plugin that made the dataset, with its optional ``chapters`` and ``texts``.
    dataset : Dataset
        Such as an error dataset.
    raw : Dataset, optional
        The raw dataset that it comes from.
    language : str
        One of `errormotion.report.page.language.LANGUAGES`.

    Returns
    -------
    list of str
        In their order, each once; without names and numbers in tables, which may be names of the data.
    """
    found = provenance.read(dataset) if "provenance" in dataset.attrs else {}
    source = Source(dataset, raw, {}, found)
    with written_in(language):
        own = list(plugin.chapters(source))
        parts = own or chapters(source)
    texts = plugin.texts(language)
    return missing_of(parts, annex.values([source]), language, [texts])


def missing_of(
    parts: Sequence[Part], more: Sequence[Section], language: str, catalogues: Sequence[Mapping[str, str]]
) -> list[str]:
    """Return the texts of chapters and further sections that the page and these catalogues do not translate."""
    t = Catalogue(language, catalogues)
    body, appended = annex.divided(parts)
    for part in body:
        t.part(part)
    for section in more:
        t.section(section)
    for section in appended:
        t.section(section, rows=False)
    return list(t.missing)
