"""Provenance: instruments, settings, software, hashes; and whether data were simulated."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any

import xarray as xr

from errormotion.report.document import Block, Cell, Source, Table, Text
from errormotion.report.text import DASH

_ATTRIBUTES = ("schema", "method", "method_version", "component", "frame", "functional_point", "reference", "sign")
_RUN = ("campaign", "bench", "inputs", "samples")
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
    """Return the table of instruments; None if the provenance has none."""
    rows = instruments(provenance)
    if not rows:
        return None
    none = Cell(DASH, reason="not recorded")
    return Table(
        "Instruments.",
        ["instrument", "manufacturer", "model", "serial number", "firmware", "address", "calibration"],
        [[row[name] or none for name in _INSTRUMENT] for row in rows],
        numeric=False,
    )


def blocks(source: Source) -> list[Block]:
    """Return the provenance as tables: instruments, settings, and other items."""
    errors, provenance = source.errors, source.provenance
    run = {name: _brief(source.run[name]) for name in _RUN if source.run.get(name)}
    found: list[Block] = []
    table = instrument_table(provenance)
    found.append(table if table is not None else Text("The provenance lists no instruments.", "note"))
    settings = [[name, value] for name, value in _flat(provenance.get("settings", {}))]
    if settings:
        found.append(
            Table(
                "Effective settings of the method, including defaults, in SI units.",
                ["setting", "value"],
                settings,
                numeric=False,
            )
        )
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


def _brief(value: Any) -> Any:
    """Return an entry of ``run.json`` without the full text of a file, which is represented by its hash."""
    return {name: entry for name, entry in value.items() if name != "text"} if isinstance(value, Mapping) else value


def _flat(value: Any) -> list[tuple[str, str]]:
    return [(".".join(path), text(leaf)) for path, leaf in walk(value) if path]


def text(value: Any) -> str:
    """Return a leaf of the provenance as text; a missing one as a dash."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if value is None or value == "" or (isinstance(value, (list, tuple, dict)) and not value):
        return DASH
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.9g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(text(entry) for entry in value)
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {text(entry)}" for key, entry in value.items())
    return str(value)
