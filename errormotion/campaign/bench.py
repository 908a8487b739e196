"""A bench with opened instruments, for use by methods."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import asdict, dataclass
from typing import Any, Self

from errormotion.campaign.files import BenchInstrument, BenchPlan
from errormotion.campaign.storage.journal import cause_of
from errormotion.errors import BenchError, ErrormotionError, code_of
from errormotion.instruments.simulators.virtual_world.described import describe
from errormotion.plugins import Identity
from errormotion.plugins.kind_registry import changes_machine

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Answer:
    """Result of opening one instrument of a bench: its identity, or the cause of the failure."""

    instrument: BenchInstrument
    driver: Any = None
    identity: Identity | None = None
    error: str = ""
    code: str = ""

    def line(self) -> str:
        """Return the result as one line of text."""
        what = f"{self.instrument.name} ({self.instrument.driver.info.id}"
        what += f", {self.instrument.address})" if self.instrument.address else ")"
        if self.identity is None:
            return f"{what}: {self.error}"
        return (
            f"{what}: {self.identity.manufacturer} {self.identity.model}, serial number {self.identity.serial_number}"
        )

    def record(self) -> dict[str, Any]:
        """Return the result for the provenance."""
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


def connect(driver: Any) -> Identity:
    """Open a driver and return the identity of its instrument; close it after an error."""
    try:
        driver.open()
        identity: Identity = driver.identify()
    except BaseException:
        driver.close()
        raise
    return identity


class OpenBench:
    """The instruments of a bench, opened and closed together.

    Parameters
    ----------
    plan : BenchPlan
        The bench.
    ask : callable, optional
        Sends a request to the operator and returns when it is done. Not called if all instruments are simulated.
        Without it, a request of a method raises BenchError.

    Attributes
    ----------
    answers : list of Answer
        Result of opening each instrument.
    """

    def __init__(self, plan: BenchPlan, ask: Callable[[str], None] | None = None) -> None:
        self.plan = plan
        self.machine = plan.machine
        self.description = plan.description
        self.answers: list[Answer] = []
        self._ask = ask

    @classmethod
    def closed(cls, plan: BenchPlan) -> Self:
        """Return a bench whose drivers are made, and not opened: what they are and can do is known.

        Raises
        ------
        BenchError
            A driver cannot be made with its settings, or does not check limits.
        """
        bench = cls(plan)
        for instrument in plan.instruments:
            try:
                driver = instrument.driver(instrument.address, instrument.settings)
            except ErrormotionError as error:
                raise BenchError(f"instrument '{instrument.name}': {error}", code=error.code) from error
            bench._bind(driver)
            bench.answers.append(Answer(instrument, driver))
        return bench

    def open(self) -> None:
        """Open every instrument.

        Raises
        ------
        BenchError
            At least one instrument failed. The message lists all instruments and causes of failures; none remains open.
        """
        try:
            self.try_open()
        except BaseException:
            self.close()
            raise
        failed = [answer for answer in self.answers if answer.identity is None]
        if failed:
            self.close()
            head = f"Bench '{self.plan.name}': {len(failed)} of {len(self.answers)} instruments could not be opened."
            raise BenchError(
                "\n".join([head, *tree([answer.line() for answer in self.answers])]), code="bench.not_opened"
            )

    def try_open(self) -> None:
        """Open all instruments; ``answers`` contains the failures."""
        describe(self.description)
        for instrument in self.plan.instruments:
            try:
                driver = instrument.driver(instrument.address, instrument.settings)
                self._bind(driver)
                identity = connect(driver)
            except Exception as error:
                log.exception("instrument %s could not be opened", instrument.name)
                self.answers.append(Answer(instrument, error=cause_of(error), code=code_of(error, "error.internal")))
            else:
                self.answers.append(Answer(instrument, driver, identity))

    def set_limits(self, forbidden: str = "") -> None:
        """Apply the limits of the bench to every driver; ``forbidden``: why no motion at all is allowed."""
        for answer in self.answers:
            if answer.driver is not None:
                self._bind(answer.driver, forbidden)

    def _bind(self, driver: Any, forbidden: str = "") -> None:
        if hasattr(driver, "bound"):
            driver.bound(self.plan.limits.of_machine(forbidden))
        elif changes_machine(driver):
            raise BenchError(
                f"The driver '{driver.info.id}' can move or change a machine and does not check limits: it has no "
                "method 'bound'. 'errormotion plugins check' lists the requirements for such a driver",
                code="bench.driver.no_limits",
            )

    def close(self) -> None:
        """Close every instrument in reverse order, even if one of them fails."""
        for answer in reversed(self.answers):
            if answer.driver is None:
                continue
            try:
                answer.driver.close()
            except Exception:
                log.exception("instrument %s could not be closed", answer.instrument.name)

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def virtual(self) -> bool:
        """Return whether every instrument is simulated."""
        return all(answer.identity is not None and answer.identity.simulated for answer in self.answers)

    def chosen(self, choice: Mapping[str, str]) -> OpenBench:
        """Return the open bench with one instrument for each kind in ``choice`` (kind to name), and all others."""
        bench = copy(self)
        kinds = [(answer, answer.instrument.driver.info.kind) for answer in self.answers]
        bench.answers = [
            answer for answer, kind in kinds if choice.get(kind, answer.instrument.name) == answer.instrument.name
        ]
        return bench

    def has_kind(self, kind: str) -> bool:
        """Return whether the bench has an instrument of this kind."""
        return any(answer.instrument.driver.info.kind == kind for answer in self.answers)

    def of_kind(self, kind: str) -> Any:
        """Return the one instrument of this kind.

        Raises
        ------
        BenchError
            The bench has none, or several.
        """
        answers = [answer for answer in self.answers if answer.instrument.driver.info.kind == kind]
        if len(answers) == 1:
            return answers[0].driver
        if answers:
            names = ", ".join(answer.instrument.name for answer in answers)
            raise BenchError(
                f"Bench '{self.plan.name}': expected one {kind}; found {names}. Choose one in the test: "
                f'instruments = {{ {kind} = "{answers[0].instrument.name}" }}.',
                code="bench.instruments.several",
            )
        raise BenchError(
            f"Bench '{self.plan.name}': expected a {kind}; found {', '.join(self.plan.kinds)}. "
            f"Add one to {self.plan.source}.",
            code="bench.instrument.missing",
        )

    def all_of_kind(self, kind: str) -> dict[str, Any]:
        """Return all instruments of this kind by their names on the bench."""
        return {a.instrument.name: a.driver for a in self.answers if a.instrument.driver.info.kind == kind}

    def ask(self, message: str, action: str = "", **values: Any) -> None:
        """Send a request to the operator and wait until it is done; returns immediately on a virtual bench.

        A virtual machine that can do the ``action`` does it, instead of the operator.
        """
        acting = [answer.driver for answer in self.answers if action and hasattr(answer.driver, "act")]
        for driver in acting:
            driver.act(action, **values)
        if acting or self.virtual:
            return
        if self._ask is None:
            raise BenchError(
                f"A request to the operator cannot be shown ({message}). Run the command in a terminal, or with --yes.",
                code="operator.request.not_shown",
            )
        log.info("request to the operator: %s", message)
        self._ask(message)
        log.info("request done")


def tree(lines: list[str]) -> list[str]:
    """Return lines with the branches of a tree as prefix; further lines of an entry are indented."""
    drawn = []
    for number, line in enumerate(lines):
        last = number == len(lines) - 1
        first, *rest = line.splitlines() or [""]
        drawn.append(("└── " if last else "├── ") + first)
        drawn += [("    " if last else "│   ") + text for text in rest]
    return drawn
