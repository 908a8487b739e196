"""Generalised least squares with common sources against dense algebra."""

import numpy as np
import pytest

from errormotion.estimation.information import Information, Reduced, short, solve

N, D = 9, 4
SCALE = np.array([1e-6, 2e-6, 5e-6, 1e-5])


def estimate(rng, columns):
    """Return values, own covariance and influence of an estimate with sources of these numbers."""
    A = rng.normal(0, 1, (N, D, D)) * SCALE[:, None]
    own = A @ np.swapaxes(A, 1, 2) + np.diag(SCALE**2 / 10)
    return rng.normal(size=(N, D)) * 3 * SCALE, own, rng.normal(0, 1, (len(columns), N, D)) * SCALE


def reduced(values, columns):
    return [Information.of(*each, np.array(c, dtype=np.intp)) for each, c in zip(values, columns, strict=True)]


@pytest.mark.parametrize("common", [(), (6, 7)])
def test_the_solution_is_the_dense_generalised_least_squares(common):
    rng = np.random.default_rng(3)
    columns = [(0, 1, *common), (2, 3, *common), (4, 5, *common)]
    values = [estimate(rng, each) for each in columns]
    found = solve(reduced(values, columns), 6 + len(common))
    F = np.zeros((6 + len(common), 3, N * D))
    V = np.zeros((3, N * D, 3, N * D))
    for i, ((_, own, influence), its) in enumerate(zip(values, columns, strict=True)):
        F[list(its), i] = influence.reshape(len(its), -1)
        for k in range(N):
            at = slice(k * D, (k + 1) * D)
            V[i, at, i, at] = own[k]
    F = F.reshape(len(F), -1)
    W = np.linalg.inv(V.reshape(3 * N * D, -1) + F.T @ F)
    X, y = np.vstack([np.eye(N * D)] * 3), np.concatenate([each[0].ravel() for each in values])
    C = np.linalg.inv(X.T @ W @ X)
    mean, u = C @ X.T @ W @ y, np.sqrt(np.diag(C))
    assert np.abs((found.value.ravel() - mean) / u).max() < 1e-6
    G = found.influence.reshape(len(found.influence), -1)
    covariance = G.T @ G
    for k in range(N):
        covariance[k * D : (k + 1) * D, k * D : (k + 1) * D] += found.own[k]
    assert np.abs((covariance - C) / np.outer(u, u)).max() < 1e-6
    assert found.square == pytest.approx((y - X @ mean) @ W @ (y - X @ mean), rel=1e-6)


def test_estimates_that_are_left_out_together_are_those_left_out_one_by_one():
    """Many short estimates: the sources of one estimate are eliminated first, and all are left out at once."""
    rng = np.random.default_rng(9)
    columns = [(*range(6 * k, 6 * k + 6), *((54, 55) if k % 2 else (54,))) for k in range(9)]
    values = [estimate(rng, each) for each in columns]
    for value, own, influence in values[1:]:  # one value is known to the first estimate alone
        value[5, 1], own[5, 1], own[5, :, 1], influence[:, 5, 1] = np.nan, np.nan, np.nan, np.nan
    parts = reduced(values, columns)
    assert short(parts, 56)
    assert not short(parts[:2], 56)
    whole, together = solve(parts, 56), Reduced.of(parts, 56)
    found = together.solution()
    np.testing.assert_allclose(found.value, whole.value, atol=1e-9 * SCALE.max())
    covariance = [each.own + np.einsum("sni,snj->nij", each.influence, each.influence) for each in (found, whole)]
    np.testing.assert_allclose(*covariance, rtol=1e-7)
    assert found.square == pytest.approx(whole.square, rel=1e-9)
    left = [solve(parts[:i] + parts[i + 1 :], 56).square for i in range(len(parts))]
    np.testing.assert_allclose(whole.square - together.decreases(), left, rtol=1e-9)


def test_a_value_without_variance_has_no_weight():
    own = np.tile(np.eye(2), (3, 1, 1))
    own[1] = 0.0
    found = solve([Information.of(np.ones((3, 2)), own, np.zeros((0, 3, 2)), np.zeros(0, dtype=np.intp))], 0)
    assert found.seen.tolist() == [[True, True], [False, False], [True, True]]
