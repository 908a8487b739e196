"""The registry: finds plugins through the entry points of all distributions.

The built-in plugins are registered in the same way. The entry points are read once, a plugin is loaded at its first
use, and a broken plugin is listed with its error.
"""

from __future__ import annotations

import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib.metadata import Distribution, EntryPoint, distributions
from typing import Any, Literal

from errormotion.errors import PluginError, PluginWarning
from errormotion.plugins import kind_registry
from errormotion.plugins.base import DatasetPlugin, Method, adapted, states
from errormotion.plugins.contracts import DatasetInfo, InstrumentInfo, MethodInfo

Group = Literal["instruments", "methods", "datasets", "compensators"]
GROUPS: tuple[Group, ...] = ("instruments", "methods", "datasets", "compensators")
RAW = "errormotion.raw."
"""Start of the raw schemas."""


@dataclass(frozen=True)
class Plugin:
    """One entry of the registry: the class, or the error of loading it."""

    id: str
    group: Group
    entry_point: EntryPoint
    cls: Any = None
    error: str = ""
    traceback: str = ""

    @property
    def distribution(self) -> str:
        """Name and version of the distribution of the plugin."""
        return _name_and_version(self.entry_point.dist)


#: Type of ``info`` that the registry requires; the conformance kit checks the rest.
_REQUIRED: Mapping[Group, tuple[type[InstrumentInfo | MethodInfo | DatasetInfo], tuple[str, ...]]] = {
    "instruments": (InstrumentInfo, ("Settings", "open", "close", "identify", "read")),
    "methods": (MethodInfo, ("Settings", "needs", "acquire", "append_dim", "progress", "identify", "plan")),
    "datasets": (DatasetInfo, ()),
    "compensators": (InstrumentInfo, ("Settings", "open", "close", "identify", "arm", "read", "write")),
}


def _has(cls: Any, name: str) -> bool:
    """Return whether a class states a required part, which its base class only declares."""
    return hasattr(cls, name) and (not hasattr(Method, name) or states(cls, name))


def _name_and_version(dist: Distribution | None) -> str:
    try:
        stated = None if dist is None else dist.metadata
    except (AttributeError, KeyError, OSError, TypeError):  # a distribution without readable metadata
        stated = None
    if stated is None or "Name" not in stated or "Version" not in stated:
        return "unknown"
    return f"{stated['Name']} {stated['Version']}"


def _with_plugins() -> Iterator[tuple[Distribution, str]]:
    """Yield every distribution with entry points of errormotion, and the text of its entry points.

    Reading the name of a distribution is slow, and is done only for these.
    """
    seen: set[str] = set()
    for dist in distributions():
        text = dist.read_text("entry_points.txt") or ""
        if "errormotion." not in text:
            continue
        name = _name_and_version(dist).partition(" ")[0]
        if name == "unknown":
            yield dist, text
        elif name not in seen:
            seen.add(name)
            first = next(iter(distributions(name=name)), dist)  # of two copies, the first on the path is used
            if first.read_text("entry_points.txt") == text:
                yield dist, text


@cache
def _found() -> Mapping[Group, tuple[EntryPoint, ...]]:
    """Read the entry points of every distribution.

    An entry point without a value replaces an unreadable list of a distribution.
    """
    found: dict[Group, list[EntryPoint]] = {group: [] for group in GROUPS}
    for dist, text in _with_plugins():
        try:
            points = tuple(dist.entry_points)
        except Exception:  # noqa: BLE001 - a faulty list affects no other distribution
            name = _name_and_version(dist).partition(" ")[0]
            points = tuple(EntryPoint(name, "", f"errormotion.{group}") for group in GROUPS if group in text)
        for group in GROUPS:
            found[group].extend(point for point in points if point.group == f"errormotion.{group}")
    return {group: tuple(points) for group, points in found.items()}


@cache
def _loaded(group: Group, point: EntryPoint) -> Plugin:
    kind, required = _REQUIRED[group]
    try:
        if not point.value:
            raise PluginError(
                "entry_points.txt cannot be read; expected sections with lines 'id = module:Class'",
                code="plugin.entry_points.unreadable",
            )
        cls = point.load()
        info = getattr(cls, "info", None)
        if not isinstance(info, kind):
            raise PluginError(
                f"{point.value}: expected a class with an `info` of type {kind.__name__}, found {info!r}",
                code="plugin.info.form",
            )
        if missing := [name for name in required if not _has(cls, name)]:
            raise PluginError(f"class {cls.__name__} lacks {', '.join(missing)}", code="plugin.members.missing")
        cls = adapted(cls, group)
        if info.id != point.name:
            raise PluginError(
                f"the entry point is called '{point.name}', but the id of the class is '{info.id}'",
                code="plugin.id.differs",
            )
    except (Exception, SystemExit) as error:  # noqa: BLE001 - a broken plugin affects no other plugin
        return Plugin(
            point.name,
            group,
            point,
            error=f"{type(error).__name__}: {error}",
            traceback=traceback.format_exc(),
        )
    return Plugin(point.name, group, point, cls)


