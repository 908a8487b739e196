"""Questions for a bench and a campaign; each answer is checked by the code that reads the files."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from errormotion import plugins
from errormotion.cli.commands.campaigns.init.writing import Answers, Instrument, Test
from errormotion.cli.output import show
from errormotion.datasets.files import tomlfile
from errormotion.datasets.files.tomlfile import nearest
from errormotion.datasets.files.tomltext import value_of
from errormotion.datasets.units import ANGLE, LENGTH
from errormotion.kinematics.chains import parse_chain

Ask = Callable[[str, str], str]
"""``ask(question, default)`` returns the answer of the user."""

_NAME = re.compile(r"[A-Za-z0-9_-]{1,40}")


def complete(answers: Answers, ask: Ask) -> None:
    """Ask for everything that is not stated yet."""
    if not answers.machine:
        while not answers.machine:
            answers.machine = ask("Name of the machine", "").strip()
        question = "Kinematic chain, such as workpiece-X-Y-bed-Z-spindle-tool (empty: unknown)"
        answers.chain = _checked(question, ask, _chain)
    for axis in parse_chain(answers.chain) if answers.chain and not _chain(answers.chain) else ():
        if axis not in answers.travel:
            question = f"Travel of {axis} (lowest and highest position, such as -300 mm, 300 mm)"
            answers.travel[axis] = span_of(_checked(question, ask, _span))
    if not answers.instruments:
        _instruments(answers, ask)
    if not answers.tests:
        _tests(answers, ask)
    for name, each in answers.instruments.items():
        _required(f"instrument {name}", plugins.get("instruments", each.driver).Settings, each.settings, ask)
    for name, test in answers.tests.items():
        _required(f"test {name}", plugins.get("methods", test.method).Settings, test.settings, ask)


def _instruments(answers: Answers, ask: Ask) -> None:
    drivers = {cls.info.id: cls.info for cls in plugins.loaded("instruments")}
    show("\nInstruments:")
    order = [identity for identity, _ in sorted(drivers.items(), key=lambda item: (item[1].kind, item[0]))]
    for number, identity in enumerate(order, start=1):
        show(f"  {number:>2}  {identity:<20} {drivers[identity].summary}")
    if ports := _ports():
        show(f"Serial ports of this computer: {', '.join(ports)}")
    while True:
        driver = _chosen("Number or id of an instrument (empty: no more)", ask, order)
        if not driver:
            return
        kind = drivers[driver].kind
        name = (
            _checked(f"Name of the instrument on the bench [{kind}]", ask, lambda text: _new(text, answers.instruments))
            or kind
        )
        if name in answers.instruments:
            name = f"{name}_{len(answers.instruments) + 1}"
        question = "Address, such as serial:///dev/ttyUSB0?baudrate=115200, tcp://192.168.0.2:23 or sim://cframe?seed=1"
        answers.instruments[name] = Instrument(driver, ask(question, "").strip())


def _tests(answers: Answers, ask: Ask) -> None:
    kinds = {plugins.get("instruments", each.driver).info.kind for each in answers.instruments.values()}
    methods = {cls.info.id: cls for cls in plugins.loaded("methods")}
    possible = {identity: cls for identity, cls in methods.items() if set(cls.needs.instruments) <= kinds}
    show("\nMethods for these instruments:" if possible else "\nNo method works with these instruments only:")
    for number, (identity, cls) in enumerate(sorted((possible or methods).items()), start=1):
        needs = "" if possible else f" (needs {', '.join(cls.needs.instruments)})"
        show(f"  {number:>2}  {identity:<20} {cls.info.summary}{needs}")
    while possible:
        method = _chosen("Number or id of a method (empty: no more)", ask, sorted(possible))
        if not method:
            return
        name = _checked(f"Name of the test [{method}]", ask, lambda text: _new(text, answers.tests)) or method
        if name in answers.tests:
            name = f"{name}_{len(answers.tests) + 1}"
        answers.tests[name] = Test(method)


def _required(owner: str, model: Any, stated: dict[str, Any], ask: Ask) -> None:
    """Ask for the settings of a plugin that have no default."""
    for name, field in model.model_fields.items():
        if not field.is_required() or name in stated:
            continue

        def check(text: str, name: str = name) -> str:
            if not text:
                return f"{name}: expected a value"
            mistakes = tomlfile.check({**stated, name: value_of(text)}, model)[1]
            return next((each for each in mistakes if re.match(rf"{re.escape(name)}(?![\w-])", each)), "")

        stated[name] = value_of(_checked(f"{owner}: {name} ({field.description or 'value'})", ask, check))


def _checked(question: str, ask: Ask, check: Callable[[str], str]) -> str:
    """Ask until the answer is valid; ``check`` returns the mistake of an answer, or an empty text."""
    while True:
        answer = ask(question, "").strip()
        wrong = check(answer)
        if not wrong:
            return answer
        show(f"  {wrong}")


def _chosen(question: str, ask: Ask, known: Sequence[str]) -> str:
    """Return one of the numbered choices, which is answered by its number or itself; empty for none."""
    numbered = {str(number): each for number, each in enumerate(known, start=1)}
    answer = _checked(question, ask, lambda text: "" if text in numbered else _known(text, known))
    return numbered.get(answer, answer)


def _known(text: str, known: Any) -> str:
    return "" if not text or text in known else f"'{text}' is not known; {nearest(text, known)}"


def _new(text: str, taken: Any) -> str:
    if text and not _NAME.fullmatch(text):
        return f"expected a name of letters, digits, - and _; found '{text}'"
    return f"the name '{text}' is used already; give another name" if text in taken else ""


def span_of(text: str) -> list[str]:
    """Return the two ends of a travel as texts."""
    return [part.strip() for part in text.split(",")]


def _span(text: str) -> str:
    ends = span_of(text)
    try:
        low, high = (LENGTH.parse(end) if not end.endswith("deg") else ANGLE.parse(end) for end in ends)
    except ValueError:
        return f"expected two positions with units, such as -300 mm, 300 mm; found '{text}'"
    return "" if low < high else f"expected the lowest position first; found '{text}'"


def _chain(text: str) -> str:
    try:
        if text:
            parse_chain(text)
    except ValueError as error:
        return str(error)
    return ""


def _ports() -> Sequence[str]:
    return [str(path) for pattern in ("ttyUSB*", "ttyACM*") for path in sorted(Path("/dev").glob(pattern))]
