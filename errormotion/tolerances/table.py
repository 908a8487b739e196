"""The table ``[tolerances]`` of a campaign file or of a separate file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, field_validator, model_validator

from errormotion.datasets.files import tomlfile
from errormotion.datasets.units import ANGLE, KINDS, LENGTH
from errormotion.errors import BenchError
from errormotion.tolerances.decision import Rule

SCHEMA = "errormotion.tolerances/1"
MAX_PATTERN = 200
"""Longest name of a limit, characters."""


class Bound(BaseModel):
    """One limit, SI."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    value: float
    unit: str


def _bound(value: Any) -> Any:
    """Return the quantity of a text; a number in quotes is a quantity without a unit."""
    if isinstance(value, Bound | dict):
        return value
    expected = "expected a limit with its unit in quotes, such as '10 um' or '5 arcsec'"
    if not isinstance(value, str) or len(value) > MAX_PATTERN:
        raise ValueError(f"{expected}; found {str(value)[:MAX_PATTERN]}")
    try:
        return Bound(value=float(value), unit="1")
    except ValueError:
        pass
    for kind in (LENGTH, ANGLE, *KINDS):
        try:
            return Bound(value=kind.parse(value), unit=kind.unit)
        except ValueError:
            continue
    raise ValueError(f"{expected}; found '{value}'")


class Limit(BaseModel):
    """Limits of one figure or freedom; a single quantity limits the absolute value."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    lower: Annotated[Bound | None, BeforeValidator(_bound)] = None
    upper: Annotated[Bound | None, BeforeValidator(_bound)] = None

    @model_validator(mode="before")
    @classmethod
    def _symmetric(cls, value: Any) -> Any:
        if isinstance(value, Mapping | Limit):
            return (
                {key: each for key, each in value.items() if each is not None} if isinstance(value, Mapping) else value
            )
        bound = _bound(value)
        if not bound.value > 0:
            raise ValueError(f"expected a limit above 0 for the absolute value; found '{value}'")
        return {"lower": Bound(value=-bound.value, unit=bound.unit), "upper": bound}

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.lower is None and self.upper is None:
            raise ValueError("expected 'lower', 'upper' or both; found neither")
        if self.lower is not None and self.upper is not None:
            if self.lower.unit != self.upper.unit:
                raise ValueError(
                    f"expected the same unit for 'lower' and 'upper'; found {self.lower.unit} and {self.upper.unit}"
                )
            if self.lower.value >= self.upper.value:
                raise ValueError("expected 'lower' below 'upper'; found it at or above 'upper'")
        return self

    @property
    def unit(self) -> str:
        """SI unit of the limits."""
        found = self.upper or self.lower
        return found.unit if found is not None else ""

    @property
    def interval(self) -> tuple[float, float]:
        """Lower and upper limit, SI; infinite if missing."""
        lower = self.lower.value if self.lower is not None else -math.inf
        return lower, self.upper.value if self.upper is not None else math.inf


class Tolerances(BaseModel):
    """``[tolerances]``: limits of figures of merit and of freedoms, and the rule of decision."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    rule: Rule = "iso 14253-1"
    guard_factor: float = Field(default=1.0, gt=0, le=10, description="guard band divided by U (k = 2)")
    largest_ratio: float = Field(
        default=1.0 / 3.0, gt=0, le=1, description="largest U (k = 2) divided by half the tolerance"
    )
    least_known: float = Field(
        default=0.5, gt=0, le=1, description="share of known points of a freedom below which conformity is not proved"
    )
    figures: dict[str, Limit] = {}
    freedoms: dict[str, Limit] = {}

    @field_validator("figures", "freedoms")
    @classmethod
    def _short(cls, value: dict[str, Limit]) -> dict[str, Limit]:
        for name in value:
            if not name or len(name) > MAX_PATTERN:
                raise ValueError(f"expected names of 1 to {MAX_PATTERN} characters; found one of {len(name)}")
        return value

    @model_validator(mode="after")
    def _some(self) -> Self:
        if not self.figures and not self.freedoms:
            raise ValueError("expected limits in 'figures', 'freedoms' or both; found none")
        return self

    def guard_text(self) -> str:
        """Return the rule and its guard band as text."""
        if self.rule == "iso 14253-1":
            return f"ISO 14253-1, guard band {self.guard_factor:g} U (k = 2)"
        if self.rule == "shared risk":
            return f"shared risk, no guard band, U (k = 2) at most {self.largest_ratio:.2g} of half the tolerance"
        return "simple acceptance, no guard band"


class TolerancesFile(BaseModel):
    """A file of tolerances."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    schema_: Literal["errormotion.tolerances/1"] = Field(alias="schema", description=f'"{SCHEMA}"')
    tolerances: Tolerances


def load_tolerances(path: str | Path) -> Tolerances:
    """Read a file of tolerances.

    Raises
    ------
    BenchError
        The file cannot be read, or contains errors; all in one message.
    """
    return tomlfile.load_model(path, TolerancesFile, error=BenchError).tolerances


def from_run(run: Mapping[str, Any]) -> Tolerances | None:
    """Return the tolerances of a ``run.json``, or None.

    Raises
    ------
    BenchError
        The tolerances are damaged.
    """
    if not run.get("tolerances"):
        return None
    table, mistakes = tomlfile.check(run["tolerances"], Tolerances, prefix=("tolerances",), edge=False)
    if table is None:
        raise BenchError(tomlfile.report("run.json", mistakes), code="run.file.mistakes")
    return table
