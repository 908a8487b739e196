"""Errors at other instants: coverage at omitted instants, exact points, no extrapolation."""

import numpy as np
import pytest
from coded import raises

from errormotion import datasets
from errormotion.datasets.results.interpolation import steps
from errormotion.errors import DatasetError


def made(t, values, noise, influence=None, dims=("time",), coords=None):
    more = {}
    if influence is not None:
        more = {"influence": influence, "sources": ["radius"], "source_groups": ["radius"]}
        covariance = noise**2 * np.eye(6) + np.einsum("s...i,s...j->...ij", influence, influence)
    else:
        covariance = np.broadcast_to(noise**2 * np.eye(6), (*np.shape(values), 6))
    return datasets.build_errors(
        values,
        covariance,
        dims=dims,
        coords=coords or {"time": t},
        component="spindle",
        machine="C-frame",
        frame="machine",
        functional_point=(0, 0, 0),
        reference="cold",
        method="example",
        method_version="1",
        provenance={},
        **more,
    )


def truth(t, rng):
    """Return six smooth drifts: two exponentials each, of up to 20 um or urad."""
    size, tau = rng.normal(0, 2e-5, (2, 6)), rng.uniform(600, 4000, (2, 6))
    return (size[:, None, :] * (1 - np.exp(-t[None, :, None] / tau[:, None, :]))).sum(axis=0)


@pytest.mark.parametrize(("noise", "step", "most"), [(1e-7, 60.0, 0.985), (1e-7, 600.0, 0.985), (2e-8, 900.0, 0.999)])
def test_intervals_contain_the_truth_at_omitted_instants(noise, step, most):
    """Half of the instants are kept. In 1800 s some warm-ups are over, which may also be steps."""
    rng, inside, count = np.random.default_rng(11), 0, 0
    t = np.arange(0, 7200 + step, step)
    left_out = t[1:-1:2] + rng.uniform(-0.4, 0.4, t[1:-1:2].size) * step
    kept = t[::2]
    for _ in range(60):
        instants = np.sort(np.concatenate([kept, left_out]))
        true = truth(instants, rng)
        at = np.isin(instants, kept)
        ds = made(kept, true[at] + noise * rng.normal(size=(at.sum(), 6)), noise)
        found = ds.em.to_times(left_out)
        error = np.abs(found.em.twist().values - true[~at])
        inside += (error <= found.em.expanded(1.96).values).sum()
        count += error.size
    assert 0.95 <= inside / count <= most


