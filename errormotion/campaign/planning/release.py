"""Release of the motions of a campaign: on a real machine nothing moves before a person has allowed it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from errormotion.campaign.addresses import is_simulated
from errormotion.campaign.files import CampaignPlan, TestPlan
from errormotion.campaign.sections.limits import NO_MOTIONS, announcement, moves, steps_of
from errormotion.errors import RunError
from errormotion.plugins import Step

WORD = "move"
"""What a person types to release motions."""
OPTION = "--move"
"""What releases them in a script."""

Release = Callable[[Sequence[str]], None]
"""Called with the motions of the tests; returns when a person has released them, else raises RunError."""


def announced(plan: CampaignPlan, test: TestPlan) -> str:
    """Return the motions of a test and their limits in one line."""
    return announcement(test.name, _steps(plan, test), plan.bench.limits)


def to_release(plan: CampaignPlan, tests: Iterable[TestPlan]) -> list[str]:
    """Return the motions of the tests that must be released; empty without motion, and if all devices are simulated."""
    if is_simulated(plan.bench):
        return []
    return [announced(plan, test) for test in tests if moves(_steps(plan, test))]


def refuse(motions: Sequence[str]) -> None:
    """Release nothing: there is no terminal on which a person could do so.

    Raises
    ------
    RunError
        Always.
    """
    raise RunError(
        "\n".join(
            [
                f"Nothing has moved, and nothing was created: {len(motions)} of the tests move a machine, and their "
                f"motions were not released. Check them, then run the command in a terminal and type '{WORD}' when it "
                f"asks; or add {OPTION}, which releases them without a question. (--yes releases no motion.)",
                *(f"  - {line}" for line in motions),
            ]
        ),
        code="motions.not_released",
    )


def released(motions: Sequence[str]) -> None:
    """Release all motions: a person has done so before."""


def require_word(found: str) -> None:
    """Accept only what releases motions.

    Raises
    ------
    RunError
        Another text was typed.
    """
    if found.strip() != WORD:
        raise RunError(
            f"Nothing has moved, and nothing was created: expected the word '{WORD}', which releases the motions; "
            f"found '{found.strip()[:40]}'.",
            code="motions.not_released",
        )


def forbidden(plan: CampaignPlan, test: TestPlan) -> str:
    """Return why a test must not command a motion: it states none, so that nobody was asked; else an empty text.

    On a bench whose devices are all simulated nobody is asked, and a test may mount a tool or set a schedule.
    """
    steps, name = _steps(plan, test), test.method.info.id
    if steps is None:
        return NO_MOTIONS.format(name)
    return (
        ""
        if moves(steps) or is_simulated(plan.bench)
        else f"the method '{name}' states that nothing moves in this test"
    )


def _steps(plan: CampaignPlan, test: TestPlan) -> list[Step] | None:
    return steps_of(test.method, test.settings, plan.bench.chosen(test.instruments).settings_by_kind)
