"""What prevents a campaign and is known from its files: checked before an instrument is opened or a folder created."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from datetime import date

from errormotion.campaign.addresses import is_simulated
from errormotion.campaign.bench import OpenBench
from errormotion.campaign.files import CampaignPlan, TestPlan
from errormotion.campaign.sections.limits import moves, steps_of
from errormotion.errors import BenchError, ErrormotionError
from errormotion.plugins.kind_registry import changes_machine


def require_ready(
    plan: CampaignPlan, tests: Sequence[TestPlan], *, stored: bool = False, begun: Collection[str] = ()
) -> None:
    """Check that the instruments of the bench can do what the tests command.

    Parameters
    ----------
    plan : CampaignPlan
    tests : sequence of TestPlan
        The tests that are to be measured.
    stored : bool
        Whether the files are those that a run folder contains, which cannot be corrected.
    begun : collection of str
        Names of the tests whose measurement was interrupted.

    Raises
    ------
    BenchError
        At least one test cannot be measured; the message states every cause.
    """
    obstacles = [f"test '{test.name}': {text}" for test in tests for text in _obstacles(plan, test)]
    interrupted = ((test.name, cannot_continue(test)) for test in tests if test.name in begun)
    obstacles += [f"test '{name}': {text}" for name, text in interrupted if text]
    if not obstacles:
        return
    what = f"{plan.source}: with this bench the campaign cannot be measured. Nothing was opened, nothing was created"
    if stored:
        what += (
            ". It would be continued with the files of its start, which are in the run folder: correct the bench, and "
            "start a new run without --resume"
        )
    raise BenchError("\n  - ".join([f"{what}:", *obstacles]), code="bench.not_ready")


def cannot_continue(test: TestPlan) -> str:
    """Return why an interrupted measurement of a test cannot be continued; empty if it can."""
    return str(test.method().cannot_continue(test.settings))


def overdue(plan: CampaignPlan, tests: Iterable[TestPlan], today: date) -> list[str]:
    """Return a sentence for each calibration of the tests whose last day has passed."""
    tests = list(tests)
    used = {each.name for test in tests for each in plan.bench.chosen(test.instruments).instruments}
    unused = {each.name for each in plan.bench.instruments} - used
    return [
        f"The calibration of '{name}' was valid until {day.isoformat()}."
        for name, day in sorted(plan.bench.calibrated_until.items())
        if tests and day < today and name not in unused
    ]


def accept_overdue(
    plan: CampaignPlan,
    tests: Sequence[TestPlan],
    today: date,
    note: Callable[[str], None],
    ask: Callable[[str], None] | None,
) -> None:
    """Let the operator accept calibrations whose last day has passed; a simulated bench only notes them.

    Raises
    ------
    BenchError
        There is nobody to ask.
    """
    texts = overdue(plan, tests, today)
    if not texts:
        return
    for text in texts:
        note(f"{text} The report will state that it is overdue.")
    if is_simulated(plan.bench):
        return
    request = f"{' '.join(texts)} Measure nevertheless? The report will state that the calibration is overdue."
    if ask is None:
        raise BenchError(
            f"{' '.join(texts)} Nothing was opened, nothing was created. Calibrate, and correct [calibrated_until] of "
            f"{plan.bench.source}; or, to measure nevertheless, run the command in a terminal, or with --yes.",
            code="bench.calibration.overdue",
        )
    ask(request)


def _obstacles(plan: CampaignPlan, test: TestPlan) -> list[str]:
    bench = plan.bench.chosen(test.instruments)
    try:
        opened = OpenBench.closed(bench)
        obstacles = test.method().check_bench(test.settings, opened, tuple(test.inputs))
        if obstacles is not None:
            return list(obstacles)
        if not moves(steps_of(test.method, test.settings, bench.settings_by_kind)):
            return []
    except ErrormotionError as error:
        return [str(error)]
    movers = [instrument for instrument in bench.instruments if changes_machine(instrument.driver)]
    if not movers or any(getattr(instrument.settings, "arm", True) for instrument in movers):
        return []
    names = ", ".join(f"'{instrument.name}'" for instrument in movers)
    return [f"it moves the machine, and {names} only read, since arm = false; set arm = true in the bench file"]
