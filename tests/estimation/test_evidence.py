"""Coefficients with priors of estimated size, against the marginal likelihood, dense algebra, and the truth."""

import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy import stats
from scipy.optimize import minimize

from errormotion.estimation.evidence import averaged, eliminated, posteriors

SIGMA, ORDERS = 0.1, 9
ORDER = np.concatenate([[0.0], np.arange(1, ORDERS), np.arange(1, ORDERS)])
GROUP = np.concatenate([[-1], np.zeros(ORDERS - 1), np.ones(ORDERS - 1)]).astype(np.intp)
"""A constant without prior, and the polynomials of two axes."""
EXPONENTS = (1.0, 2.0, 3.0)


def readings(rng, size, exponent, count=60):
    """Return design, true coefficients and readings of two polynomials with these sizes."""
    first, second = (legendre.legvander(rng.uniform(-1, 1, count), ORDERS - 1) for _ in range(2))
    A = np.column_stack([np.ones(count), first[:, 1:], second[:, 1:]])
    x = np.concatenate([[5.0], np.repeat(size, ORDERS - 1) * ORDER[1:] ** -exponent * rng.normal(size=2 * ORDERS - 2)])
    return A, x, A @ x + SIGMA * rng.normal(size=count)


def normal(A, y):
    return A.T @ A / SIGMA**2, A.T @ y / SIGMA**2


def log_likelihood(A, y, size, exponent):
    """Return the logarithm of the marginal likelihood of readings, with a wide prior of the constant."""
    prior = np.concatenate([[1e2], np.repeat(size, ORDERS - 1) * ORDER[1:] ** -exponent])
    return stats.multivariate_normal(np.zeros(len(y)), SIGMA**2 * np.eye(len(y)) + (A * prior**2) @ A.T).logpdf(y)


def test_sizes_and_exponent_are_those_of_the_largest_marginal_likelihood():
    A, _, y = readings(np.random.default_rng(1), (1.0, 0.2), 2.0)
    N, b = normal(A, y)
    found = {
        each.exponent: each for each in posteriors(N, b, GROUP, ORDER, exponents=EXPONENTS, tolerance=1e-8, passes=5000)
    }
    best = {}
    for p in EXPONENTS:
        wanted = minimize(lambda logs, p=p: -log_likelihood(A, y, np.exp(logs), p), [0.0, -1.0], method="Nelder-Mead")
        best[p] = -wanted.fun
    for p, each in found.items():
        assert log_likelihood(A, y, each.size, p) == pytest.approx(best[p], abs=1e-3)
        assert each.evidence - found[1.0].evidence == pytest.approx(2 * (best[p] - best[1.0]), abs=4e-3)


def test_coefficients_are_those_of_the_posterior():
    A, _, y = readings(np.random.default_rng(2), (1.0, 0.2), 2.0)
    N, b = normal(A, y)
    [found] = posteriors(N, b, GROUP, ORDER, exponents=[2.0], tolerance=1e-10, passes=5000)
    precision = np.concatenate([[0.0], (np.repeat(found.size, ORDERS - 1) * ORDER[1:] ** -2.0) ** -2])
    C = np.linalg.inv(N + np.diag(precision))
    u = np.sqrt(np.diag(C))
    assert found.value == pytest.approx(C @ b, abs=1e-6 * u.min())
    assert found.covariance / np.outer(u, u) == pytest.approx(C / np.outer(u, u), abs=1e-6)
    assert found.determined == pytest.approx(1 - np.diag(C) * precision, abs=1e-6)
    assert found.determined[0] == 1.0


def test_intervals_contain_the_true_curve_if_the_data_determine_the_sizes():
    rng, count, held = np.random.default_rng(3), 100, []
    P = legendre.legvander(np.linspace(-1, 1, 21), ORDERS - 1)[:, 1:]
    for _ in range(count):
        A, x, y = readings(rng, (10.0, 5.0), 1.0)
        found = averaged(posteriors(*normal(A, y), GROUP, ORDER, exponents=EXPONENTS))
        for g in range(2):
            some = np.flatnonzero(g == GROUP)
            u = np.sqrt(np.einsum("ij,jk,ik->i", P, found.covariance[np.ix_(some, some)], P))
            held.append(np.mean(np.abs(P @ (found.value - x)[some]) <= 1.96 * u))
    # 200 curves of some five independent values: 0.95 to 0.7 %
    assert 0.93 <= np.mean(held) <= 0.97


