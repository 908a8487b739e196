"""The HTML of a report."""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from hashlib import sha256
from importlib.resources import files

from jinja2 import Environment, PackageLoader, StrictUndefined, pass_context
from markupsafe import Markup

import errormotion
from errormotion.report import provenance
from errormotion.report.document import Cell, Part, Section, Source, Table
from errormotion.report.page import annex
from errormotion.report.page.head import PAPERS, Head, calibrations, facts, measured
from errormotion.report.page.language import Catalogue
from errormotion.report.page.verdict import Verdict

_COMPOSED = ("Measured", "Method", "Report", "Instruments", "Reference state")
"""Facts whose values are translated; the others are names."""


@dataclass(frozen=True)
class Page:
    """A report: its HTML, and its tables in reading order with the titles of their sections."""

    html: str
    tables: Sequence[tuple[str, Table]]


def page(
    sources: Sequence[Source],
    parts: Sequence[Part],
    title: str | None = None,
    *,
    head: Head | None = None,
    decision: Verdict | None = None,
    texts: Sequence[Mapping[str, str]] = (),
) -> Page:
    """Return a report as self-contained HTML, and its tables.

    ``texts`` are the catalogues of plugins for the language of the head.
    """
    head, script = head or Head(), _script()
    first = sources[0]
    everything = [(s.provenance, s.run, dict(s.raw.attrs) if s.raw is not None else {}) for s in sources]
    machine = str(first.errors.attrs.get("machine", "unknown machine"))
    body, appended = annex.divided(parts)
    identity = head.number or sha256("".join(map(_identity, sources)).encode()).hexdigest()[:12]
    written = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
    t = Catalogue(head.language, texts)
    found = facts(first, machine, head, f"{identity}, written {written}")
    calibrated = calibrations(head, measured(first))
    calibrated = (t.block(calibrated[0]), [t(each) for each in calibrated[1]]) if calibrated else None
    body = [t.part(part) for part in body]
    appended = [t.section(each) for each in annex.values(sources)] + [t.section(each, rows=False) for each in appended]
    decision = _translated(decision, t)
    shown = {
        "title": t.word(title) or f"{machine}: {body[0].title}",
        "heading": t.word(title) or body[0].title,
        "t": t,
        "language": t.language,
        "head": head,
        "facts": [(name, t(name), t.word(fact) if name in _COMPOSED else fact) for name, fact in found],
        "calibrations": calibrated,
        "decision": decision,
        "simulated": provenance.simulated(everything) or _without_machine(sources),
        "replayed": provenance.replayed(everything),
        "parts": body,
        "annex": appended,
        "several": len(parts) > 1,
        "kind": t(parts[0].kind),
        "stated": any(part.stated for part in parts),
        "identity": identity,
        "script": Markup(script),
        "script_hash": b64encode(sha256(script.encode()).digest()).decode(),
        "foot": _css(str(t(f"Report {identity}"))),
        "paper": PAPERS.get(head.paper, "A4"),
        "version": errormotion.__version__,
        "written": written,
    }
    tables = [(t("Calibrations"), calibrated[0])] if calibrated else []
    tables += [(section.title, table) for part in body for section in part.sections for table in _tables(section)]
    tables += [(t("Limits"), decision.table)] if decision else []
    tables += [(section.title, table) for section in appended for table in _tables(section)]
    return Page(_templates().get_template("report.html.j2").render(shown), tables)


def _translated(decision: Verdict | None, t: Catalogue) -> Verdict | None:
    if decision is None or t.language == "en":
        return decision
    return Verdict(
        t(decision.word),
        decision.tone,
        t(decision.sentence),
        t.block(decision.picture) if decision.picture is not None else None,
        t.block(decision.table),
    )


def _tables(section: Section) -> list[Table]:
    return [block for block in section.blocks if isinstance(block, Table)]


@cache
def _templates() -> Environment:
    """Return the compiled templates, which take the catalogue ``t`` from what they show."""
    templates = Environment(
        loader=PackageLoader("errormotion.report.page"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.tests["table"] = lambda block: isinstance(block, Table)
    templates.tests["cell"] = lambda value: isinstance(value, Cell)
    templates.filters["t"] = pass_context(lambda context, text: context["t"](text))
    templates.filters["kind"] = lambda block: type(block).__name__.lower()
    return templates


@cache
def _script() -> str:
    """Return the script of the page."""
    return (files("errormotion.report.page") / "templates" / "report.js").read_text(encoding="utf-8")


def _css(text: str) -> Markup:
    """Return a text as a string of a style sheet; every character that could end it is escaped."""
    return Markup('"' + re.sub(r"[^A-Za-z0-9 ._-]", lambda found: f"\\{ord(found[0]):x} ", text[:200]) + '"')


def _identity(source: Source) -> str:
    attributes = source.errors.attrs
    if "provenance" in attributes:
        return str(attributes["provenance"])
    return f"{source.run.get('id')} {attributes.get('start')} {dict(source.errors.sizes)}"


def _without_machine(sources: Sequence[Source]) -> str:
    """Return why data are no measurement of a machine: the truth of a virtual one, or simulated by a model."""
    if any(source.errors.attrs.get("method") == "twin" for source in sources):
        return "the values are the truth of a virtual machine"
    stated = [
        each.attrs.get("machine") for source in sources for each in (source.errors, source.raw) if each is not None
    ]
    return "the data state the machine as 'simulated'" if provenance.SIMULATED in stated else ""
