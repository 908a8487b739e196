"""Bench and campaign files in TOML, checked against the plugins that they name.

A bench file lists the instruments, a campaign file the tests. All errors of a file, including plugin settings, are
reported in one message, each with its key, the expected and the found value.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, field_validator

from errormotion import plugins
from errormotion.campaign.sections import head
from errormotion.campaign.sections.limits import NO_MOTIONS, Limits, extent, steps_of, violations, without_limits
from errormotion.campaign.sections.machine import completed, contradictions, limits_within, read_machine
from errormotion.campaign.sections.timeline import Timeline, follower
from errormotion.compensation.online.settings import Limits as OffsetLimits
from errormotion.datasets import certificates
from errormotion.datasets.files import tomlfile
from errormotion.datasets.files.folders import looking_beside
from errormotion.datasets.units import Time
from errormotion.errors import BenchError, InstrumentError, MethodError, PluginError
from errormotion.instruments.transports.address import parse_address
from errormotion.kinematics.description import MachineDescription
from errormotion.tolerances.table import Tolerances

NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]*$"


def _certificates(stated: dict[str, str]) -> dict[str, str]:
    if mistakes := certificates.wrong(stated):
        raise ValueError(
            f"{mistakes[0]}: expected the number or hash of a certificate for one of {', '.join(certificates.ITEMS)}"
        )
    return stated


Certificates = Annotated[
    dict[str, str],
    AfterValidator(_certificates),
    Field(description="item = number or hash of its certificate"),
]


class InstrumentTable(BaseModel):
    """``[instruments.NAME]``: the driver, its address, and the settings of the driver."""

    model_config = ConfigDict(extra="allow", frozen=True)
    driver: str = Field(description="the id of an instrument plugin; 'errormotion plugins list' shows them")
    address: str = ""


class CompensatorTable(BaseModel):
    """``[compensator]``: driver that writes offsets to the machine, its address, its settings, and the limits."""

    model_config = ConfigDict(extra="allow", frozen=True)
    driver: str = Field(description="the id of a compensator plugin; 'errormotion plugins list' shows them")
    address: str = ""
    limits: OffsetLimits = OffsetLimits()


class BenchTable(BaseModel):
    """A bench file."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    schema_: Literal["errormotion.bench/1"] = Field(alias="schema", description='"errormotion.bench/1"')
    name: str
    machine: str = Field(description="the name of the machine tool, or the table [machine]")
    instruments: dict[str, InstrumentTable] = Field(default_factory=dict)
    compensator: CompensatorTable | None = None
    limits: Limits = Limits()
    certificates: Certificates = {}
    laboratory: head.Laboratory | None = None
    calibrated_until: dict[str, date] = Field(default={}, description="instrument or certified item = last day")


class TestTable(BaseModel):
    """``[[test]]``: one measurement."""

    __test__ = False  # not a test of pytest

    model_config = ConfigDict(extra="forbid", frozen=True)
    name: str = Field(pattern=NAME, description="a name of letters, digits, - and _")
    method: str = Field(description="the id of a method plugin; 'errormotion plugins list' shows them")
    inputs: dict[str, str] = {}
    instruments: dict[str, str] = Field(default={}, description="kind of instrument = its name on the bench")
    settings: dict[str, Any] = {}
    certificates: Certificates = {}
    at: Time | None = Field(
        default=None, ge=0, description="start on the timeline; default the end of the test before it"
    )
    monte_carlo: int | Literal["auto"] | None = Field(
        default=None, description='number of trials of a Monte Carlo evaluation of the result, or "auto"'
    )


class CampaignTable(BaseModel):
    """A campaign file."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    schema_: Literal["errormotion.campaign/1"] = Field(alias="schema", description='"errormotion.campaign/1"')
    name: str
    bench: str = Field(description="the path of a bench file, relative to this file")
    runs: str = "runs"
    test: list[TestTable] = Field(min_length=1)
    operator: str = Field(default="", max_length=200, description="name of the operator")
    certificates: Certificates = {}
    report: head.ReportTable | None = None
    tolerances: Tolerances | None = None
    timeline: Timeline | None = None

    @field_validator("runs")
    @classmethod
    def _local(cls, value: str) -> str:
        if "://" in value:
            raise ValueError("expected a local folder; copy the run folders elsewhere afterwards")
        return value


class MistakesError(BenchError):
    """A file with mistakes, each of which starts with its key; ``more`` is the message of a second file."""

    code = "toml.mistakes"

    def __init__(self, source: Path, mistakes: Sequence[str], more: str = "") -> None:
        super().__init__("\n".join(filter(None, [tomlfile.report(source, mistakes), more])))
        self.source, self.mistakes, self.more = source, tuple(mistakes), more


@dataclass(frozen=True)
class BenchInstrument:
    """One instrument of a bench: the driver's class and its checked settings."""

    name: str
    driver: Any
    address: str
    settings: Any