@pytest.mark.parametrize("count", [8, 20])
def test_the_covariance_is_that_of_all_sizes(count):
    """Against numerical integration over the size of one group; without, a standard deviation lacks up to a quarter."""
    orders, found, known = np.arange(1.0, 7.0), [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        A = legendre.legvander(rng.uniform(-1, 1, count), 6)[:, 1:]
        N, b = normal(A, A @ (rng.normal(size=6) / orders) + SIGMA * rng.normal(size=count))
        [part] = posteriors(N, b, np.zeros(6, dtype=np.intp), orders, exponents=[1.0], tolerance=1e-8, passes=5000)
        C = [np.linalg.inv(N + np.diag(orders / size) ** 2) for size in np.geomspace(0.05, 20.0, 600) * part.size[0]]
        x = np.array([each @ b for each in C])
        prior = [2 * np.log(orders / size).sum() for size in np.geomspace(0.05, 20.0, 600) * part.size[0]]
        log = 0.5 * (x @ b + [np.linalg.slogdet(each)[1] for each in C] + prior)
        weight = np.exp(log - log.max()) / np.exp(log - log.max()).sum()
        mean = weight @ x
        exact = weight @ np.array([np.diag(each) for each in C]) + weight @ (x - mean) ** 2
        found.append(np.sqrt(np.diag(part.covariance + part.of_sizes) / exact))
        known.append(np.sqrt(np.diag(part.covariance) / exact))
    assert np.mean(found) == pytest.approx(1.0, abs=0.05)
    assert np.min(found) > 0.9
    assert np.min(known) < 0.9  # the sizes matter


def test_intervals_contain_the_true_curve_if_few_data_hardly_determine_the_sizes():
    """Two curves of eight orders: with the sizes as known, the intervals contained 88 %."""
    rng, held = np.random.default_rng(3), []
    P = legendre.legvander(np.linspace(-1, 1, 21), ORDERS - 1)[:, 1:]
    for _ in range(100):
        A, x, y = readings(rng, (1.0, 0.5), 1.0, count=12)
        found = averaged(
            posteriors(
                *normal(A, y), GROUP, ORDER, exponents=EXPONENTS, kind=np.zeros(2, dtype=np.intp), pooled=4.0
            )
        )  # fmt: skip
        for g in range(2):
            some = np.flatnonzero(g == GROUP)
            u = np.sqrt(np.einsum("ij,jk,ik->i", P, found.covariance[np.ix_(some, some)], P))
            held.append(np.mean(np.abs(P @ (found.value - x)[some]) <= 1.96 * u))
    assert np.mean(held) > 0.9


def test_the_average_has_the_moments_of_draws_from_all_exponents():
    A, _, y = readings(np.random.default_rng(8), (1.0, 0.2), 2.0, count=25)
    parts = posteriors(*normal(A, y), GROUP, ORDER, exponents=(1.5, 2.0, 2.5))
    found = averaged(parts)
    assert found.weight.sum() == pytest.approx(1.0)
    assert found.weight.max() < 0.9
    assert np.diff(np.log(found.weight)) == pytest.approx(np.diff([each.evidence for each in parts]) / 2)
    rng, draws = np.random.default_rng(9), 40_000
    which = rng.choice(3, draws, p=found.weight)
    z = rng.normal(size=(draws, len(ORDER)))
    half = np.array([np.linalg.cholesky(each.covariance + each.of_sizes).T for each in parts])
    x = np.array([each.value for each in parts])[which] + np.einsum("dij,di->dj", half[which], z)
    u = np.sqrt(np.diag(found.covariance))
    assert x.mean(axis=0) == pytest.approx(found.value, abs=5 * u.max() / np.sqrt(draws))
    # a variance of draws from nearly normal distributions has the relative standard deviation sqrt(2 / draws)
    assert x.std(axis=0) == pytest.approx(u, rel=5 * np.sqrt(1 / (2 * draws)))
    expected = sum(
        w * each.size[1] ** 2 * 5.0 ** (-2 * each.exponent) for w, each in zip(found.weight, parts, strict=True)
    )
    assert found.variance([4, 5])[1, 1] == pytest.approx(expected)


def test_units_have_no_effect():
    A, _, y = readings(np.random.default_rng(4), (1.0, 0.2), 2.0)
    scale = np.where(GROUP == 1, 1e6, 1.0) * np.where(GROUP < 0, 1e-3, 1.0)
    one, other = (
        averaged(posteriors(*normal(A * s, y), GROUP, ORDER, exponents=EXPONENTS)) for s in (np.ones(len(ORDER)), scale)
    )
    assert other.value * scale == pytest.approx(one.value, rel=1e-9)
    assert other.parts[1].size * [1.0, 1e6] == pytest.approx(one.parts[1].size, rel=1e-9)


def test_an_undetermined_coefficient_keeps_its_prior():
    """The second axis has been measured at one position: its terms have no effect of their own."""
    A, _, y = readings(np.random.default_rng(5), (1.0, 0.2), 2.0)
    A = A.copy()
    A[:, GROUP == 1] = 0.0
    N, b = normal(A, y)
    [found] = posteriors(
        N, b, GROUP, ORDER, exponents=[2.0], kind=np.zeros(2, dtype=np.intp), pooled=1.0, passes=3000, tolerance=1e-9,
        regularisation=1e-13,
    )  # fmt: skip
    gone = GROUP == 1
    assert found.value[gone] == pytest.approx(0.0, abs=1e-12)
    assert found.determined[gone] == pytest.approx(0.0, abs=1e-6)
    expected = found.size[1] * ORDER[gone] ** -2.0
    assert np.sqrt(np.diag(found.covariance))[gone] == pytest.approx(expected, rel=1e-6)
    # without data, the size of a group becomes the typical one of its kind: that of the other group
    assert found.size[1] == pytest.approx(found.size[0], rel=1e-3)


def test_a_size_is_not_smaller_than_the_smallest():
    A, _, y = readings(np.random.default_rng(6), (0.0, 0.0), 2.0)
    N, b = normal(A, y)
    [found] = posteriors(N, b, GROUP, ORDER, exponents=[2.0], smallest=5.0, passes=1000)
    single = 1 / np.sqrt(np.diag(N))
    least = [5.0 * np.median(single[g == GROUP]) for g in range(2)]
    assert found.size == pytest.approx(least, rel=1e-9)


def test_eliminated_parameters_leave_the_estimate_of_the_others():
    rng = np.random.default_rng(7)
    A, y = rng.normal(size=(40, 8)), rng.normal(size=40)
    N, b, square = A.T @ A, A.T @ y, float(y @ y)
    N[6:, 6:] += np.eye(2)
    whole, C = np.linalg.solve(N, b), np.linalg.inv(N)
    n, right, rest, gain = eliminated(N, b, square, 2)
    assert np.linalg.solve(n, right) == pytest.approx(whole[:6], rel=1e-10)
    assert np.linalg.inv(n) == pytest.approx(C[:6, :6], rel=1e-10)
    assert rest - right @ whole[:6] == pytest.approx(square - b @ whole, rel=1e-10)
    # the effect of the parameters: what the covariance has less if they are exactly known
    effect = C[:6, :6] @ gain
    without = np.linalg.inv(N[:6, :6])
    assert effect.shape == (6, 2)
    assert C[:6, :6] - without == pytest.approx(without @ N[:6, 6:] @ C[6:, 6:] @ N[6:, :6] @ without, rel=1e-9)
    assert eliminated(N, b, square, 0)[3].shape == (8, 0)
