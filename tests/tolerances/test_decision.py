"""The decision rules: their zones, and their error rates at the limit by simulation."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from errormotion.tolerances.decision import INSIDE, OPEN, OUTSIDE, decide, overall

N = 200_000
LIMIT = 10e-6
U = 2e-6


def rates(true: float, **options: object) -> tuple[float, float, float]:
    """Return the frequencies of inside, open and outside for measurements of one true value."""
    rng = np.random.default_rng(1)
    found = decide(rng.normal(true, U / 2, N), np.full(N, U), -LIMIT, LIMIT, **options)  # type: ignore[arg-type]
    return tuple(float(np.mean(found == each)) for each in (INSIDE, OPEN, OUTSIDE))  # type: ignore[return-value]


@pytest.mark.parametrize("guard_factor", [0.82, 1.0, 1.5])
@pytest.mark.parametrize("true", [LIMIT, -LIMIT])
def test_at_the_limit_each_proof_is_wrong_as_often_as_the_guard_factor_states(true: float, guard_factor: float) -> None:
    expected = norm.cdf(-2 * guard_factor)
    inside, neither, outside = rates(true, guard_factor=guard_factor)
    sigma = math.sqrt(expected * (1 - expected) / N)
    assert inside == pytest.approx(expected, abs=4 * sigma)
    assert outside == pytest.approx(expected, abs=4 * sigma)
    assert neither == pytest.approx(1 - 2 * expected, abs=8 * sigma)


def test_the_guard_factor_of_the_2017_edition_has_five_per_cent_errors() -> None:
    assert norm.cdf(-2 * 0.82) == pytest.approx(0.05, abs=0.001)


def test_beyond_the_limit_false_proofs_are_rarer() -> None:
    assert rates(LIMIT + 0.5e-6)[0] < rates(LIMIT)[0]
    assert rates(LIMIT - 0.5e-6)[2] < rates(LIMIT)[2]


@pytest.mark.parametrize("rule", ["simple", "shared risk"])
def test_without_guard_band_half_of_the_decisions_at_the_limit_are_wrong(rule: str) -> None:
    inside, neither, outside = rates(LIMIT, rule=rule)
    assert neither == 0
    assert inside == pytest.approx(0.5, abs=4 * 0.5 / math.sqrt(N))
    assert outside == pytest.approx(0.5, abs=4 * 0.5 / math.sqrt(N))


@pytest.mark.parametrize(
    ("value", "expected"),
    [(0.0, INSIDE), (8e-6, INSIDE), (8.1e-6, OPEN), (12e-6, OPEN), (12.1e-6, OUTSIDE), (-12.1e-6, OUTSIDE)],
)
def test_zones_of_iso_14253(value: float, expected: int) -> None:
    assert int(decide(np.array(value), np.array(U), -LIMIT, LIMIT)) == expected


def test_shared_risk_decides_only_with_a_small_uncertainty() -> None:
    values, sizes = np.zeros(3), np.array([3e-6, 4e-6, np.nan])
    assert decide(values, sizes, -LIMIT, LIMIT, "shared risk").tolist() == [INSIDE, OPEN, OPEN]
    assert decide(values, sizes, -math.inf, LIMIT, "shared risk").tolist() == [INSIDE, OPEN, OPEN]


def test_unknown_values_and_uncertainties_have_no_decision() -> None:
    assert decide(np.array([np.nan, 0.0]), np.array([U, np.nan]), -LIMIT, LIMIT).tolist() == [OPEN, OPEN]
    assert decide(np.array([np.nan, 0.0]), np.array([U, np.nan]), -LIMIT, LIMIT, "simple").tolist() == [OPEN, INSIDE]


def test_conformity_to_a_tolerance_narrower_than_two_guard_bands_is_never_proved() -> None:
    assert INSIDE not in decide(np.linspace(-5e-6, 5e-6, 101), np.full(101, 2e-6), -1e-6, 1e-6)


def test_the_whole_is_outside_if_one_is_and_inside_if_all_are() -> None:
    assert overall([INSIDE, OPEN, OUTSIDE]) == OUTSIDE
    assert overall([INSIDE, OPEN]) == OPEN
    assert overall([INSIDE, INSIDE]) == INSIDE
    assert overall([]) == OPEN


@pytest.mark.parametrize("points", [1, 5, 20])
def test_false_rejections_of_a_freedom_grow_with_its_points_as_the_page_states(points: int) -> None:
    rng = np.random.default_rng(2)
    trials = N // points
    found = decide(rng.normal(LIMIT, U / 2, (trials, points)), np.full((trials, points), U), -LIMIT, LIMIT)
    expected = 1 - (1 - norm.cdf(-2)) ** points
    rejected = float(np.mean(np.any(found == OUTSIDE, axis=1)))
    assert rejected == pytest.approx(expected, abs=4 * math.sqrt(expected * (1 - expected) / trials))
