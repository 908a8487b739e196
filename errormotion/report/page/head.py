"""Head of a report: the laboratory, the measurement, and the validity of calibrations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, date, datetime
from typing import Any

from errormotion.report import provenance
from errormotion.report.document import Cell, Source, Table
from errormotion.report.text import DASH

PAPERS = {"A4": "A4", "Letter": "letter"}
"""Sizes of paper, and their names in style sheets."""
MAX_LOGO = 700_000
"""Characters of the logo as a data URI."""


@dataclass(frozen=True)
class Head:
    """Statements on the laboratory and the order; empty texts are not shown.

    Attributes
    ----------
    laboratory, address, accreditation : str
        Of the laboratory.
    logo : str
        Its picture as a data URI.
    customer, order, number : str
        Customer, order, and the number of the report.
    calibrated_until : mapping of str to date
        Instrument or artefact, and the last day of its calibration.
    certificates : mapping of str to str
        Instrument or artefact, and the number of its certificate.
    environment, conditions : mapping of str to str
        Of the test, where they are stated for imported data.
    language, paper : str
        Of the page.
    """

    laboratory: str = ""
    address: str = ""
    accreditation: str = ""
    logo: str = ""
    customer: str = ""
    order: str = ""
    number: str = ""
    calibrated_until: Mapping[str, date] = field(default_factory=dict)
    certificates: Mapping[str, str] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=dict)
    conditions: Mapping[str, str] = field(default_factory=dict)
    language: str = ""
    paper: str = ""


def head_of(run: Mapping[str, Any]) -> Head:
    """Return the head in a ``run.json``; entries of another form are omitted."""
    stated = run.get("head")
    stated = stated if isinstance(stated, Mapping) else {}

    def text(name: str) -> str:
        found = stated.get(name)
        return found.strip() if isinstance(found, str) else ""

    logo = run.get("logo")
    logo = logo if isinstance(logo, str) and logo.startswith("data:image/") and len(logo) <= MAX_LOGO else ""
    names = ("laboratory", "address", "accreditation", "customer", "order", "number", "language", "paper")
    until = {name: day for name, each in _pairs(stated, "calibrated_until") if (day := _day(each)) is not None}
    facts = ("certificates", "environment", "conditions")
    certificates, environment, conditions = ({name: str(each) for name, each in _pairs(stated, key)} for key in facts)
    return Head(
        **{name: text(name) for name in names},
        logo=logo,
        calibrated_until=until,
        certificates=certificates,
        environment=environment,
        conditions=conditions,
    )


def _pairs(stated: Mapping[str, Any], name: str) -> list[tuple[str, Any]]:
    found = stated.get(name)
    return [(str(key), each) for key, each in found.items()] if isinstance(found, Mapping) else []


def _day(value: Any) -> date | None:
    try:
        return date.fromisoformat(str(value)[:10])
    except ValueError:
        return None


def measured(source: Source) -> str:
    """Return the start of the measurement as it is stated; a dash if it is unknown."""
    return _known(source, "started", "start", "created")


def _known(source: Source, *names: str) -> str:
    errors = source.errors
    time = errors["time"].attrs if "time" in errors.coords else {}
    for holder in (source.run, source.provenance, errors.attrs, time):
        for name in names:
            if name in holder and not isinstance(holder[name], (Mapping, list)) and holder[name] not in (None, ""):
                return provenance.text(holder[name])
    return DASH


def facts(source: Source, machine: str, head: Head, report: str) -> list[tuple[str, str]]:
    """Return the known facts in the head of the report."""
    attributes, test = source.errors.attrs, _known(source, "test", "name")
    method = [
        ("Method", f"{attributes.get('method', DASH)}, version {attributes.get('method_version', DASH)}"),
        ("Reference state", str(attributes.get("reference", DASH))),
    ]
    instruments = provenance.instruments(source.provenance)
    found = [
        ("Customer", head.customer),
        ("Order", head.order),
        ("Machine", machine),
        ("Test", test if test != DASH else str(attributes.get("iso_test", DASH))),
        ("Measured", " ".join(filter(None, (moment(measured(source)), _unstated(source))))),
        ("Operator", _known(source, "operator")),
        *(method if "method" in attributes else []),
        ("Run", _known(source, "id", "run")),
        ("Report", report),
        ("Imported from", ", ".join(imported(source.run))),
        ("Instruments", "; ".join(_instrument(row) for row in instruments)),
        ("Environment", _listed(head.environment)),
        ("Conditions of the test", _listed(head.conditions)),
    ]
    return [(name, fact) for name, fact in found if fact and fact != DASH]


def imported(run: Mapping[str, Any]) -> list[str]:
    """Return the names of the files of an imported run; empty for a measured one."""
    found = run.get("imported")
    files = found.get("files") if isinstance(found, Mapping) else None
    return [str(each["name"]) for each in files or () if isinstance(each, Mapping) and each.get("name")]


def _unstated(source: Source) -> str:
    """Return where the time of an imported measurement is from, if the files do not state it."""
    return f"({source.run['created_from']})" if source.run.get("created_from") else ""


def _listed(facts: Mapping[str, str]) -> str:
    return "; ".join(f"{name}: {fact}" for name, fact in facts.items())


def _instrument(row: Mapping[str, str]) -> str:
    made = f"{row['manufacturer']} {row['model'] or row['name']}".strip()
    return f"{made}, serial number {row['serial_number']}" if row["serial_number"] else made


def moment(text: str) -> str:
    """Return an ISO 8601 time in a readable form; any other text unchanged."""
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        return text
    if found.tzinfo is None:
        return found.strftime("%Y-%m-%d %H:%M")
    return found.astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")


def calibrations(head: Head, measured: str) -> tuple[Table, Sequence[str]] | None:
    """Return the table of calibrations, and a warning for each that had expired; None without dates."""
    if not head.calibrated_until:
        return None
    day = _day(measured)
    rows: list[list[Cell | str]] = []
    late: list[str] = []
    for item, until in sorted(head.calibrated_until.items()):
        over = day is not None and day > until
        if over:
            late.append(f"The calibration of {item} ended on {until}, before the measurement.")
        rows.append([item, head.certificates.get(item, ""), str(until), "ended" if over else "valid" if day else ""])
    columns = ["of", "certificate", "valid until", "when measured"]
    shown = [j for j in range(len(columns)) if any(row[j] for row in rows)]
    kept: list[list[Cell | str]] = [[row[j] for j in shown] for row in rows]
    return Table("Calibrations.", [columns[j] for j in shown], kept, numeric=False), late
