"""Errors over the position with their covariance, and requirements on the data."""

import numpy as np
import pytest
from coded import raises
from scipy import stats

from errormotion.datasets.results.merit import figures_of
from errormotion.errors import MethodError
from errormotion.methods.linear_positioning.identification import scatter

P = np.linspace(0.0, 1.0, 11)


def scattered(x, kind="auto", drift=None, stated=None):
    """Return the variances of readings (approach, run, target), and the scaled positions."""
    z = np.linspace(-1.0, 1.0, x.shape[-1])
    return scatter.scatter(x, z, kind=kind, drift=drift, stated=stated), z


def noisy(seed=0, freedoms=1, runs=5, size=1e-6):
    return size * np.random.default_rng(seed).normal(size=(freedoms, runs, 2, P.size))


def test_value_is_the_mean_of_both_approaches(raw_of, identify):
    readings = noisy()
    errors = identify(raw_of(readings, P, axis="Y", freedoms=("EY",)))
    np.testing.assert_allclose(errors["EY"], readings[0].mean(axis=(0, 1)), atol=1e-18)
    np.testing.assert_allclose(errors["y"], P)
    assert errors.attrs["component"] == "Y"
    assert np.isnan(errors["EX"]).all()


def test_targets_may_be_in_any_order(raw_of, identify):
    readings, order = noisy(), np.random.default_rng(1).permutation(P.size)
    straight, mixed = identify(raw_of(readings, P)), identify(raw_of(readings[..., order], P[order]))
    np.testing.assert_allclose(mixed["EX"], straight["EX"], atol=1e-18)
    np.testing.assert_allclose(mixed["covariance"], straight["covariance"], rtol=1e-9)


def test_covariance_of_the_means_is_the_cramer_rao_bound_of_the_model(raw_of, identify):
    """If no reading is missing, the mean is the weighted least-squares estimate of the model of the scatter."""
    readings = noisy() + 1e-6 * np.random.default_rng(1).normal(size=(1, 5, 1, 1))
    errors = identify(raw_of(readings, P))
    found, z = scattered(readings[0].transpose(1, 0, 2))
    # variances as the method states them, with their Student factors
    own, (o, q, p, w) = found.own_stated.ravel(), found.run_stated
    D, H = o + q * np.outer(z, z), p + w * np.outer(z, z)
    V = np.block([[D + H, D - H], [D - H, D + H]]) + np.diag(own)  # of one run, forward then backward
    information = 5 * np.linalg.inv(V)
    mean = np.hstack([np.eye(P.size), np.eye(P.size)]) / 2.0
    bound = mean @ np.linalg.inv(information) @ mean.T
    stated = np.array([[errors.em.covariance_between(i, j).values[0, 0] for j in range(0, 11, 5)] for i in (0, 5, 10)])
    np.testing.assert_allclose(stated, bound[::5, ::5], rtol=1e-6)


def test_a_warm_axis_is_corrected_to_20_degrees(raw_of, identify):
    warm = 2.0
    readings = noisy() + 11.5e-6 * warm * P
    side = {"expansion": 11.5e-6, "temperature": 20.0 + warm}
    errors = identify(raw_of(readings, P), machine=side)
    cold = identify(raw_of(noisy(), P))
    np.testing.assert_allclose(errors["EX"], cold["EX"], atol=1e-12)
    assert "20 degC" in errors.attrs["reference"]
    assert "temperature of the test" in cold.attrs["reference"]
    u = errors.em.budget().sel(group="scales", dof="EX").values
    # 0.6e-6 1/K at 2 K, and 0.2 K at 11.5e-6 1/K, over the distance from the zero
    np.testing.assert_allclose(u, np.hypot(1.2e-6, 2.3e-6) * P, atol=1e-15)


def test_expansion_of_an_artefact_has_the_opposite_sign(raw_of, identify):
    both = {"expansion": 11.5e-6, "temperature": 25.0}
    errors = identify(raw_of(noisy(), P), machine=both, workpiece=both)
    np.testing.assert_allclose(errors["EX"], identify(raw_of(noisy(), P))["EX"], atol=1e-15)


def test_a_stated_alignment_changes_further_figures_only(raw_of, identify):
    plain, u = identify(raw_of(noisy(), P)), 1e-3
    errors = identify(raw_of(noisy(), P), uncertainty={"length": 0.0, "alignment": u})
    for name in ("EX", "deviations", "figure_value"):
        np.testing.assert_array_equal(errors[name], plain[name])
    moved = identify(raw_of(noisy() + u**2 * P, P))
    np.testing.assert_allclose(errors["aligned_value"], moved["figure_value"].sel(freedom="EXX"), atol=1e-15)
    names = [each.name for each in figures_of(errors)]
    assert {"A of EXX (ISO 230-2)", "A of EXX, corrected for the alignment"} <= set(names)
    assert "aligned_value" not in plain
    assert not any("corrected" in each.name for each in figures_of(plain))


