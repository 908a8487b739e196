"""What is added, and what is stated about it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from errormotion.record.runs.listing import Listing, list_runs


@dataclass(frozen=True)
class Request:
    """What is added, and what is stated about it; empty texts are not stated.

    Attributes
    ----------
    files : tuple of Path
        Files of one measurement.
    runs : Path
        The folder of runs.
    machine, method, axis : str
        Name of the machine, id of the method, axis that moved.
    measured : str
        Start of the measurement, ISO 8601, where the files do not state it.
    test : str
        Name of the test; by default method and axis.
    map : Path, optional
        The map of the files.
    head : Path, optional
        File of the statements for the head of the report.
    tolerances : Path, optional
        File of limits.
    settings : callable
        ``settings(model)`` returns the checked settings of the method.
    answers : mapping of str to str
        Answers to questions, by their keys.
    again : bool
        Whether files that are in the record become another run.
    shown : bool
        Whether a person has seen the proposal, so that no map of an earlier run is used instead of it.
    """

    files: tuple[Path, ...]
    runs: Path
    machine: str = ""
    method: str = ""
    axis: str = ""
    measured: str = ""
    test: str = ""
    map: Path | None = None
    head: Path | None = None
    tolerances: Path | None = None
    settings: Callable[[Any], Any] = lambda model: model()
    answers: Mapping[str, str] = field(default_factory=dict)
    again: bool = False
    shown: bool = False

    @cached_property
    def record(self) -> Listing:
        """The runs that are in the folder."""
        return list_runs([self.runs]) if self.runs.is_dir() else Listing((), ())
