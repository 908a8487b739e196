"""Parts of checks that are common to instruments, methods and compensators."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any, get_args

from pydantic import ValidationError

from errormotion.errors import ErrormotionError, InstrumentError
from errormotion.plugins import Identity, PluginSettings, Status, load_object
from errormotion.testing.kit import require
from errormotion.testing.sessions import open_things


def check_info(info: Any, cls: type, *names: str) -> None:
    """Check the description of a plugin; ``names`` are the attributes that must be identifiers."""
    require(isinstance(info, cls), f"expected an {cls.__name__}, found {type(info).__name__}")
    for name in names:
        value = getattr(info, name)
        good = isinstance(value, str) and value.isidentifier() and value == value.lower()
        require(good, f"info.{name}: expected lower case letters, digits and _, found {value!r}")
    require(len(info.summary.strip()) >= 10, f"info.summary: expected a sentence, found {info.summary!r}")
    require(info.status in get_args(Status), f"info.status: expected one of {get_args(Status)}, found {info.status!r}")
    require(bool(info.version), "info.version is empty")
    if getattr(info, "simulator", None) is not None:
        load_object(info.simulator)


def check_settings(cls: Any, settings: Any) -> str:
    """Check a class of settings with one instance."""
    require(issubclass(cls, PluginSettings), f"expected a subclass of PluginSettings, found {cls.__name__}")
    require(isinstance(settings, cls), f"expected the Settings of the plugin, found a {type(settings).__name__}")
    stored = json.loads(settings.model_dump_json())
    require(cls.model_validate(stored) == settings, f"settings are changed after a round trip through JSON: {stored}")
    try:
        cls.model_validate(stored | {"no_such_setting": 1})
    except ValidationError:
        return f"{len(cls.model_fields)} settings"
    require(False, "an unknown key 'no_such_setting' was accepted")
    return ""


def check_identity(first: Any, second: Any) -> str:
    """Check two answers of ``identify``."""
    require(isinstance(first, Identity), f"expected an Identity, found {type(first).__name__}")
    for name in ("manufacturer", "model", "serial_number"):
        require(bool(str(getattr(first, name)).strip()), f"identity.{name} is empty")
    require(first == second, f"two answers differ: {first} and {second}")
    json.dumps(asdict(first))
    return f"{first.manufacturer} {first.model} {first.serial_number}"


def require_refusal(use: Callable[[], Any], what: str) -> None:
    """Fail unless a call raises an InstrumentError."""
    try:
        use()
    except InstrumentError:
        return
    except Exception as error:  # noqa: BLE001 - named in the verdict
        require(False, f"{what}: expected an InstrumentError, found {type(error).__name__}: {error}")
    require(False, f"{what}: expected an InstrumentError, found none")


def check_absent(use: Callable[[], Any], address: str, limit: float) -> str:
    """Check that a call without a device raises an error of the package within a time limit, s."""
    start = time.perf_counter()
    try:
        use()
    except ErrormotionError as error:
        seconds = time.perf_counter() - start
        require(seconds <= limit, f"the error took {seconds:.1f} s, limit {limit:g} s")
        return f"{type(error).__name__} after {seconds:.2f} s"
    require(False, f"a device answered at {address}")
    return ""


def check_nothing_open(before: set[str]) -> str:
    """Check that no thread, socket or terminal is open in addition to those before."""
    end = time.monotonic() + 2.0  # a simulator may detect the end of the connection later
    while (left := open_things() - before) and time.monotonic() < end:
        time.sleep(0.01)
    require(not left, f"still open: {', '.join(sorted(left))}")
    return "no thread, no socket"
