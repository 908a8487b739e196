"""The head of reports: laboratory, order and calibrations as stated by bench and campaign."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from errormotion.datasets import certificates
from errormotion.datasets.files import tomlfile
from errormotion.report.page import logo


class Laboratory(BaseModel):
    """``[laboratory]`` of a bench file: the testing laboratory."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    name: str = Field(max_length=200, description="name of the laboratory")
    address: str = Field(default="", max_length=1000, description="address, in one or several lines")
    accreditation: str = Field(default="", max_length=200, description="accreditation or department")
    logo: str = Field(default="", description="picture (.png, .jpg, .svg), relative to this file")


class ReportTable(BaseModel):
    """``[report]`` of a campaign file: the order, and the form of the reports."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    customer: str = Field(default="", max_length=200, description="customer")
    order: str = Field(default="", max_length=200, description="number of the order")
    number: str = Field(default="", max_length=100, description="number of the report; default: derived from the data")
    language: Literal["", "en", "de"] = Field(default="", description="language of the report: en, de")
    paper: Literal["", "A4", "Letter"] = Field(default="", description="paper of the report: A4, Letter")


def logo_mistakes(laboratory: Laboratory | None, folder: Path) -> list[str]:
    """Return why the logo of a laboratory cannot be used; empty if it can, or without a logo."""
    mistake = logo.mistake(folder / laboratory.logo) if laboratory is not None and laboratory.logo else ""
    return [f"laboratory.logo: {mistake}"] if mistake else []


def until_mistakes(until: Mapping[str, date], instruments: Mapping[str, Any]) -> list[str]:
    """Return the keys of ``[calibrated_until]`` that are neither an instrument of the bench nor a certified item."""
    known = [*instruments, *certificates.ITEMS]
    return [
        f"calibrated_until.{name}: expected an instrument or a certified item; {tomlfile.nearest(name, known)}"
        for name in until
        if name not in known
    ]


def stated(
    laboratory: Laboratory | None, report: ReportTable | None, until: Mapping[str, date], certified: Mapping[str, str]
) -> dict[str, Any]:
    """Return the head of the reports of a campaign for ``run.json``; keys that are not stated are absent."""
    attributes: dict[str, Any] = {}
    if laboratory is not None:
        attributes |= {"laboratory": laboratory.name, "address": laboratory.address}
        attributes["accreditation"] = laboratory.accreditation
    attributes |= report.model_dump() if report is not None else {}
    if until:
        attributes["calibrated_until"] = {name: day.isoformat() for name, day in until.items()}
        attributes["certificates"] = dict(certified)
    return {key: each for key, each in attributes.items() if each}
