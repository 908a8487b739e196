"""A bench with its instruments opened, as a method sees it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import Any, Self

from errormotion.campaign.files import BenchInstrument, BenchPlan
from errormotion.errors import BenchError
from errormotion.instruments.simulators.virtual_world.described import describe
from errormotion.plugins import Identity

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Answer:
    """What one instrument of a bench said when it was opened: who it is, or why it did not come up."""

    instrument: BenchInstrument
    driver: Any = None
    identity: Identity | None = None
    error: str = ""

    def line(self) -> str:
        """Return the answer in one line, for a person."""
        what = f"{self.instrument.name} ({self.instrument.driver.info.id}"
        what += f", {self.instrument.address})" if self.instrument.address else ")"
        if self.identity is None:
            return f"{what}: {self.error}"
        return (
            f"{what}: {self.identity.manufacturer} {self.identity.model}, serial number {self.identity.serial_number}"
        )

    def record(self) -> dict[str, Any]:
        """Return the answer for the provenance."""
        info = self.instrument.driver.info
        return {
            "name": self.instrument.name,
            "driver": info.id,
            "driver_version": info.version,
            "kind": info.kind,
            "status": info.status,
            "address": self.instrument.address,
            "settings": self.instrument.settings.model_dump(mode="json"),
            "identity": asdict(self.identity) if self.identity else None,
        }


class OpenBench:
    """The instruments of a bench, opened together and closed together.

    Parameters
    ----------
    plan : BenchPlan
        What to open.
    ask : callable, optional
        How to ask the operator for something: it gets the message, and returns when it is done. Not called where all
        instruments are simulated. Without it, a method that asks gets a BenchError.

    Attributes
    ----------
    answers : list of Answer
        What each instrument said, once open.
    """

    def __init__(self, plan: BenchPlan, ask: Callable[[str], None] | None = None) -> None:
        self.plan = plan
        self.machine = plan.machine
        self.description = plan.description
        self.answers: list[Answer] = []
        self._ask = ask

    def open(self) -> None:
        """Open every instrument.

        Raises
        ------
        BenchError
            The tree of what came up and what did not, and why. All instruments are tried; none stays open.
        """
        try:
            self.try_open()
        except BaseException:
            self.close()
            raise
        failed = [answer for answer in self.answers if answer.identity is None]
        if failed:
            self.close()
            head = f"Bench '{self.plan.name}': {len(failed)} of {len(self.answers)} instruments did not come up."
            raise BenchError("\n".join([head, *tree([answer.line() for answer in self.answers])]))

    def try_open(self) -> None:
        """Open what can be opened; ``answers`` says what could not."""
        describe(self.description)
        for instrument in self.plan.instruments:
            try:
                driver = instrument.driver(instrument.address, instrument.settings)
                try:
                    driver.open()
                    identity = driver.identify()
                except BaseException:
                    driver.close()
                    raise
            except Exception as error:
                log.exception("instrument %s did not come up", instrument.name)
                self.answers.append(Answer(instrument, error=f"{type(error).__name__}: {error}"))
            else:
                self.answers.append(Answer(instrument, driver, identity))

    def close(self) -> None:
        """Close every instrument, the last opened first; one that fails to close does not keep the others open."""
        for answer in reversed(self.answers):
            if answer.driver is None:
                continue
            try:
                answer.driver.close()
            except Exception:
                log.exception("instrument %s did not close", answer.instrument.name)

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def virtual(self) -> bool:
        """Whether every instrument is a simulated one."""
        return all(answer.identity is not None and answer.identity.simulated for answer in self.answers)

    def chosen(self, choice: Mapping[str, str]) -> OpenBench:
        """Return the open bench with one instrument of each kind in ``choice`` (kind to name), and all of others."""
        found = copy(self)
        kinds = [(answer, answer.instrument.driver.info.kind) for answer in self.answers]
        found.answers = [
            answer for answer, kind in kinds if choice.get(kind, answer.instrument.name) == answer.instrument.name
        ]
        return found

    def has_kind(self, kind: str) -> bool:
        """Whether the bench has an instrument of this kind."""
        return any(answer.instrument.driver.info.kind == kind for answer in self.answers)

    def of_kind(self, kind: str) -> Any:
        """Return the one instrument of this kind.

        Raises
        ------
        BenchError
            There is none, or there are several.
        """
        found = [answer for answer in self.answers if answer.instrument.driver.info.kind == kind]
        if len(found) == 1:
            return found[0].driver
        if found:
            names = ", ".join(answer.instrument.name for answer in found)
            raise BenchError(
                f"Bench '{self.plan.name}': expected one {kind}; found {names}. Choose one in the test: "
                f'instruments = {{ {kind} = "{found[0].instrument.name}" }}.'
            )
        raise BenchError(
            f"Bench '{self.plan.name}': expected a {kind}; it offers {', '.join(self.plan.kinds)}. "
            f"Add one to {self.plan.source}."
        )

    def all_of_kind(self, kind: str) -> dict[str, Any]:
        """Return every instrument of this kind by its name on the bench; none where there is none."""
        return {a.instrument.name: a.driver for a in self.answers if a.instrument.driver.info.kind == kind}

    def ask(self, message: str) -> None:
        """Ask the operator for something and wait until it is done; passes at once on a virtual bench."""
        if self.virtual:
            return
        if self._ask is None:
            raise BenchError(f"The operator is needed ({message}), and nobody can be asked here. Run in a terminal.")
        log.info("asked the operator: %s", message)
        self._ask(message)
        log.info("the operator has done it")


def tree(lines: list[str]) -> list[str]:
    """Return lines with the branches of a tree before them; further lines of one entry are indented."""
    drawn = []
    for number, line in enumerate(lines):
        last = number == len(lines) - 1
        first, *rest = line.splitlines() or [""]
        drawn.append(("└── " if last else "├── ") + first)
        drawn += [("    " if last else "│   ") + text for text in rest]
    return drawn
