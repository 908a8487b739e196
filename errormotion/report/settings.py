"""Settings of a method for a reader: as in the campaign or in field units, and as SI values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from errormotion import plugins
from errormotion.datasets.files import tomlfile
from errormotion.errors import ErrormotionError

_DEEPEST = 16
_FIELD = {
    "m": (("mm", 1e-3, 1e-4), ("µm", 1e-6, 0.0)),
    "rad": (("deg", math.pi / 180, math.pi / 180), ("arcsec", math.pi / 648000, 0.0)),
    "s": (("min", 60.0, 120.0), ("s", 1.0, 0.0)),
    "Hz": (("kHz", 1e3, 1e3), ("Hz", 1.0, 0.0)),
    "m/s": (("mm/min", 1e-3 / 60, 0.0),),
    "m/K": (("um/K", 1e-6, 0.0),),
}
"""Field units of an SI unit: name, size, and the smallest value that is shown in it."""


def units(model: Any) -> dict[tuple[str, ...], str]:
    """Return the units of the settings of a plugin by their paths; ``*`` stands for any key or number of an array."""
    try:
        schema = model.model_json_schema()
    except Exception:  # noqa: BLE001 - of a foreign plugin
        return {}
    return dict(_units(schema, schema.get("$defs", {}), (), _DEEPEST))


def _units(
    schema: Any, defs: Mapping[str, Any], path: tuple[str, ...], depth: int
) -> Iterator[tuple[tuple[str, ...], str]]:
    if not isinstance(schema, Mapping) or not depth:
        return
    if isinstance(schema.get("unit"), str):
        yield path, schema["unit"]
    reference = schema.get("$ref")
    if isinstance(reference, str):
        yield from _units(defs.get(reference.rpartition("/")[2]), defs, path, depth - 1)
    for each in (*schema.get("anyOf", ()), *schema.get("allOf", ()), *schema.get("oneOf", ())):
        yield from _units(each, defs, path, depth - 1)
    for name, each in schema.get("properties", {}).items():
        yield from _units(each, defs, (*path, name), depth - 1)
    for each in (schema.get("additionalProperties"), schema.get("items"), *schema.get("prefixItems", ())):
        yield from _units(each, defs, (*path, "*"), depth - 1)


def stated(run: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the settings of the test as in its campaign file; empty if unknown."""
    campaign = run.get("campaign")
    text = campaign.get("text") if isinstance(campaign, Mapping) else None
    if not isinstance(text, str):
        return {}
    try:
        tests = tomlfile.parse_toml(text, "campaign").get("test")
    except ErrormotionError:
        return {}
    for test in tests if isinstance(tests, list) else []:
        if isinstance(test, Mapping) and test.get("name") == run.get("test"):
            found = test.get("settings")
            return found if isinstance(found, Mapping) else {}
    return {}


def unit_of(known: Mapping[tuple[str, ...], str], path: Sequence[str]) -> str:
    """Return the unit of the setting at a path; empty if it has none."""
    for pattern, unit in known.items():
        leaf = pattern[:-1] if len(pattern) == len(path) + 1 and pattern[-1] == "*" else pattern  # a list is one leaf
        if len(leaf) == len(path) and all(a in ("*", b) for a, b in zip(leaf, path, strict=True)):
            return unit
    return ""


def field(value: Any, unit: str) -> str:
    """Return an SI number, or a list of numbers, in a field unit with its name."""
    numbers = value if isinstance(value, (list, tuple)) else [value]
    known = [abs(each) for each in numbers if isinstance(each, (int, float)) and not isinstance(each, bool)]
    if len(known) != len(numbers) or not known:
        return ""
    options = _FIELD.get(unit, ((unit, 1.0, 0.0),))
    name, size, _ = next((each for each in options if max(known) >= each[2]), options[-1])
    return f"{', '.join(f'{each / size:.6g}' for each in numbers)} {name}"


def settings_class(method: str) -> Any:
    """Return the model of the settings of a method; None if its plugin is not installed."""
    return getattr(plugins.owner_of_method(method), "Settings", None)