@pytest.mark.parametrize("assumed", [{}, {"length": 0.0}, {"alignment": 0.0}])
def test_what_is_assumed_is_in_a_note_and_changes_no_figure(raw_of, identify, assumed):
    exact = identify(raw_of(noisy(), P))
    errors = identify(raw_of(noisy(), P), uncertainty=assumed)
    for name in ("EX", "deviations", "figure_value"):
        np.testing.assert_array_equal(errors[name], exact[name])
    notes = " ".join(errors.em.notes)
    assert ("0.2 mrad" in notes) == ("alignment" not in assumed)
    assert ("0.5 um/m" in notes) == ("length" not in assumed)
    assert "no expansion of the workpiece" in notes
    assert (errors["covariance"].values[1:, 0, 0] > exact["covariance"].values[1:, 0, 0]).all()


def test_the_one_sided_cosine_error_is_within_the_uncertainty(raw_of, identify):
    u = 1e-3
    errors = identify(raw_of(noisy(), P), uncertainty={"length": 0.0, "alignment": u})
    # two normal components: half the square of the angle is exponential, mean and standard deviation u^2
    angles = u * np.random.default_rng(0).normal(size=(200_000, 2))
    half = (angles**2).sum(axis=1) / 2.0
    budget = errors.em.budget().sel(group="alignment", dof="EX").values
    # The readings are not corrected: the root mean square of the error, mean included.
    np.testing.assert_allclose(budget, np.sqrt((half**2).mean()) * P, rtol=0.02)
    assert (half <= 2.0 * np.sqrt(2.0) * u**2).mean() > 0.94


def test_a_straightness_does_not_depend_on_the_line_of_the_instrument(raw_of, identify):
    readings = noisy()
    straight = identify(raw_of(readings, P, freedoms=("EY",)))
    inclined = identify(raw_of(readings + 3e-5 + 1e-4 * P, P, freedoms=("EY",)))
    np.testing.assert_allclose(inclined["EY"], straight["EY"], atol=1e-15)
    assert float(straight["EY"][0]) == float(straight["EY"][-1]) == 0.0
    np.testing.assert_allclose(inclined["figure_value"], straight["figure_value"], atol=1e-15)


def test_missing_readings_are_counted_and_enlarge_the_uncertainty_there(raw_of, identify):
    readings = noisy()
    full = identify(raw_of(readings, P))
    readings[0, :3, :, 4] = np.nan
    errors = identify(raw_of(readings, P))
    assert "6 of 110 readings are missing" in " ".join(errors.em.notes)
    ratio = errors["covariance"][4, 0, 0] / full["covariance"][4, 0, 0]
    assert ratio > 1.5  # two runs are left of five
    readings[0, :, 1, 7] = np.nan
    assert np.isnan(identify(raw_of(readings, P))["EX"][7])


def test_one_run_needs_stated_scatter_and_drift(raw_of, identify):
    readings = noisy(runs=1)
    with pytest.raises(MethodError, match=r"uncertainty\.scatter"):
        identify(raw_of(readings, P))
    stated = {"length": 0.0, "alignment": 0.0, "scatter": 1e-6, "drift": 0.0}
    errors = identify(raw_of(readings, P), uncertainty=stated)
    np.testing.assert_allclose(errors["covariance"][:, 0, 0], 0.5e-12, rtol=1e-9)
    assert np.isnan(float(errors["R"]))


def test_three_runs_need_a_stated_drift(raw_of, identify):
    with pytest.raises(MethodError, match=r"uncertainty\.drift"):
        identify(raw_of(noisy(runs=3), P))


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda raw: raw.assign_attrs(axis="C"), "raw.axis.unknown"),
        (lambda raw: raw.assign_coords(approach=["up", "down"]), "position.approach.labels"),
        (lambda raw: raw.assign_coords(freedom=["EXY"]), "position.freedoms.names"),
        (lambda raw: raw.isel(target=slice(2)), "position.targets.too_few"),
        (lambda raw: raw.assign(target_position=0.0 * raw["target_position"]), "position.targets.repeated"),
        (lambda raw: raw.assign(deviation=raw["deviation"] * np.nan), "position.no_readings"),
    ],
)
def test_invalid_data_are_refused_with_the_reason(raw_of, identify, change, code):
    with raises(code):
        identify(change(raw_of(noisy(), P)))


