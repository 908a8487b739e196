"""``errormotion identify``, ``import``, ``report`` and ``validate``: commands on stored data."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import typer

from errormotion import datasets, plugins
from errormotion.campaign.storage.raw_paths import is_runs_folder, raw_of
from errormotion.cli.guard import ERROR, INTERNAL, UsageError, log_file
from errormotion.cli.options import read_settings
from errormotion.cli.output import failure, show, show_json, working
from errormotion.cli.page import new_files
from errormotion.cli.progress import Bars
from errormotion.cli.summary import as_printed, figure_table, notes_of
from errormotion.cli.tolerances import end_with, lines_of, remarks
from errormotion.datasets.clock import noted
from errormotion.datasets.files.reading import visible
from errormotion.datasets.results.merit import figures_of
from errormotion.datasets.storage.disk import reading
from errormotion.datasets.validation import explained
from errormotion.errors import DatasetError, ErrormotionError
from errormotion.tolerances.conformity import judge
from errormotion.tolerances.table import Tolerances, from_run, load_tolerances

if TYPE_CHECKING:
    import xarray as xr

    from errormotion.campaign.batch import Outcome
    from errormotion.report import Form
    from errormotion.tolerances.conformity import Conformity


class Trials(NamedTuple):
    """Options of ``--monte-carlo``; ``number`` is None for the adaptive procedure."""

    number: int | None
    digits: int
    seed: int


def identify(
    raws: list[Path],
    method_id: str | None,
    out: Path,
    assignments: list[str],
    settings_file: Path | None,
    scheduler: str | None,
    workers: int | None,
    tolerances: Path | None,
    as_json: bool,
    trials: Trials | None = None,
) -> None:
    """Identify one raw dataset into a file, or several into a folder, and decide on tolerances."""
    limits = load_tolerances(tolerances) if tolerances is not None else None
    several = len(raws) > 1 or is_runs_folder(raws[0]) or (trials is None and (scheduler or workers))
    if not several:
        new_files(None, out)
    method_id = method_id or _method_of(raws[0])
    settings = read_settings(plugins.get("methods", method_id).Settings, settings_file, assignments)
    if not several:
        _identify_one(raw_of(raws[0]), method_id, settings, out, limits, as_json, trials, scheduler, workers)
        return
    from errormotion.campaign import batch

    scheduler, note = batch.choose_scheduler(scheduler)
    if note:
        show(note, err=True)
    with Bars(as_json) as bars:
        outcomes = batch.identify_runs(
            raws, method_id, settings, out, scheduler=scheduler, workers=workers, progress=bars
        )
        evaluations = (
            {} if trials is None else _evaluated(outcomes, method_id, settings, trials, scheduler, workers, bars)
        )
    _show_outcomes(outcomes, out, scheduler, limits, as_json, evaluations)


def _evaluated(
    outcomes: list[Outcome],
    method_id: str,
    settings: Any,
    trials: Trials,
    scheduler: str,
    workers: int | None,
    bars: Bars,
) -> dict[Path, xr.Dataset | str]:
    """Return the Monte Carlo evaluation of each result, or why it failed; existing evaluations are kept."""
    from errormotion.montecarlo.saving import evaluate_and_save, evaluation_file

    found = dict[Path, Any]()
    for outcome in outcomes:
        if outcome.reason or outcome.errors is None:
            continue
        file = evaluation_file(outcome.errors)
        try:
            found[outcome.raw] = (
                datasets.load(file)
                if file.exists()
                else evaluate_and_save(
                    raw_of(outcome.raw), method_id, settings, datasets.load(outcome.errors), outcome.errors,
                    trials=trials.number, digits=trials.digits, seed=trials.seed, scheduler=scheduler, workers=workers,
                    progress=bars,
                )
            )  # fmt: skip
        except ErrormotionError as error:
            found[outcome.raw] = str(error)
    return found


def _method_of(raw: Path) -> str:
    """Return the id of the method that identifies a raw dataset."""
    if is_runs_folder(raw):
        raise DatasetError(f"{raw}: is a folder of runs; name the method with --method", code="batch.method.not_stated")
    path = raw_of(raw)
    with reading(path), datasets.load(path) as dataset:
        schema = str(dataset.attrs.get("schema", "none"))
    owner = plugins.owner_of_schema(schema)
    if owner is None or not issubclass(owner, plugins.Method):
        raise DatasetError(f"{path}: expected a raw dataset of a method; found schema {schema}", code="schema.other")
    if schema in owner.calibrations:
        raise DatasetError(
            f"{path}: contains readings for a calibration; use 'errormotion calibrate'", code="raw.for_calibration"
        )
    return str(owner.info.id)


def _show_outcomes(
    outcomes: list[Outcome],
    out: Path,
    scheduler: str,
    limits: Tolerances | None,
    as_json: bool,
    evaluations: Mapping[Path, xr.Dataset | str],
) -> None:
    """Print the outcome of each run; the exit code is that of a failure if a run failed, else of the tolerances."""
    from errormotion.cli.commands.results import monte_carlo

    refused = [each for each in evaluations.values() if isinstance(each, str)]
    failed = [outcome for outcome in outcomes if outcome.reason]
    found = {}
    for outcome in outcomes:
        if limits is not None and outcome.errors is not None and not outcome.reason:
            found[outcome.raw] = judge(datasets.load(outcome.errors), limits)
    decisions = [each.plain() for each in found.values()]
    if as_json:
        keys = ("raw", "errors", "reason", "code", "seconds", "stepped_over")
        runs: list[dict[str, Any]] = [{key: getattr(outcome, key) for key in keys} for outcome in outcomes]
        for outcome, run in zip(outcomes, runs, strict=True):
            run["conformity"] = found[outcome.raw].plain() if outcome.raw in found else None
            if (evaluation := evaluations.get(outcome.raw)) is not None:
                run["verdicts"] = evaluation if isinstance(evaluation, str) else monte_carlo.summary(evaluation)
        bad = [f"{outcome.raw}: {outcome.reason}" for outcome in failed] + refused
        error = failure("\n".join(bad), code="batch.failed") if bad else {}
        show_json({"ok": not bad, "scheduler": scheduler, "runs": runs, **error})
    else:
        stepped_over = sum(outcome.stepped_over for outcome in outcomes)
        made = len(outcomes) - len(failed) - stepped_over
        show(f"{out}: {made} identified, {stepped_over} existed already, {len(failed)} failed")
        for outcome in failed:
            name = "" if outcome.reason.startswith(str(outcome.raw)) else f"{outcome.raw}: "
            show(f"  failed: {name}{outcome.reason}")
        for raw, conformity in found.items():
            for line in conformity.lines()[:1]:
                show(f"  {raw}: {line}")
        for line in remarks(decisions):
            show(line)
        for raw, evaluated in evaluations.items():
            if isinstance(evaluated, str):
                show(f"  failed: Monte Carlo evaluation of {raw}: {evaluated}")
            else:
                monte_carlo.show_evaluation(evaluated, raw)
    broken = any(outcome.traceback for outcome in failed)
    if broken:
        show(f"The tracebacks are in {log_file()}.", err=True)
    if failed or refused:
        raise typer.Exit(INTERNAL if broken else ERROR)
    end_with(decisions)


def _identify_one(
    raw: Path,
    method_id: str,
    settings: Any,
    out: Path,
    limits: Tolerances | None,
    as_json: bool,
    trials: Trials | None,
    scheduler: str | None,
    workers: int | None,
) -> None:
    method, evaluation, file = plugins.get("methods", method_id), None, out
    if trials is not None:
        from errormotion.cli.commands.results import monte_carlo
        from errormotion.montecarlo.saving import evaluate_and_save

        file = monte_carlo.beside(out)
    with Bars(as_json) as bars:
        with reading(raw), datasets.load(raw) as dataset:
            bars.stage("identifying")
            with explained(raw, dataset):
                errors = noted(method().identify(dataset, settings), dataset)
        datasets.validate(errors)
        if trials is not None:
            evaluation = evaluate_and_save(
                raw, method_id, settings, errors, out, trials=trials.number, digits=trials.digits, seed=trials.seed,
                scheduler=scheduler or "threads", workers=workers, progress=bars,
            )  # fmt: skip
    datasets.save(errors, out)
    results, notes = [as_printed(figure) for figure in figures_of(errors)], notes_of(errors)
    found = judge(errors, limits) if limits is not None else None
    if as_json:
        answer = {"errors": str(out), "component": errors.attrs["component"], "results": results, "notes": notes}
        if evaluation is not None:
            answer |= {"monte_carlo": str(file), "verdicts": monte_carlo.summary(evaluation)}
        show_json({"ok": True, **answer, "conformity": found.plain() if found is not None else None})
    else:
        show(f"{out}: errors of {errors.attrs['component']} by {method_id} {errors.attrs['method_version']}")
        for line in lines_of(found) if found is not None else []:
            show(line)
        if results:
            show(figure_table(results))
        for note in notes:
            show(f"  note: {note}")
        if evaluation is not None:
            monte_carlo.show_evaluation(evaluation, file)
    if found is not None:
        end_with([found.plain()])


def report(
    runs: list[Path],
    out: Path | None,
    tolerances: Path | None,
    as_json: bool,
    *,
    language: str = "",
    paper: str = "",
    also: tuple[str, ...] = (),
) -> None:
    """Write the reports of run folders or of files of errors, and decide on the tolerances."""
    from errormotion.report import Form

    if out is not None and len(runs) > 1:
        raise UsageError(f"--out {out}: expected one run; found {len(runs)}", code="option.combination")
    limits = load_tolerances(tolerances) if tolerances is not None else None
    form, documents = Form(language, paper, also), list[dict[str, Any]]()
    for run in runs:
        page, found = (_report_run if run.is_dir() else _report_errors)(run, out, limits, form)
        files = [str(each) for each in form.beside(page)]
        plain = found.plain() if found is not None else None
        documents.append({"report": str(page), "files": files, "conformity": plain})
        if not as_json:
            for line in (*(lines_of(found) if found is not None else []), str(page), *files):
                show(line)
    if as_json:
        show_json({"ok": True, **(documents[0] if len(runs) == 1 else {"reports": documents})})
    if decided := [each["conformity"] for each in documents if each["conformity"] is not None]:
        end_with(decided)


def _report_run(run: Path, out: Path | None, limits: Tolerances | None, form: Form) -> tuple[Path, Conformity | None]:
    """Write the report of a run folder; return the page and the decision on the tolerances."""
    from errormotion.campaign.folder import RunFolder
    from errormotion.report import write_run_report

    folder, found = RunFolder.open(run), None
    stored = limits or from_run(folder.data)
    if stored is not None and folder.errors is not None:
        with reading(folder.errors), datasets.load(folder.errors) as errors:
            datasets.validate(errors)
            found = judge(errors, stored)
        folder.save(tolerances=stored.model_dump(mode="json"), conformity=found.plain())
    with working("Writing the report"), reading(run):
        page = write_run_report(run, out, form=form)
    if out is None:
        folder.data["report"] = page.relative_to(folder.path).as_posix()
        folder.step("report", "done")
        folder.save()
    return page, found


def _report_errors(
    file: Path, out: Path | None, limits: Tolerances | None, form: Form
) -> tuple[Path, Conformity | None]:
    """Write the report of a file of errors; return the page and the decision on the tolerances."""
    from errormotion.report import write_report
    from errormotion.report.write import belonging

    with working("Writing the report"), reading(file), datasets.load(file) as errors, explained(file, errors):
        state = {"tolerances": limits.model_dump(mode="json")} if limits is not None else None
        page = out or file.with_suffix(".html")
        page = write_report([errors, *belonging(errors, file)], page, run=state, form=form)
        return page, judge(errors, limits) if limits is not None else None


def validate(file: Path) -> list[str]:
    """Return every violation of a dataset, a run folder, a bench or a campaign file."""
    if file.suffix == ".toml":
        return _of_toml(file)
    if (file / "run.json").exists():
        return _of_run(file)
    try:
        with reading(file), datasets.load(file) as dataset:
            return list(datasets.violations(dataset))
    except DatasetError as error:
        return [str(error)]


def alike(mistakes: list[str]) -> list[str]:
    """Return violations as text, similar ones on one line."""
    from errormotion.datasets.files.tomlfile import grouped

    return grouped(mistakes)


def _of_toml(file: Path) -> list[str]:
    from errormotion.campaign.files import load_bench, load_campaign
    from errormotion.datasets.files.tomlfile import read_toml

    try:
        schema = str(read_toml(file).get("schema", ""))
        if schema.startswith("errormotion.campaign/"):
            load_campaign(file)
        elif schema.startswith("errormotion.tolerances/"):
            load_tolerances(file)
        elif schema.startswith("errormotion.bench/") or not schema:
            load_bench(file)
        else:
            return [
                "schema: expected that of a bench, a campaign or tolerances, such as errormotion.bench/1; "
                f"found {schema!r}. Other files are checked by the command that reads them."
            ]
    except ErrormotionError as error:
        return _mistakes(str(error), file)
    return []


def _mistakes(message: str, file: Path) -> list[str]:
    """Return the mistakes of a message; those of another file, such as the bench of a campaign, state its name."""
    from errormotion.datasets.files.tomlfile import single

    found, source = list[str](), str(file)
    for line in message.splitlines():
        if line.startswith("  - "):
            text = line.removeprefix("  - ")
            found += [each if source == str(file) else f"{source}: {each}" for each in single(text)]
        elif re.fullmatch(r".*: \d+ mistakes?", line):
            source = line.rpartition(": ")[0]
        elif found and line.startswith(" "):
            found[-1] += f"\n{line}"
        else:
            found.append(line.removeprefix(f"{file}: "))
    return found


def _of_run(path: Path) -> list[str]:
    from errormotion.campaign.folder import RunFolder
    from errormotion.datasets.files import events
    from errormotion.record.adding import originals

    try:
        folder = RunFolder.open(path)
    except ErrormotionError as error:
        return [str(error)]
    found = []
    for part in ([folder.raw] if folder.raw.exists() else []) + visible(path, "errors/*/errors.nc"):
        found += [f"{part.relative_to(path)}: {violation}" for violation in validate(part)]
    found += [*originals.violations(folder), *events.read(path)[1]]
    if folder.finished and folder.errors is None and folder.data.get("method", {}).get("id", "-"):
        found.append("run.json: expected 'errors', because the run is finished; found null")
    return found
