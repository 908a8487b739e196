"""Differences, consensus and tests compared with dense algebra, and their rates by Monte Carlo."""

import numpy as np
import pytest
from scipy.stats import kstest

from errormotion.compare.consensus import consensus
from errormotion.compare.pairs import pair
from errormotion.compare.stack import Estimate, gathered

N, D = 9, 4
SCALE = np.array([1e-6, 2e-6, 5e-6, 1e-5])


def model(rng, name, shared=(), sources=2):
    """Return an estimate without values: its covariance, and keys of which some are shared."""
    A = rng.normal(0, 1, (N, D, D)) * SCALE[:, None]
    F = rng.normal(0, 1, (sources + len(shared), N, D)) * SCALE
    keys = (*(f"{name}: {k}" for k in range(sources)), *shared)
    return Estimate(name, np.zeros((N, D)), A @ np.swapaxes(A, 1, 2) + np.diag(SCALE**2 / 10), F, keys)


def drawn(rng, models, truth):
    """Return random values; equal keys are fully correlated."""
    z = {key: rng.normal() for each in models for key in each.source}
    found = []
    for each in models:
        noise = np.einsum("nij,nj->ni", np.linalg.cholesky(each.own), rng.normal(size=(N, D)))
        moved = np.einsum("sni,s->ni", each.influence, [z[key] for key in each.source])
        found.append(Estimate(each.name, truth + noise + moved, each.own, each.influence, each.source))
    return found


def dense(models):
    """Return the covariance of all values of several estimates as one matrix."""
    keys = tuple(dict.fromkeys(key for each in models for key in each.source))
    F = np.concatenate([gathered(each, keys).reshape(len(keys), -1) for each in models], axis=1)
    V = F.T @ F
    for i, each in enumerate(models):
        for k in range(N):
            at = slice(i * N * D + k * D, i * N * D + (k + 1) * D)
            V[at, at] += each.own[k]
    return V


@pytest.mark.parametrize("shared", [(), ("bar", "thermometer")])
def test_consensus_is_the_dense_generalised_least_squares(shared):
    rng = np.random.default_rng(3)
    models = [model(rng, name, shared) for name in "abc"]
    values = drawn(rng, models, rng.normal(size=(N, D)) * SCALE)
    found = consensus(values)
    W = np.linalg.inv(dense(models))
    X = np.vstack([np.eye(N * D)] * 3)
    y = np.concatenate([each.value.ravel() for each in values])
    C = np.linalg.inv(X.T @ W @ X)
    mu = C @ X.T @ W @ y
    u = np.sqrt(np.diag(C))
    assert np.abs((found.estimate.value.ravel() - mu) / u).max() < 1e-6
    own = dense([found.estimate])
    assert np.abs((own - C) / np.outer(u, u)).max() < 1e-6
    r = y - X @ mu
    assert found.fit.value == pytest.approx(r @ W @ r, rel=1e-6)
    assert found.fit.degrees == 2 * N * D


def test_rates_of_all_tests_are_as_stated():
    rng = np.random.default_rng(4)
    models = [model(rng, name, ("bar",)) for name in "abc"]
    joint, fit, inside, en, left, held = [], [], 0, 0, [], []
    for _ in range(300):
        truth = rng.normal(size=(N, D)) * SCALE
        values = drawn(rng, models, truth)
        two = pair(values[0], values[1])
        joint.append(two.joint.p)
        en += (np.abs(two.en) <= 1).mean() / 300
        found = consensus(values)
        fit.append(found.fit.p)
        left.append(min(found.p))
        u = np.sqrt(np.diagonal(found.estimate.covariance(), axis1=1, axis2=2))
        held.append((np.abs(found.estimate.value - truth) <= 1.96 * u).mean())
    inside = np.mean(held)
    assert kstest(joint, "uniform").pvalue > 0.01
    assert kstest(fit, "uniform").pvalue > 0.01
    assert 0.92 <= en <= 0.98  # k = 2
    assert 0.93 <= inside <= 0.97
    assert np.mean(np.array(left) < 0.05) < 0.08


def test_a_common_source_treated_as_two_has_wrong_rates():
    rng = np.random.default_rng(5)
    models = [model(rng, name, ("bar",), sources=0) for name in "ab"]
    for each in models:
        each.influence[:] = 10 * SCALE
    split = [Estimate(m.name, m.value, m.own, m.influence, (f"{m.name} bar",)) for m in models]
    right, wrong = [], []
    for _ in range(200):
        values = drawn(rng, models, np.zeros((N, D)))
        apart = [Estimate(v.name, v.value, v.own, v.influence, s.source) for v, s in zip(values, split, strict=True)]
        right.append((np.abs(pair(*values).en) <= 1).mean())
        wrong.append((np.abs(pair(*apart).en) <= 1).mean())
    assert 0.92 <= np.mean(right) <= 0.98
    assert np.mean(wrong) > 0.995


def test_an_incompatible_dataset_is_named():
    rng = np.random.default_rng(6)
    models = [model(rng, name) for name in "abcd"]
    named = 0
    for _ in range(40):
        values = drawn(rng, models, np.zeros((N, D)))
        values[2].value[:] += 6 * SCALE
        found = consensus(values)
        named += found.p[2] < 0.05 and int(np.argmin(found.p)) == 2
    assert named >= 38


def test_unknown_values_of_one_dataset_do_not_affect_the_others():
    rng = np.random.default_rng(8)
    values = drawn(rng, [model(rng, name) for name in "abc"], np.zeros((N, D)))
    values[0].value[2], values[0].own[2], values[0].influence[:, 2] = np.nan, np.nan, np.nan
    found = consensus(values)
    assert np.isfinite(found.estimate.value).all()
    assert found.fit.degrees == 2 * N * D - D
    assert np.isnan(pair(values[0], values[1]).en[2]).all()
    assert pair(values[0], values[1]).joint.degrees == N * D - D


def test_datasets_without_sources_have_a_consensus():
    rng = np.random.default_rng(8)
    one, other = (
        Estimate(name, rng.normal(size=(4, 2)), np.tile(np.eye(2), (4, 1, 1)), np.zeros((0, 4, 2)), ())
        for name in ("a", "b")
    )
    np.testing.assert_allclose(consensus([one, other]).estimate.value, (one.value + other.value) / 2)
