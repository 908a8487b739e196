"""``errormotion init``: writes a bench and a campaign file from options and answers."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import typer

from errormotion import plugins
from errormotion.campaign.files import parse_bench, parse_campaign
from errormotion.cli.commands.campaigns.init import asking
from errormotion.cli.commands.campaigns.init.writing import Answers, Instrument, Test, bench_text, campaign_text
from errormotion.cli.guard import UsageError
from errormotion.cli.output import show, show_json
from errormotion.datasets.files.tomltext import value_of
from errormotion.datasets.files.writing import replace_text
from errormotion.errors import BenchError, ErrormotionError

BENCH, CAMPAIGN = "bench.toml", "campaign.toml"


def init(
    folder: Path,
    machine: str,
    chain: str,
    travel: Sequence[str],
    instruments: Sequence[str],
    tests: Sequence[str],
    assignments: Sequence[str],
    *,
    force: bool,
    as_json: bool,
    ask: asking.Ask | None = None,
) -> None:
    """Write a bench and a campaign file.

    Parameters
    ----------
    travel : sequence of str
        Travels of axes, ``AXIS=LOW,HIGH``, with units.
    instruments : sequence of str
        ``NAME=ID@ADDRESS``.
    tests : sequence of str
        ``NAME=ID``.
    assignments : sequence of str
        ``NAME.KEY=VALUE``: one setting of an instrument or a test.
    ask : callable, optional
        Asks the user for what is not stated; default: a prompt on a terminal.

    Raises
    ------
    BenchError
        The files would be invalid, or one exists and ``force`` is false. Nothing is written.
    """
    answers = _stated(machine, chain, travel, instruments, tests, assignments)
    targets = [folder / BENCH, folder / CAMPAIGN]
    if not force and (there := [str(path) for path in targets if path.exists()]):
        raise BenchError(
            f"{' and '.join(there)}: already exists; give another folder, or --force to replace it",
            code="init.file.exists",
        )
    if ask is None and sys.stdin.isatty() and sys.stderr.isatty() and not as_json:
        ask = _prompt
    if ask is not None:
        asking.complete(answers, ask)
    elif not answers.machine or not answers.instruments:
        raise UsageError(
            "Expected --machine and at least one --instrument, as there is no terminal for questions.",
            code="option.missing",
        )
    texts = _texts(answers, folder)
    try:
        taken = _check(answers, texts)
    except ErrormotionError as error:
        if ask is None:
            raise BenchError(f"{error}\nNothing was written.", code=error.code) from error
        _save(texts, force)
        raise BenchError(
            f"{error}\nThe answers were written nevertheless: correct these values in the files, then "
            f"'errormotion validate {' '.join(map(str, texts))}'",
            code=error.code,
        ) from error
    _save(texts, force)
    files = [str(path) for path in texts]
    if as_json:
        show_json({"ok": True, "files": files})
        return
    for file in files:
        show(file)
    for name, keys in taken.items():
        show(f"Test {name}: from the machine {', '.join(keys)}")
    steps = [f"errormotion bench probe {files[0]}"]
    steps += [f"errormotion plan {files[1]}", f"errormotion run {files[1]}"] if len(files) > 1 else []
    show("\nNext:\n  " + "\n  ".join(steps))
    if len(files) == 1:
        show(f"No test was chosen, so that no {CAMPAIGN} was written; 'errormotion plugins list' shows the methods.")


def _stated(
    machine: str,
    chain: str,
    travel: Sequence[str],
    instruments: Sequence[str],
    tests: Sequence[str],
    assignments: Sequence[str],
) -> Answers:
    answers = Answers(machine.strip(), chain.strip())
    for text in travel:
        axis, _, span = text.partition("=")
        answers.travel[axis.strip()] = asking.span_of(span)
    for text in instruments:
        name, _, rest = text.partition("=")
        driver, _, address = rest.partition("@")
        if not name.strip() or not driver.strip():
            raise BenchError(
                f"--instrument {text}: expected NAME=ID@ADDRESS with the id of an instrument plugin",
                code="init.instrument.form",
            )
        plugins.get("instruments", driver.strip())
        answers.instruments[name.strip()] = Instrument(driver.strip(), address.strip())
    for text in tests:
        name, _, method = text.partition("=")
        if not name.strip() or not method.strip():
            raise BenchError(f"--test {text}: expected NAME=ID with the id of a method plugin", code="init.test.form")
        plugins.get("methods", method.strip())
        answers.tests[name.strip()] = Test(method.strip())
    owners: dict[str, Any] = {**answers.instruments, **answers.tests}
    for text in assignments:
        name, sign, content = text.partition("=")
        owner, _, key = name.strip().partition(".")
        if not sign or owner not in owners or not key:
            known = ", ".join(owners) or "none"
            raise BenchError(
                f"--set {text}: expected NAME.KEY=VALUE with the name of an instrument or a test ({known})",
                code="init.setting.form",
            )
        owners[owner].settings[key] = value_of(content.strip())
    return answers


def _texts(answers: Answers, folder: Path) -> dict[Path, str]:
    """Return the texts of the files by path."""
    drivers = {name: plugins.get("instruments", each.driver).Settings for name, each in answers.instruments.items()}
    methods = {name: plugins.get("methods", each.method).Settings for name, each in answers.tests.items()}
    texts = {folder / BENCH: bench_text(answers, drivers)}
    if answers.tests:
        texts[folder / CAMPAIGN] = campaign_text(answers, BENCH, methods)
    return texts


def _check(answers: Answers, texts: Mapping[Path, str]) -> dict[str, list[str]]:
    """Check the texts by the readers of the files; return by test the settings that follow from the machine."""
    paths = list(texts)
    bench = parse_bench(texts[paths[0]], paths[0])
    if len(paths) == 1:
        return {}
    campaign = parse_campaign(texts[paths[1]], paths[1], bench)
    taken = {
        test.name: sorted(test.settings.model_fields_set - set(answers.tests[test.name].settings))
        for test in campaign.tests
    }
    return {name: keys for name, keys in taken.items() if keys}


def _save(texts: Mapping[Path, str], force: bool) -> None:
    for path, text in texts.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(path, text, force)


def _write(path: Path, text: str, force: bool) -> None:
    if not force:
        with path.open("x", encoding="utf-8") as file:  # fails if the file was created meanwhile
            file.write(text)
        return
    replace_text(path, text)


def _prompt(question: str, default: str) -> str:
    return str(typer.prompt(question, default=default, show_default=bool(default), err=True))