@pytest.mark.parametrize(
    ("noise", "step", "size", "least"),
    [(1e-7, 60.0, 2e-6, 0.9), (1e-7, 60.0, 2e-5, 0.97), (2e-8, 900.0, 1e-6, 0.9), (2e-8, 900.0, 2e-5, 0.95)],
)
def test_intervals_contain_a_step_between_two_instants(noise, step, size, least):
    """A switched compensation at any time; without regard to steps 42 % to 50 % of these intervals held."""
    t, inside = np.arange(14) * step, []
    for seed in range(60):
        rng = np.random.default_rng([seed, 3])
        at = rng.uniform(0.0, t[-1])
        k = int(at // step)
        new = np.sort((k + rng.uniform(0.02, 0.98, 5)) * step)
        both = np.concatenate([t, new])
        order = np.argsort(both)
        true = np.empty((both.size, 6))
        true[order] = truth(both[order], rng) + size * (both[order] >= at)[:, None] * rng.choice([-1, 1], 6)
        ds = made(t, true[:14] + noise * rng.normal(size=(14, 6)), noise)
        found = ds.em.to_times(new)
        inside.append(np.abs(found.em.twist().values - true[14:]) <= found.em.expanded(1.96).values)
    assert np.mean(inside) > least


def test_an_interval_whose_slope_is_between_its_neighbours_has_no_step():
    t = np.arange(8) * 60.0
    values = np.repeat((20e-6 * -np.expm1(-t / 200.0))[:, None], 6, axis=1)
    own = np.tile(1e-20 * np.eye(6), (8, 1, 1))
    assert not steps(t, values, own).any()
    values[4:] += 3e-6
    found = np.sqrt(steps(t, values, own))[:, 0]
    assert found[3] == pytest.approx(3e-6, abs=0.1e-6)  # the curvature of the warm-up
    assert np.max(np.delete(found, 3)) < 0.6 * found[3]  # beside it at most about half
    assert not np.delete(found, [2, 3, 4]).any()


@pytest.mark.parametrize("start", [20.0, 60.0, 110.0])
def test_the_interval_contains_a_start_between_the_first_two_instants(start):
    """A bend at one place deviates by sqrt(3) standard deviations of the process whose slope changes as much."""
    t = np.arange(0, 721, 120.0)
    values = 1e-8 * np.repeat(np.maximum(t - start, 0.0)[:, None], 6, axis=1)
    found = made(t, values, 1e-11).em.to_times([start])
    score = found["EX"].item() / np.sqrt(found["covariance"].values[0, 0, 0])
    assert score == pytest.approx(np.sqrt(3), rel=1e-3)


def test_an_instant_of_the_dataset_is_returned_unchanged():
    rng = np.random.default_rng(0)
    t = np.arange(10) * 60.0
    F = rng.normal(0, 1e-7, (1, 10, 6))
    ds = made(t, rng.normal(0, 1e-6, (10, 6)), 1e-7, F)
    found = ds.em.to_times(t[[2, 5]])
    for name in ("EX", "EC", "covariance", "influence"):
        a, b = (each.values for each in (found[name], ds[name].isel(time=[2, 5])))
        np.testing.assert_allclose(a, b, rtol=1e-12)
    assert datasets.violations(found) == []
    assert list(found.attrs["interpolation_intensity"]) == [0] * 6


def test_sources_have_their_correlation_between_new_instants():
    t = np.arange(4) * 60.0
    F = np.zeros((1, 4, 6))
    F[0, :, 0] = [1e-7, 2e-7, 3e-7, 4e-7]
    values = np.zeros((4, 6))
    values[:, 0] = t * 1e-9
    found = made(t, values, 1e-8, F).em.to_times([30.0, 90.0])
    np.testing.assert_allclose(found["influence"].values[0, :, 0], [1.5e-7, 2.5e-7])
    np.testing.assert_allclose(found["EX"].values, [30e-9, 90e-9])
    assert found.em.covariance_between(0, 1).values[0, 0] == pytest.approx(1.5e-7 * 2.5e-7)


def test_no_value_is_extrapolated_or_interpolated_in_a_gap():
    t = np.arange(5) * 60.0
    values = np.zeros((5, 6))
    values[2] = np.nan
    found = made(t, values, 1e-8).em.to_times([-10.0, 30.0, 90.0, 150.0, 240.0, 250.0])
    assert np.isfinite(found["EX"].values).tolist() == [False, True, False, False, True, False]
    assert datasets.violations(found) == []


def test_positions_of_an_axis():
    y = np.linspace(0, 0.5, 6)
    values = np.zeros((3, 6, 6))
    values[..., 1] = 1e-5 * y
    ds = made(None, values, 1e-8, dims=("time", "position"), coords={"time": [0.0, 1.0, 2.0], "y": ("position", y)})
    found = ds.em.to_positions([0.05, 0.1, 0.33])
    np.testing.assert_allclose(found["EY"].values, np.broadcast_to([5e-7, 1e-6, 3.3e-6], (3, 3)))
    assert found["EX"].dims == ("time", "position")
    assert datasets.violations(found) == []


@pytest.mark.parametrize(("times", "message"), [([2.0, 1.0], "increase"), ([np.nan], "finite")])
def test_wrong_instants_are_refused(times, message):
    with pytest.raises(DatasetError, match=message):
        made(np.arange(3.0), np.zeros((3, 6)), 1e-8).em.to_times(times)
    with raises("errors.coordinate.ambiguous"):
        made(np.arange(3.0), np.zeros((3, 6)), 1e-8).em.to_positions([0.0])