def test_variances_that_differ_from_target_to_target_are_found(raw_of, identify):
    readings = noisy() * np.where(P < 0.5, 1.0, 6.0)
    errors = identify(raw_of(readings, P))
    u = np.sqrt(errors["covariance"][:, 0, 0])
    assert u[:4].max() < u[-4:].min()
    assert "a variance for each target" in errors.attrs["provenance"]
    assert "one variance for all targets" in identify(raw_of(noisy(), P)).attrs["provenance"]


def test_drift_from_run_to_run_is_shared_by_the_targets(raw_of, identify):
    drift = 3e-6 * np.random.default_rng(2).normal(size=(1, 5, 1, 1))
    errors = identify(raw_of(noisy(size=0.1e-6) + drift, P))
    student = stats.t.ppf(0.975, 4) / stats.norm.ppf(0.975)  # four degrees of freedom
    expected = np.sqrt(drift.var(ddof=1) / 5) * student
    u = errors.em.budget().sel(group="drift from run to run", dof="EX").values
    assert u[5] == pytest.approx(expected, rel=0.05)
    assert np.sqrt(errors.em.covariance_between(0, 10).values[0, 0]) == pytest.approx(expected, rel=0.1)


def test_unequal_scatter_at_too_few_targets_is_stated_at_least_as_the_common_one():
    """Three runs leave two degrees of freedom at most for a variance of each target."""
    readings = np.random.default_rng(3).standard_normal((2, 3, 8)) * 1e-6
    readings[:, :, 3:] *= 1e-3
    found, _ = scattered(readings, drift=1e-6)
    pooled, _ = scattered(readings, "pooled", drift=1e-6)
    assert found.unequal
    assert not pooled.unequal
    assert (found.own >= pooled.own * (1 - 1e-9)).all()
    with pytest.raises(MethodError, match=r"expected \d+ runs or more at these targets; found 3"):
        scattered(readings, "target", drift=1e-6)


def test_the_scatter_of_an_axis_without_drift_is_not_underestimated():
    """A variance of runs that is estimated as 0 leaves the scatter as it is; 200 times 72 degrees of freedom: 1.2 %."""
    draw = np.random.default_rng(7).standard_normal
    own = [scattered(draw((2, 5, 11)))[0].own[0, 0] for _ in range(200)]
    assert np.mean(own) == pytest.approx(1.0, abs=3 * 0.012)


def test_variances_are_those_of_an_analysis_of_variance_if_none_is_negative():
    """Mean squares of lines through complete data, with the variance of the readings subtracted."""
    draw = np.random.default_rng(5).standard_normal
    runs, z = 30, np.linspace(-1.0, 1.0, 9)
    effects = np.array([3.0, 2.0, 1.5, 1.0])[:, None] * draw((4, runs))
    common, opposite = (effects[k][:, None] + effects[k + 1][:, None] * z for k in (0, 2))
    x = 1e-6 * (np.stack([common + opposite, common - opposite]) + 0.8 * draw((2, runs, 9)))
    found, _ = scattered(x)
    Z = np.stack([np.ones(9), z], axis=1)
    lines = (x - x.mean(axis=1, keepdims=True)) @ np.linalg.pinv(Z).T  # (approach, run, 2)
    rest = x - x.mean(axis=1, keepdims=True) - lines @ Z.T
    own = (rest**2).sum(axis=(1, 2)) / ((runs - 1) * (9 - 2))  # of each approach
    noise = np.diagonal(np.linalg.inv(Z.T @ Z)) * own.mean() / 2
    half = np.concatenate([(lines[0] + lines[1]) / 2, (lines[0] - lines[1]) / 2], axis=1)
    of_run = half.var(axis=0, ddof=1)
    # the effects of any run have a standard deviation of ten times that of the readings, not an infinite one
    np.testing.assert_allclose(found.own, np.tile(own[:, None], 9), rtol=1e-4)
    np.testing.assert_allclose(found.noise, np.tile(noise, 2), rtol=1e-4)
    # nor are the approaches weighted equally where their variances differ by accident
    np.testing.assert_allclose(found.run, of_run - np.tile(noise, 2), rtol=2e-3)
    np.testing.assert_allclose(found.freedom, runs - 1, rtol=1e-4)


