"""Maps of earlier files of the same kind."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

from errormotion.datasets.files.tomlfile import load_model, read_toml
from errormotion.datasets.maps.form import MAP_SCHEMA, MapFile
from errormotion.datasets.maps.reading import assigned, kind_of
from errormotion.datasets.tables.format import Format
from errormotion.datasets.tables.reading import read_table
from errormotion.datasets.tables.table import Table
from errormotion.errors import DatasetError


def known_map(paths: Sequence[Path], maps: Iterable[Path]) -> Path | None:
    """Return the first map that was made for files with the same columns and units; None if there is none.

    A map that cannot be read, or has no ``kind``, is left out.
    """
    tables: dict[tuple[Path, Format], Table] = {}
    for file in maps:
        with suppress(DatasetError):
            content = read_toml(file)
            if content.get("schema") != MAP_SCHEMA or not content.get("kind"):
                continue
            settings = load_model(file, MapFile)
            own = []
            for part, path in zip(settings.parts, assigned(settings, paths, file), strict=True):
                key = path, part.format
                own.append(tables[key] if key in tables else tables.setdefault(key, read_table(path, part.format)))
            if kind_of(own) == settings.kind:
                return file
    return None
