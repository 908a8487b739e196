"""The rule of nominal coverage: what it accepts, and what it rejects."""

from __future__ import annotations

import numpy as np
import pytest

from errormotion.testing.nominal import LEVEL, SEEDS, holm, verdict


def drawn(share: float, seeds: int = SEEDS, figures: int = 20, seed: int = 0) -> np.ndarray:
    return (np.random.default_rng(seed).random((seeds, figures)) < share).astype(float)


def test_correct_intervals_meet_the_rule_but_for_one_in_a_hundred() -> None:
    # P(rejected) <= LEVEL; more than 7 of 200 have a probability of 0.4 %
    assert sum(not verdict(drawn(0.95, seed=seed)).met for seed in range(200)) <= 7


@pytest.mark.parametrize("share", [0.92, 0.98])
def test_intervals_that_are_all_too_short_or_too_long_are_rejected_by_their_share(share: float) -> None:
    assert not verdict(drawn(share)).met


def test_one_figure_that_holds_too_rarely_is_named() -> None:
    held = drawn(0.95)
    held[:, 7] = drawn(0.85, figures=1)[:, 0]  # the share of all is 94.5 %
    found = verdict(held, [f"E{k}" for k in range(20)])
    assert (found.worst, found.met) == ("E7", False)
    assert "E7" in str(found)
    assert str(found).endswith("not met")


def test_intervals_that_are_unknown_or_too_few_decide_nothing() -> None:
    held = drawn(0.95, seeds=60)
    held[:, 3] = np.nan
    found = verdict(held)
    assert (found.figures, found.met, str(found).endswith("too few seeds")) == (19, False, True)
    with pytest.raises(ValueError, match="found none"):
        verdict(np.full((500, 2), np.nan))


def test_probabilities_by_holm_are_those_of_his_procedure() -> None:
    p = np.array([0.01, 0.04, 0.003, 0.2])
    # sorted 0.003 0.01 0.04 0.2, times 4 3 2 1, not decreasing
    np.testing.assert_allclose(holm(p), [0.03, 0.08, 0.012, 0.2])
    assert (holm(p) < LEVEL).sum() == 0