@pytest.mark.parametrize("runs", [4, 5, 8])
def test_intervals_of_two_standard_uncertainties_contain_the_mean_with_few_runs(raw_of, identify, runs):
    """95 % of the means of a drifting axis are within 2 u, whatever the number of runs."""
    seeds, held = 200, []
    for seed in range(seeds):
        drift = 2e-6 * np.random.default_rng(seed + 1000).normal(size=(1, runs, 1, 1))
        errors = identify(raw_of(noisy(seed, runs=runs, size=0.2e-6) + drift, P))
        held.append(np.abs(errors["EX"][5]) <= 2.0 * np.sqrt(errors["covariance"][5, 0, 0]))
    assert stats.binom.ppf(1e-3, seeds, 0.95) <= np.sum(held) <= stats.binom.ppf(1 - 1e-3, seeds, 0.97)


def test_drift_above_the_stated_one_enlarges_the_uncertainty_of_few_runs(raw_of, identify):
    drift = np.array([-3e-6, 0.0, 3e-6])[None, :, None, None]
    stated = {"length": 0.0, "alignment": 0.0, "drift": 0.5e-6}
    errors = identify(raw_of(noisy(runs=3, size=0.1e-6) + drift, P), uncertainty=stated)
    u = errors.em.budget().sel(group="drift from run to run", dof="EX").values
    assert u[5] == pytest.approx(3e-6 / np.sqrt(3), rel=0.05)


@pytest.mark.parametrize("by", ["data", "settings"])
def test_a_stated_scatter_is_a_lower_bound(raw_of, identify, by):
    raw, stated = raw_of(noisy(size=0.1e-6), P), {"length": 0.0, "alignment": 0.0}
    if by == "data":
        raw = raw.assign(reading_scatter=("freedom", [2e-6]), run_drift=("freedom", [np.sqrt(12.0) * 1e-6]))
    else:
        stated |= {"scatter": 2e-6, "drift": np.sqrt(12.0) * 1e-6}
    budget = identify(raw, uncertainty=stated).em.budget().sel(dof="EX").isel(position=5)
    assert float(budget.sel(group="independent")) == pytest.approx(2e-6 / np.sqrt(10))
    assert float(budget.sel(group="drift from run to run")) == pytest.approx(1e-6 / np.sqrt(2 * 5), rel=1e-3)


def test_missing_readings_of_a_drifting_axis_do_not_displace_a_target(raw_of, identify):
    """A target that lacks the readings of some runs is where it would be with them: other targets show their drift."""
    drift = 5e-6 * np.arange(-2, 3)[None, :, None, None]
    readings = noisy(size=0.05e-6) + drift
    full = identify(raw_of(readings, P))
    readings[0, 3:, :, 4] = np.nan
    errors = identify(raw_of(readings, P))
    assert float(abs(errors["EX"][4] - full["EX"][4])) < 0.2e-6  # the mean of three runs is 5 um less
    u = np.sqrt(errors["covariance"].values[:, 0, 0])
    assert u[4] == pytest.approx(u[5], rel=0.01)
    between = errors.em.covariance_between(4, 5).values[0, 0] / (u[4] * u[5])
    assert between > 0.99


@pytest.mark.parametrize("seed", [*range(20), 354, 671, 1340])
def test_variances_of_very_different_sizes_are_found(seed):
    """Nanometres beside tens of micrometres, unequal targets, rounded and missing readings: all have a result."""
    draw = np.random.default_rng(seed)
    m, runs = int(draw.integers(3, 15)), int(draw.integers(2, 12))
    z = np.sort(draw.uniform(-1, 1, m))
    sd = 10 ** draw.uniform(-9, -5) * np.exp(draw.normal(size=m) * draw.choice([0, 0, 1.0, 2.0]))
    effects = draw.normal(size=(4, runs)) * (10 ** draw.uniform(-9, -5, size=4) * draw.integers(0, 2, size=4))[:, None]
    common, opposite = (effects[k][:, None] + effects[k + 1][:, None] * z for k in (0, 2))
    x = np.stack([common + opposite, common - opposite]) + sd * draw.normal(size=(2, runs, m))
    x += 1e-5 * draw.normal(size=m)
    if draw.random() < 0.3:
        x = np.round(x / 1e-7) * 1e-7
    if draw.random() < 0.5:
        x[draw.random(x.shape) < draw.choice([0.05, 0.2, 0.5, 0.8])] = np.nan
    try:
        found = scatter.scatter(x, z, kind="auto", drift=1e-7 if runs < 4 else None, stated=None)
    except MethodError as error:
        assert "expected 3 degrees of freedom or more" in str(error)  # noqa: PT017
        return
    assert np.isfinite(found.run_stated).all()
    assert (found.run_stated >= found.run * (1 - 1e-9)).all()
    assert (found.own_stated[np.isfinite(x).any(axis=1)] >= 0.0).all()
