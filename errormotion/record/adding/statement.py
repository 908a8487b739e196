"""What people state about imported data: the head of the report, the instruments, and the conditions of the test."""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from errormotion.campaign.sections import head
from errormotion.datasets.files import tomlfile
from errormotion.errors import DatasetError
from errormotion.report.page import logo

SCHEMA = "errormotion.head/1"
_TEXT = 500
_ENTRIES = 50

Facts = dict[str, str]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Instrument(_Table):
    """An instrument or a sensor with which the data were measured."""

    name: str = Field(max_length=_TEXT, description="what it is, such as 'laser interferometer'")
    manufacturer: str = Field(default="", max_length=_TEXT, description="manufacturer")
    model: str = Field(default="", max_length=_TEXT, description="model")
    serial_number: str = Field(default="", max_length=_TEXT, description="serial number")
    certificate: str = Field(default="", max_length=_TEXT, description="number of the calibration certificate")
    calibrated_until: date | None = Field(default=None, description="last day of its calibration")


class Statement(_Table):
    """A file of statements (``--head``); everything is optional, and only what is stated is in the report."""

    schema_: Literal["errormotion.head/1"] = Field(alias="schema", description=f"'{SCHEMA}'")
    operator: str = Field(default="", max_length=200, description="who measured")
    laboratory: head.Laboratory | None = Field(default=None, description="the testing laboratory")
    report: head.ReportTable | None = Field(default=None, description="the order, and the form of the report")
    instruments: tuple[Instrument, ...] = Field(default=(), max_length=_ENTRIES, description="the instruments")
    environment: Facts = Field(
        default_factory=dict, max_length=_ENTRIES, description="such as 'air temperature' = '20.3 degC'"
    )
    conditions: Facts = Field(
        default_factory=dict, max_length=_ENTRIES, description="of the test, such as feed = '1000 mm/min'"
    )

    def stated(self) -> dict[str, Any]:
        """Return the head of the report for ``run.json``; what is not stated is absent."""
        until = {each.name: each.calibrated_until for each in self.instruments if each.calibrated_until is not None}
        certificates = {each.name: each.certificate for each in self.instruments if each.certificate}
        found = head.stated(self.laboratory, self.report, until, certificates)
        facts = {"environment": dict(self.environment), "conditions": dict(self.conditions)}
        return found | {name: each for name, each in facts.items() if each}

    def records(self) -> list[dict[str, Any]]:
        """Return the instruments for the provenance."""
        return [
            {
                "name": each.name,
                "identity": {
                    "manufacturer": each.manufacturer,
                    "model": each.model,
                    "serial_number": each.serial_number,
                },
            }
            | ({"calibration": each.certificate} if each.certificate else {})
            for each in self.instruments
        ]


def load_statement(path: Path) -> Statement:
    """Read a file of statements.

    Raises
    ------
    DatasetError
        The file cannot be read, or contains mistakes; all in one message.
    """
    found = tomlfile.load_model(path, Statement)
    names = [each.name for each in found.instruments]
    mistakes = head.logo_mistakes(found.laboratory, path.parent)
    mistakes += [f"instruments: expected different names; found '{name}' twice" for name in _twice(names)]
    if mistakes:
        raise DatasetError(tomlfile.report(path, mistakes), code="toml.mistakes")
    return found


def copy_logo(found: Statement, path: Path, folder: Path) -> None:
    """Copy the logo of the laboratory into a run folder."""
    if found.laboratory is not None and found.laboratory.logo:
        logo.copy(path.parent / found.laboratory.logo, folder)


def _twice(names: list[str]) -> list[str]:
    return sorted({name for name in names if names.count(name) > 1})