@dataclass(frozen=True)
class BenchCompensator:
    """The compensator of a bench: its class, its checked settings and the limits of the offsets."""

    driver: Any
    address: str
    settings: Any
    limits: OffsetLimits


@dataclass(frozen=True)
class BenchPlan:
    """A checked bench file; no instrument is open.

    ``machine`` is the name of the machine tool, ``description`` the content of the table ``[machine]`` or None.
    ``limits`` are those of the file, or the travel for an axis without limits.
    """

    name: str
    machine: str
    instruments: tuple[BenchInstrument, ...]
    source: Path
    text: str
    limits: Limits = field(default_factory=Limits)
    description: MachineDescription | None = None
    certificates: Mapping[str, str] = field(default_factory=dict)
    compensator: BenchCompensator | None = None
    laboratory: head.Laboratory | None = None
    calibrated_until: Mapping[str, date] = field(default_factory=dict)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of the instruments."""
        return tuple(sorted({instrument.driver.info.kind for instrument in self.instruments}))

    @property
    def settings_by_kind(self) -> dict[str, Any]:
        """Settings of the instruments by kind; of several of a kind, the first."""
        return {instrument.driver.info.kind: instrument.settings for instrument in reversed(self.instruments)}

    def chosen(self, choice: Mapping[str, str]) -> BenchPlan:
        """Return the bench with one instrument of each kind in ``choice`` (kind to name), and all of other kinds."""
        kept = [
            instrument
            for instrument in self.instruments
            if choice.get(instrument.driver.info.kind, instrument.name) == instrument.name
        ]
        return replace(self, instruments=tuple(kept))


@dataclass(frozen=True)
class TestPlan:
    """One checked test of a campaign.

    ``inputs`` maps the method's name of an input to an earlier test, ``instruments`` a kind to a name on the bench.
    ``certificates`` are those of bench, campaign and test; that of the test has priority.
    """

    __test__ = False

    name: str
    method: Any
    settings: Any
    inputs: Mapping[str, str]
    instruments: Mapping[str, str] = field(default_factory=dict)
    certificates: Mapping[str, str] = field(default_factory=dict)
    at: float | None = None
    monte_carlo: int | Literal["auto"] | None = None


@dataclass(frozen=True)
class CampaignPlan:
    """A checked campaign file with its bench."""

    name: str
    bench: BenchPlan
    tests: tuple[TestPlan, ...]
    runs: Path
    source: Path
    text: str
    folder: Path
    """Folder to which paths in the settings are relative."""
    tolerances: Tolerances | None = None
    operator: str = ""
    timeline: Timeline | None = None
    report: head.ReportTable | None = None

    @property
    def sha256(self) -> str:
        """Hash of the texts of campaign and bench."""
        return hashlib.sha256(f"{self.text}\0{self.bench.text}".encode()).hexdigest()


def load_bench(path: str | Path) -> BenchPlan:
    """Read and check a bench file.

    Raises
    ------
    BenchError
        The file cannot be read, or contains errors; all in one message.
    """
    path = Path(path)
    _refuse_other(path, tomlfile.read_toml(path, error=BenchError), "bench")
    plan = parse_bench(path.read_text(encoding="utf-8-sig"), path)
    if mistakes := head.logo_mistakes(plan.laboratory, path.parent):
        raise MistakesError(path, mistakes)
    return plan


def load_campaign(path: str | Path) -> CampaignPlan:
    """Read and check a campaign file and the bench file that it names.

    Raises
    ------
    BenchError
        A file cannot be read, or contains errors; all errors of a file in one message.
    """
    path = Path(path)
    tomlfile.read_toml(path, error=BenchError)
    return campaign_of(path.read_text(encoding="utf-8-sig"), path)


def campaign_of(text: str, path: Path) -> CampaignPlan:
    """Check the text of a campaign file, and the bench file that it names; ``path`` is the path of the campaign file.

    Raises
    ------
    BenchError
        The bench file cannot be read, or one of the files contains errors; all errors of a file in one message.
    """
    data = tomlfile.parse_toml(text, path, error=BenchError)
    _refuse_other(path, data, "campaign")
    bench = data.get("bench")
    plan, bench_error = None, None
    if isinstance(bench, str):
        try:
            plan = load_bench(path.parent / bench)
        except BenchError as error:
            there = os.path.isfile(path.parent / bench)
            bench_error = error if there else BenchError(f"{path}: bench: {error}", code=error.code)
    try:
        campaign = parse_campaign(text, path, plan)
    except MistakesError as error:
        if bench_error is None:
            raise
        raise MistakesError(path, error.mistakes, str(bench_error)) from None
    except BenchError:
        raise bench_error or BenchError(
            f"{path}: the bench file cannot be read", code="bench.file.unreadable"
        ) from None
    if mistakes := list(_missing(campaign)):
        raise MistakesError(path, mistakes)
    return campaign


_KINDS = {
    "bench": "It describes the instruments of a machine; state the file of a campaign that uses it",
    "campaign": "It describes the tests of a campaign; state the file of its bench",
    "tolerances": "It contains limits; state it with --tolerances",
}
"""Content of each kind of file, and what to do, by the name in its schema."""


def _refuse_other(path: Path, data: Mapping[str, Any], expected: str) -> None:
    """Raise BenchError for a file of another kind; otherwise all its keys would be reported as unknown."""
    kind = str(data.get("schema", "")).removeprefix("errormotion.").partition("/")[0]
    if kind != expected and kind in _KINDS:
        raise BenchError(
            f"{path}: expected a {expected} file; found a file of kind '{kind}'. {_KINDS[kind]}",
            code="bench.file.kind",
        )


def _missing(campaign: CampaignPlan) -> Iterator[str]:
    """Yield the errors that methods find in their settings, such as missing files."""
    for number, test in enumerate(campaign.tests):
        with looking_beside(campaign.folder):
            missing = test.method().check(test.settings)
        yield from (f"{tomlfile.dotted(('test', number, 'settings', key))}: {text}" for key, text in missing.items())


def parse_bench(text: str, source: Path) -> BenchPlan:
    """Check the text of a bench file; ``source`` is its path for messages."""
    data = tomlfile.parse_toml(text, source, error=BenchError)
    description, mistakes, machine = None, list[str](), data.get("machine")
    if isinstance(machine, dict):
        description, mistakes = read_machine(machine)
        data["machine"] = str(machine.get("name"))
    if "limits" in data:
        data["limits"], mistakes_of_part = without_limits(data["limits"])
        mistakes += mistakes_of_part
    table, mistakes_of_part = tomlfile.check(data, BenchTable)
    mistakes += mistakes_of_part
    limits = table.limits if table else Limits()
    if description is not None:
        limits, mistakes_of_part = limits_within(limits, description)
        mistakes += mistakes_of_part
    instruments = []
    for name, entry in _tables(data.get("instruments")):
        if not isinstance(entry.get("driver"), str):
            continue
        own = {key: value for key, value in entry.items() if key not in InstrumentTable.model_fields}
        settings, mistakes_of_part = _settings("instruments", entry["driver"], own, ("instruments", name))
        mistakes += [*mistakes_of_part, *_address_mistakes(entry, ("instruments", name))]
        if settings is not None:
            driver = plugins.get("instruments", entry["driver"])
            instruments.append(BenchInstrument(str(name), driver, entry.get("address", ""), settings))
    compensator, mistakes_of_part = _compensator(data.get("compensator"), table)
    mistakes += mistakes_of_part
    mistakes += head.until_mistakes(table.calibrated_until, table.instruments) if table else []
    if table is None or mistakes:
        raise MistakesError(source, mistakes)
    return BenchPlan(
        name=table.name,
        machine=table.machine,
        instruments=tuple(instruments),
        source=source,
        text=text,
        limits=limits,
        description=description,
        certificates=table.certificates,
        compensator=compensator,
        laboratory=table.laboratory,
        calibrated_until=table.calibrated_until,
    )


def _compensator(entry: Any, table: BenchTable | None) -> tuple[BenchCompensator | None, list[str]]:
    if not isinstance(entry, dict) or not isinstance(entry.get("driver"), str):
        return None, []
    own = {key: value for key, value in entry.items() if key not in CompensatorTable.model_fields}
    settings, mistakes = _settings("compensators", entry["driver"], own, ("compensator",))
    if mistakes or table is None or table.compensator is None:
        return None, mistakes
    driver = plugins.get("compensators", entry["driver"])
    return BenchCompensator(driver, entry.get("address", ""), settings, table.compensator.limits), []


def parse_campaign(text: str, source: Path, bench: BenchPlan | None) -> CampaignPlan:
    """Check the text of a campaign file against its bench; ``source`` is its path for messages.

    Without a bench, BenchError reports the missing bench with all other errors.
    """
    data = tomlfile.parse_toml(text, source, error=BenchError)
    table, mistakes = tomlfile.check(data, CampaignTable)
    for number, entry in _tables(data.get("test")):
        if isinstance(entry.get("method"), str):
            mistakes += _method_mistakes(entry, ("test", number), bench)
    earlier: list[str] = []
    for number, test in enumerate(table.test if table else ()):
        mistakes += [*_name_mistakes(test, ("test", number), earlier), *_trials_mistakes(test, ("test", number))]
        earlier.append(test.name)
    mistakes += _timeline_mistakes(table, bench) if table else []
    if table is None or mistakes:
        raise MistakesError(source, mistakes)
    if bench is None:
        raise BenchError("", code="bench.file.unreadable")
    tests = []
    for test in table.test:
        method = plugins.get("methods", test.method)
        settings = completed(method, _settings("methods", test.method, test.settings, ())[0], bench.description)
        certified = {**bench.certificates, **table.certificates, **test.certificates}
        tests.append(
            TestPlan(test.name, method, settings, test.inputs, test.instruments, certified, test.at, test.monte_carlo)
        )
    return CampaignPlan(
        name=table.name,
        bench=bench,
        tests=tuple(tests),
        runs=Path(table.runs),
        source=source,
        text=text,
        folder=source.parent.resolve(),
        tolerances=table.tolerances,
        operator=table.operator,
        timeline=table.timeline,
        report=table.report,
    )


def _timeline_mistakes(table: CampaignTable, bench: BenchPlan | None) -> list[str]:
    if table.timeline is None:
        stated = [number for number, test in enumerate(table.test) if test.at is not None]
        return [f"{tomlfile.dotted(('test', n, 'at'))}: needs a table [timeline]; found none" for n in stated]
    try:
        if bench is not None:
            follower(each.driver for each in bench.instruments)
    except BenchError as error:
        return [f"{error}; the bench {bench.source if bench else ''} has none"]
    return []


def _address_mistakes(entry: Mapping[str, Any], place: tuple[str | int, ...]) -> list[str]:
    several = entry.get("addresses")
    found = {"address": entry.get("address")} | {
        f"addresses.{name}": url for name, url in (several.items() if isinstance(several, dict) else ())
    }
    mistakes = []
    for key, url in found.items():
        if isinstance(url, str) and url:
            try:
                parse_address(url)
            except InstrumentError as error:
                mistakes.append(f"{tomlfile.dotted((*place, key))}: {error}")
    return mistakes


def _tables(value: Any) -> list[tuple[str | int, dict[str, Any]]]:
    """Return the tables below a key with their keys or numbers, even of a file with errors."""
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [(key, entry) for key, entry in pairs if isinstance(entry, dict)]


def _method_mistakes(entry: Mapping[str, Any], place: tuple[str | int, ...], bench: BenchPlan | None) -> list[str]:
    settings = entry.get("settings", {})
    settings_of_method, mistakes = _settings(
        "methods", entry["method"], settings if isinstance(settings, dict) else {}, place
    )
    if bench is not None and entry.get("instruments"):
        wrong = _choice_mistakes(entry["instruments"], (*place, "instruments"), bench)
        if wrong is None or wrong:
            return mistakes + (wrong or [])
        bench = bench.chosen(entry["instruments"])
    if settings_of_method is not None and bench is not None:
        lacking = [
            kind for kind in plugins.get("methods", entry["method"]).needs.instruments if kind not in bench.kinds
        ]
        if lacking:
            mistakes.append(
                f"{tomlfile.dotted(place)}: the method '{entry['method']}' needs {' and '.join(lacking)}; "
                f"the bench {bench.source} has {', '.join(bench.kinds)}"
            )
        for kind in plugins.get("methods", entry["method"]).needs.instruments:
            names = [each.name for each in bench.instruments if each.driver.info.kind == kind]
            if len(names) > 1:
                mistakes.append(
                    f"{tomlfile.dotted(place)}: the method '{entry['method']}' needs one {kind}; the bench "
                    f'{bench.source} has {", ".join(names)}. Choose one: instruments = {{ {kind} = "{names[0]}" }}'
                )
        method = plugins.get("methods", entry["method"])
        settings_of_method = completed(method, settings_of_method, bench.description)
        for key, text in contradictions(method, settings_of_method, bench.description).items():
            where = tomlfile.dotted((*place, "settings", *([key] if key else [])))
            mistakes.append(f"{where}: {text} ([machine] of {bench.source})")
        mistakes += _limit_mistakes(entry["method"], settings_of_method, bench, place)
    return mistakes


def _choice_mistakes(choice: Any, place: tuple[str | int, ...], bench: BenchPlan) -> list[str] | None:
    """Return the selected instruments that are not on the bench; None if the selection is not a table of names."""
    if not isinstance(choice, dict) or not all(isinstance(name, str) for name in choice.values()):
        return None
    mistakes = []
    for kind, name in choice.items():
        where = tomlfile.dotted((*place, kind))
        names = [each.name for each in bench.instruments if each.driver.info.kind == kind]
        if not names:
            known = tomlfile.nearest(kind, bench.kinds)
            mistakes.append(
                f"{where}: expected a kind of instrument on the bench {bench.source}; found '{kind}'; {known}"
            )
        elif name not in names:
            known = tomlfile.nearest(name, names)
            mistakes.append(
                f"{where}: expected the name of a {kind} on the bench {bench.source}; found '{name}'; {known}"
            )
    return mistakes


def _limit_mistakes(method: str, settings: Any, bench: BenchPlan, place: tuple[str | int, ...]) -> list[str]:
    """Return the violations of the limits of the bench by a test."""
    where = tomlfile.dotted(place)
    try:
        steps = steps_of(plugins.get("methods", method), settings, bench.settings_by_kind)
    except MethodError as error:
        return [f"{where}: {error}"]
    if steps is None and plugins.states(plugins.get("methods", method), "programs"):
        return [f"{where}: {NO_MOTIONS.format(method)}, although it writes NC programs"]
    broken = violations(extent(steps), bench.limits) if steps else []
    tables = "[limits]" if bench.description is None else "[limits] and [machine]"
    return [f"{where}: {text} ({tables} of {bench.source})" for text in broken]


def _name_mistakes(test: TestTable, place: tuple[str | int, ...], earlier: list[str]) -> list[str]:
    mistakes = []
    if test.name in earlier:
        mistakes.append(f"{tomlfile.dotted((*place, 'name'))}: expected a unique name; found '{test.name}' again")
    for key, name in test.inputs.items():
        if name not in earlier:
            where = tomlfile.dotted((*place, "inputs", key))
            known = tomlfile.nearest(name, earlier)
            mistakes.append(f"{where}: expected the name of an earlier test; found '{name}'; {known}")
    return mistakes


def _trials_mistakes(test: TestTable, place: tuple[str | int, ...]) -> list[str]:
    """Return why the Monte Carlo evaluation that a test requests is not possible."""
    if test.monte_carlo is None:
        return []
    from errormotion.montecarlo.evaluation import MIN_TRIALS

    where = tomlfile.dotted((*place, "monte_carlo"))
    if test.monte_carlo != "auto" and test.monte_carlo < MIN_TRIALS:
        return [f"{where}: expected 'auto' or at least {MIN_TRIALS} trials; found {test.monte_carlo}"]
    try:
        method = plugins.get("methods", test.method)
    except PluginError:
        return []  # reported with its settings
    if plugins.states(method, "trial_model"):
        return []
    return [f"{where}: the method '{test.method}' does not support the Monte Carlo evaluation (no 'trial_model')"]


def _settings(
    group: plugins.Group, plugin_id: str, data: Mapping[str, Any], place: tuple[str | int, ...]
) -> tuple[Any, list[str]]:
    """Return the checked settings of a plugin, or None and the errors."""
    try:
        cls = plugins.get(group, plugin_id)
    except PluginError as error:
        key = "method" if group == "methods" else "driver"
        return None, [f"{tomlfile.dotted((*place, key))}: {error}"]
    prefix = (*place, "settings") if group == "methods" else place
    return tomlfile.check(data, cls.Settings, prefix=prefix)
