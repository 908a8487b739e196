"""The texts of a bench and a campaign file from answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from errormotion.datasets.files.tomltext import key, value
from errormotion.plugins import PluginSettings


@dataclass
class Instrument:
    """An instrument of the bench, as answered."""

    driver: str
    address: str = ""
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass
class Test:
    """A test of the campaign, as answered."""

    __test__ = False  # not a test of pytest

    method: str
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass
class Answers:
    """The contents of a bench and a campaign."""

    machine: str = ""
    chain: str = ""
    travel: dict[str, list[str]] = field(default_factory=dict)
    instruments: dict[str, Instrument] = field(default_factory=dict)
    tests: dict[str, Test] = field(default_factory=dict)


def bench_text(answers: Answers, settings: Mapping[str, type[PluginSettings]]) -> str:
    """Return a bench file; ``settings`` are the models of the drivers by the name of the instrument."""
    lines = [
        "# The instruments of a measurement and how they are connected.",
        "# 'errormotion bench validate' checks this file, 'errormotion bench probe' reads each instrument once.",
        'schema = "errormotion.bench/1"',
        f"name = {value(f'Bench of {answers.machine}')}",
        "",
    ]
    if answers.chain:
        lines += ["[machine]", f"name = {value(answers.machine)}", f"chain = {value(answers.chain)}"]
        lines += [f"travel.{key(axis)} = {value(span)}" for axis, span in answers.travel.items()]
    else:
        lines.insert(-1, f"machine = {value(answers.machine)}")
    for name, each in answers.instruments.items():
        lines += ["", f"# Further settings: errormotion plugins show {each.driver}", f"[instruments.{key(name)}]"]
        lines += [f"driver = {value(each.driver)}"]
        lines += [f"address = {value(each.address)}"] if each.address else []
        lines += _settings(each.settings, settings.get(name))
    return "\n".join(lines) + "\n"


def campaign_text(answers: Answers, bench: str, settings: Mapping[str, type[PluginSettings]]) -> str:
    """Return a campaign file; ``settings`` are the models of the methods by the name of the test."""
    lines = [
        "# The tests of the campaign, in order. Nothing moves before 'errormotion run' announces it:",
        "# 'errormotion run --dry-run' shows path and duration, 'errormotion plan' the expected uncertainty.",
        'schema = "errormotion.campaign/1"',
        f"name = {value(f'Tests of {answers.machine}')}",
        f"bench = {value(bench)}",
    ]
    for name, each in answers.tests.items():
        lines += ["", f"# Further settings: errormotion plugins show {each.method}", "[[test]]"]
        lines += [f"name = {value(name)}", f"method = {value(each.method)}"]
        own = _settings(each.settings, settings.get(name))
        lines += ["[test.settings]", *own] if own else []
    return "\n".join(lines) + "\n"


def _settings(stated: Mapping[str, Any], model: type[PluginSettings] | None) -> list[str]:
    fields = model.model_fields if model is not None else {}
    lines = []
    for name, each in stated.items():
        meaning = " ".join((fields[name].description or "").split()) if name in fields else ""
        lines.append(f"{key(name)} = {value(each)}" + (f"   # {meaning}" if meaning else ""))
    return lines
