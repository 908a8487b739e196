"""Provenance: instruments, settings, software, hashes; and whether data were simulated."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

import xarray as xr

from errormotion.report import settings
from errormotion.report.document import Block, Cell, Source, Table, Text
from errormotion.report.text import DASH

SIMULATED = "simulated"
"""Machine of data that a method simulates from its own model."""
_ATTRIBUTES = ("schema", "method", "method_version", "component", "frame", "functional_point", "reference", "sign")
_RUN = ("campaign", "bench", "imported", "inputs", "samples")
_ROOT = r"(?:~[\\/]|/|[A-Za-z]:[\\/]|\\\\)"
_WHOLE_PATH = re.compile(rf"{_ROOT}[^\\/\n]+[\\/][^\n]*$")
_PATH = re.compile(rf"(?<![^\s'\"(=,;\[]){_ROOT}(?:[^\\/\s'\"<>|,;]+[\\/])+[^\\/\s'\"<>|,;]*")
_INSTRUMENT = ("name", "manufacturer", "model", "serial_number", "firmware", "address", "calibration")


def read(errors: xr.Dataset) -> dict[str, Any]:
    """Return the provenance of a dataset; text that is not a JSON object is returned under ``text``."""
    text = errors.attrs.get("provenance", "{}")
    if isinstance(text, Mapping):
        return dict(text)
    try:
        found = json.loads(text)
    except (TypeError, ValueError, RecursionError):
        return {"text": str(text)}
    return found if isinstance(found, dict) else {"text": str(text)}


def simulated(*sources: Any) -> str:
    """Return why nested data are considered simulated; empty if they are not."""
    for source in sources:
        for path, value in walk(source):
            address = _address(value, "sim://", "twin://")
            if address:
                return f"instrument address {address}"
            if path and path[-1] == "simulated" and (value is True or value == 1 or str(value).lower() == "true"):
                return "the provenance marks them as simulated"
    return ""


def replayed(*sources: Any) -> str:
    """Return the address of a replayed recording; empty if there is none."""
    return next(
        (found for source in sources for _, value in walk(source) if (found := _address(value, "replay://"))), ""
    )


def _address(leaf: Any, *schemes: str) -> str:
    """Return the first address with one of these schemes in a leaf, including JSON text; empty if there is none."""
    entries = leaf if isinstance(leaf, (list, tuple)) else [leaf]
    pattern = rf'(?:^\s*|")((?:{"|".join(schemes)})[^"]*)'
    found = (re.search(pattern, entry, re.IGNORECASE) for entry in entries if isinstance(entry, str))
    return next((match[1].strip() for match in found if match), "")


def walk(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every leaf of nested mappings and sequences with its path; a list of plain values is one leaf."""
    if isinstance(value, Mapping) and value:
        for key, entry in value.items():
            yield from walk(entry, (*path, str(key)))
    elif isinstance(value, (list, tuple)) and any(isinstance(entry, (Mapping, list, tuple)) for entry in value):
        for i, entry in enumerate(value):
            yield from walk(entry, (*path, str(i + 1)))
    else:
        yield path, value


def instruments(provenance: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return the instruments as flat rows of text."""
    entries = provenance.get("instruments")
    if isinstance(entries, Mapping):
        entries = [{"name": name, **entry} for name, entry in entries.items() if isinstance(entry, Mapping)]
    if not isinstance(entries, (list, tuple)):
        return []
    rows = []
    for entry in entries:
        if isinstance(entry, Mapping):
            flat = {**entry, **(entry["identity"] if isinstance(entry.get("identity"), Mapping) else {})}
            flat.setdefault("name", flat.get("id", flat.get("driver", flat.get("kind", ""))))
            flat.setdefault("serial_number", flat.get("serial", ""))
            rows.append({name: text(flat[name]) if flat.get(name) else "" for name in _INSTRUMENT})
    return rows


def instrument_table(provenance: Mapping[str, Any]) -> Table | None:
    """Return the table of instruments with what is known of any; None if the provenance has none."""
    rows = instruments(provenance)
    if not rows:
        return None
    none = Cell(DASH, reason="not recorded")
    shown = [name for name in _INSTRUMENT if any(row[name] for row in rows)]
    head = ["instrument" if name == "name" else name.replace("_", " ") for name in shown]
    return Table("Instruments.", head, [[row[name] or none for name in shown] for row in rows], numeric=False)


def blocks(source: Source) -> list[Block]:
    """Return the provenance as tables: instruments, settings, and other items."""
    errors, provenance = source.errors, source.provenance
    run = {name: _brief(source.run[name]) for name in _RUN if source.run.get(name)}
    found: list[Block] = []
    table = instrument_table(provenance)
    found.append(table if table is not None else Text("The provenance lists no instruments.", "note"))
    effective = settings_rows(source)
    if effective:
        caption = "Effective settings of the method, including defaults: as the campaign states them, and in SI units."
        found.append(Table(caption, ["setting", "value", "SI"], effective, numeric=False))
    attributes = [[name.replace("_", " "), text(errors.attrs[name])] for name in _ATTRIBUTES if name in errors.attrs]
    rest = {name: value for name, value in provenance.items() if name not in ("settings", "instruments")}
    found.append(
        Table(
            "Result, software and data.",
            ["item", "value"],
            [*attributes, *map(list, _flat({**run, **rest}))],
            numeric=False,
        )
    )
    return found


def settings_rows(source: Source) -> list[list[Cell | str]]:
    """Return the effective settings: path, value as in the campaign or in field units, SI value with its unit."""
    effective = source.provenance.get("settings", {})
    units = settings.units(settings.settings_class(str(source.errors.attrs.get("method"))))
    written = {path: text(leaf) for path, leaf in walk(settings.stated(source.run))}
    rows: list[list[Cell | str]] = []
    for path, leaf in walk(effective):
        if not path:
            continue
        unit = settings.unit_of(units, path)
        shown = written.get(path) or (settings.field(leaf, unit) if unit else "") or text(leaf)
        rows.append([".".join(path), shown, f"{text(leaf)} {unit}" if unit and text(leaf) != DASH else ""])
    return rows


def _brief(value: Any) -> Any:
    """Return an entry of ``run.json`` without the full text of a file (its hash identifies it) and its folder."""
    if not isinstance(value, Mapping):
        return value
    return {name: entry for name, entry in value.items() if name not in ("text", "folder")}


def _flat(value: Any) -> list[tuple[str, str]]:
    return [(".".join(path), text(leaf)) for path, leaf in walk(value) if path]


def public(text: str) -> str:
    """Return a text without the folders of this computer: an absolute path is reduced to the name of its file."""
    if _WHOLE_PATH.match(text):
        return re.split(r"[\\/]", text.rstrip("\\/"))[-1]
    return _PATH.sub(lambda found: re.split(r"[\\/]", found[0].rstrip("\\/"))[-1], text)


def text(value: Any) -> str:
    """Return a leaf of the provenance as text, without private paths; a missing one as a dash."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if value is None or value == "" or (isinstance(value, (list, tuple, dict)) and not value):
        return DASH
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value + 0.0:.9g}"  # no negative zero
    if isinstance(value, (list, tuple)):
        return ", ".join(text(entry) for entry in value)
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {text(entry)}" for key, entry in value.items())
    return public(str(value))
