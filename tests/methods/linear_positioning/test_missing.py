"""Any readings may be missing: a result with finite uncertainties, unknown figures, or a clear refusal."""

import numpy as np
import pytest
from scipy import stats

from errormotion.datasets.results.merit import figures_of
from errormotion.errors import ErrormotionError
from errormotion.methods.linear_positioning import LinearPositioning, LinearPositioningSettings

METHOD = LinearPositioning()
STATED = {"scatter": 0.3e-6, "drift": 0.5e-6}


def single_backward(values):
    values[0, :, 1, :] = np.nan
    values[0, 0, 1, 3] = 1e-6


def one_target(values):
    values[..., 1:] = np.nan


def one_reading(values):
    values[:] = np.nan
    values[0, 0, 0, 0] = 0.0


def one_run(values):
    values[:, 1:] = np.nan


def equal(values):
    values[:] = 1e-6


def one_approach_at_a_target(values):
    values[0, :, 1, 3] = np.nan


def at_random(share, seed):
    def remove(values):
        values[np.random.default_rng(seed).random(values.shape) < share] = np.nan

    return remove


CASES = {each.__name__: each for each in (single_backward, one_target, one_reading, one_run, equal)}
CASES |= {one_approach_at_a_target.__name__: one_approach_at_a_target}
CASES |= {
    f"{share:.0%} missing, {seed}": at_random(share, seed) for share in (0.3, 0.6, 0.9, 0.95) for seed in range(4)
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(("runs", "stated"), [(1, STATED), (2, {"drift": 0.5e-6}), (5, {})], ids=["1", "2", "5"])
def test_missing_readings_give_a_result_or_a_refusal(case, runs, stated):
    settings = LinearPositioningSettings(runs=runs, uncertainty=stated, trials=200)
    raw, _ = METHOD.simulate(settings, 1)
    raw = raw.copy(deep=True)
    CASES[case](raw["deviation"].values)
    try:
        errors = METHOD.identify(raw, settings)
    except ErrormotionError as error:
        assert "expected" in str(error) or "Expected" in str(error) or "Measure more" in str(error)  # noqa: PT017
        return
    assert all(np.isfinite(figure.expanded_uncertainty) for figure in figures_of(errors))
    known = np.isfinite(errors["EX"].values)
    assert np.isfinite(errors["covariance"].sel(dof="EX", dof_="EX").values[known]).all()


def test_a_single_reading_of_one_approach_is_a_result():
    settings = LinearPositioningSettings(trials=200)
    raw, _ = METHOD.simulate(settings, 1)
    raw = raw.copy(deep=True)
    single_backward(raw["deviation"].values)
    errors = METHOD.identify(raw, settings)
    assert np.isfinite(errors["EX"].values).sum() == 1  # the bidirectional mean needs both approaches
    names = {each.name for each in figures_of(errors)}
    assert "E_forward of EXX (ISO 230-2)" in names
    assert "R_backward of EXX (ISO 230-2)" not in names


@pytest.mark.slow
def test_figures_contain_the_truth_where_targets_were_reached_by_one_approach_only():
    settings = LinearPositioningSettings(trials=400)
    seeds, held = 200, 0
    for seed in range(seeds):
        raw, truth = METHOD.simulate(settings, seed)
        raw = raw.copy(deep=True)
        raw["deviation"].values[0, :, 1, ::2] = np.nan
        errors = METHOD.identify(raw, settings)
        figure = next(each for each in figures_of(errors) if each.name == "E_forward of EXX (ISO 230-2)")
        held += abs(figure.value - np.ptp(truth["EX"].values)) <= figure.expanded_uncertainty
    assert held >= stats.binom.ppf(1e-3, seeds, 0.95)