def available(group: Group) -> list[Plugin]:
    """Return all plugins of a group sorted by id, including broken ones and those with the same id."""
    points = sorted(_found()[group], key=lambda point: point.name)
    claims = Counter(point.name for point in points)
    return [
        _loaded(group, point)
        if claims[point.name] == 1
        else Plugin(point.name, group, point, error=_rivals(group, point.name))
        for point in points
    ]


def _rivals(group: Group, plugin_id: str) -> str:
    sources = ", ".join(_name_and_version(point.dist) for point in _found()[group] if point.name == plugin_id)
    return f"Several distributions provide the {group.rstrip('s')} '{plugin_id}': {sources}. Remove all but one."


def get(group: Group, plugin_id: str) -> Any:
    """Return the class of a plugin; that of a method also by a former id, with a warning.

    Raises
    ------
    PluginError
        The id is unknown, two distributions provide it, or the plugin cannot be loaded.
    """
    points = [point for point in _found()[group] if point.name == plugin_id]
    what = group.rstrip("s")
    if not points:
        if group == "methods" and (renamed := _renamed(plugin_id)) is not None:
            return renamed
        names = sorted({point.name for point in _found()[group]})
        near = get_close_matches(plugin_id, names, n=1)
        hint = f" Did you mean '{near[0]}'?" if near else ""
        raise PluginError(
            f"No {what} plugin '{plugin_id}'; available: {', '.join(names) or 'none'}.{hint}", code="plugin.unknown"
        )
    if len(points) > 1:
        raise PluginError(_rivals(group, plugin_id), code="plugin.ambiguous")
    plugin = _loaded(group, points[0])
    if plugin.error:
        raise PluginError(
            f"The {what} plugin '{plugin_id}' ({plugin.distribution}) does not load: {plugin.error}",
            code="plugin.not_loaded",
        )
    return plugin.cls


def loaded(*groups: Group) -> Iterator[Any]:
    """Yield the classes of the plugins of some groups, without broken ones."""
    for group in groups:
        for plugin in available(group):
            if plugin.cls is not None:
                yield plugin.cls


def brought(name: str, *groups: Group) -> Iterator[tuple[Any, Any]]:
    """Yield each plugin class of some groups with an attribute of this name, and the attribute.

    A plugin whose attribute cannot be loaded is omitted with a warning.
    """
    for cls in loaded(*groups):
        value = _attribute(cls, name)
        if value:
            yield cls, value


def _attribute(cls: Any, name: str) -> Any:
    """Return an attribute of a plugin class; None if it has none or, with a warning, if it cannot be loaded."""
    try:
        return getattr(cls, name, None)
    except (Exception, SystemExit) as error:  # noqa: BLE001 - a broken plugin affects no other plugin
        _warn(f"The plugin '{cls.info.id}': `{name}` is ignored: {error}")
        return None


@cache
def _warn(message: str) -> None:
    """Warn once."""
    warnings.warn(message, PluginWarning, stacklevel=4)


def owner_of_schema(schema: str) -> Any:
    """Return the plugin class whose datasets have this schema; None if there is none.

    For a schema ``errormotion.raw.NAME/1``, the plugin NAME is tried first, and last a method with the former id NAME.
    """
    name = schema.removeprefix("errormotion.").removeprefix("raw.").partition("/")[0]
    for cls in _named_first(name, ("methods", "datasets")):
        if schema in _schemas_of(cls):
            return cls
    renamed = _renamed(name)
    return renamed if renamed is not None and present_schema(schema, renamed) in _schemas_of(renamed) else None


def present_schema(schema: str, cls: Any) -> str:
    """Return the raw schema of a plugin class for one that has a former id of it; any other schema unchanged."""
    name, _, number = schema.removeprefix(RAW).partition("/")
    return f"{RAW}{cls.info.id}/{number}" if name in getattr(cls.info, "former", ()) else schema


def owner_of_method(method: str) -> Any:
    """Return the plugin class whose error datasets have this attribute ``method``; None if there is none."""
    for cls in _named_first(method, ("methods", "datasets")):
        if method == cls.info.id or (issubclass(cls, DatasetPlugin) and method in cls.info.methods):
            return cls
    return _renamed(method)


def _renamed(name: str) -> Any:
    """Return the method that once had this id, with a warning; None if there is none."""
    for cls in loaded("methods"):
        if name in cls.info.former:
            _warn(f"The method '{name}' is called '{cls.info.id}' now. Write '{cls.info.id}' in its place.")
            return cls
    return None


def _named_first(name: str, groups: tuple[Group, ...]) -> Iterator[Any]:
    """Yield the plugins of one name, then all others: usually only one plugin is loaded."""
    for group in groups:
        if sum(point.name == name for point in _found()[group]) == 1:
            plugin = _loaded(group, next(point for point in _found()[group] if point.name == name))
            if plugin.cls is not None:
                yield plugin.cls
    yield from loaded(*groups)


def _schemas_of(cls: Any) -> set[str]:
    own = set(cls.info.schemas) if issubclass(cls, DatasetPlugin) else {cls.needs.raw_schema}
    return own | {getattr(table, "id", "") for table in _attribute(cls, "raw_schemas") or ()}


def refresh() -> None:
    """Read the entry points again at the next call."""
    _found.cache_clear()
    _loaded.cache_clear()
    _warn.cache_clear()
    kind_registry.refresh()
