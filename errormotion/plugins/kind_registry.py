"""Registry of the kinds of instrument, and the comparison of a driver with the contract of its kind.

A contract is a Protocol; see `errormotion.plugins.kinds`. Distributions register contracts in the entry-point group
``errormotion.kinds``; the built-in contracts are registered in the same way.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from errormotion.errors import PluginError

GROUP = "errormotion.kinds"
Contract = TypeVar("Contract", bound=type)
_STATED = ("plausible", "capabilities")
_NO_MEMBERS = (*_STATED, "changes_machine")


def contract(
    *, plausible: tuple[float, float] | None = None, capabilities: tuple[type, ...] = ()
) -> Callable[[Contract], Contract]:
    """Return a decorator that completes a Protocol to the contract of a kind."""

    def complete(cls: Contract) -> Contract:
        for name, value in zip(_STATED, (plausible, capabilities), strict=True):
            setattr(cls, name, value)
        return cls

    return complete


@cache
def _points() -> Mapping[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}


def changing(cls: Contract) -> Contract:
    """Mark a capability whose methods move or change a machine.

    An instrument with it needs the setting ``arm``, default false, without which it refuses these methods, and a
    method ``bound(limits)``, after which each command is checked against a `MachineLimits`.
    """
    cls.changes_machine = True  # type: ignore[attr-defined]
    return cls


def changes_machine(driver: Any) -> tuple[str, ...]:
    """Return the methods and attributes by which a driver, or its class, can move or change a machine."""
    return _changes(driver, kind(driver.info.kind))


def _changes(driver: Any, protocol: Any) -> tuple[str, ...]:
    changes: list[str] = []
    for capability in getattr(protocol, "capabilities", ()):
        if getattr(capability, "changes_machine", False) and _has(driver, _first(capability)):
            changes += members(capability)
    return tuple(dict.fromkeys(changes))


def kind_changes_machine(name: str) -> bool:
    """Return whether instruments of a kind may be able to move or change a machine."""
    return any(getattr(capability, "changes_machine", False) for capability in getattr(kind(name), "capabilities", ()))


def kinds() -> tuple[str, ...]:
    """Return the names of all registered kinds."""
    return tuple(sorted(_points()))


def kind(name: str) -> Any:
    """Return the contract of a kind, None if there is none.

    Raises
    ------
    PluginError
        The registered object cannot be loaded, or is not a Protocol.
    """
    point = _points().get(name)
    if point is None:
        return None
    try:
        loaded = point.load()
    except Exception as error:
        raise PluginError(
            f"The kind '{name}' ({point.value}) does not load: {type(error).__name__}: {error}",
            code="plugin.kind.not_loaded",
        ) from error
    if not getattr(loaded, "_is_protocol", False):
        raise PluginError(
            f"The kind '{name}': expected a Protocol class at {point.value}; found {loaded!r}", code="plugin.kind.form"
        )
    return loaded


def refresh() -> None:
    """Read the entry points again at the next call."""
    _points.cache_clear()


def plausible(name: str) -> tuple[float, float] | None:
    """Return the lowest and highest plausible reading of a kind in SI units, None without bounds."""
    bounds: tuple[float, float] | None = getattr(kind(name), "plausible", None)
    return bounds


def members(protocol: type) -> dict[str, Any]:
    """Return the members of a Protocol: a function for a method, None for an attribute."""
    by_name: dict[str, Any] = {}
    for base in reversed(protocol.__mro__):
        if getattr(base, "_is_protocol", False):
            for name in (*vars(base).get("__annotations__", {}), *vars(base)):
                value = vars(base).get(name)
                if not name.startswith("_") and name not in _NO_MEMBERS:
                    by_name[name] = value if inspect.isfunction(value) else None
    return by_name


def members_of(driver: Any, protocol: Any) -> dict[str, Any]:
    """Return the members of a contract and of its capabilities that a driver has; see `members`."""
    by_name = members(protocol)
    for capability in getattr(protocol, "capabilities", ()):
        if _has(driver, _first(capability)):
            by_name |= members(capability)
    return {name: method for name, method in by_name.items() if _has(driver, name)}


def deviations(driver: Any, protocol: type) -> list[str]:
    """Return the deviations of an instrument from a contract, one sentence each; nothing is called.

    Parameters
    ----------
    driver : Instrument
        An instance that is not open.
    protocol : type
        The contract of its kind.
    """
    texts = _lacking(driver, protocol)
    for capability in getattr(protocol, "capabilities", ()):
        if _has(driver, _first(capability)):
            texts += [f"{text} ({capability.__name__})" for text in _lacking(driver, capability)]
    if _changes(driver, protocol):
        arm = type(driver).Settings.model_fields.get("arm")
        if arm is None or arm.default is not False:
            texts.append("it can change a machine: expected the setting 'arm' with the default false")
        if not callable(getattr(driver, "bound", None)):
            texts.append("it can change a machine: expected bound(limits: MachineLimits)")
    return texts


def _first(capability: type) -> str:
    names = members(capability)
    return next((name for name, method in names.items() if method), next(iter(names)))


def _has(driver: Any, name: str) -> bool:
    cls = driver if isinstance(driver, type) else type(driver)
    annotated = any(name in vars(base).get("__annotations__", {}) for base in cls.__mro__)
    return annotated or inspect.getattr_static(driver, name, None) is not None


def _lacking(driver: Any, protocol: type) -> list[str]:
    texts = []
    for name, method in members(protocol).items():
        if not _has(driver, name):
            texts.append(f"'{name}' is missing")
            continue
        static = inspect.getattr_static(driver, name, None)
        if method is None:
            if inspect.isfunction(static):
                texts.append(f"'{name}' is a method, expected an attribute or property")
        elif not callable(static) and not isinstance(static, staticmethod | classmethod):
            texts.append(f"'{name}' is not a method, expected {name}{_shown(method)}")
        elif not _accepts(getattr(driver, name), method):
            texts.append(f"expected {name}{_shown(method)}, found {name}{inspect.signature(getattr(driver, name))}")
    return texts


def _shown(method: Any) -> str:
    signature = inspect.signature(method)
    return str(signature.replace(parameters=list(signature.parameters.values())[1:]))


def _accepts(member: Any, method: Any) -> bool:
    """Whether a bound method accepts all calls that the method of the contract allows."""
    expected = list(inspect.signature(method).parameters.values())[1:]
    required = [each for each in expected if each.default is each.empty]
    try:
        signature = inspect.signature(member)
        for called in (required, expected):
            for by_name in (False, True):
                named = [each for each in called if by_name or each.kind is each.KEYWORD_ONLY]
                placed = [each for each in called if each not in named]
                signature.bind(*placed, **{each.name: None for each in named})
    except TypeError:
        return False
    return True
