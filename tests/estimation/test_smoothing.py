"""Smooth curves through few points: against other ways of computing them, both ends of the evidence, and coverage."""

import numpy as np
import pytest
from coded import raises
from scipy.interpolate import make_smoothing_spline

from errormotion.estimation.smoothing import smooth, smooth_vectors

PLACES = 0.35 + 0.2 * np.arange(8)
SIGMA = np.array([20e-9, 70e-9, 20e-9, 1e-6, 0.3e-6, 1e-6])
#: components of different units, which correlate by half
COVARIANCE = np.outer(SIGMA, SIGMA) * (0.5 * np.eye(6) + 0.5)


def twists(rng):
    """Return noisy smooth curves of six components, nine times at the positions, (9, 8, 6)."""
    size = 20 * SIGMA * rng.normal(size=(9, 1, 6))
    curves = size * np.sin(2 * PLACES[:, None] + np.arange(6))
    return curves + rng.normal(size=(9, 8, 6)) @ np.linalg.cholesky(COVARIANCE).T


def wavy(n, sigma, seed=0):
    x = np.linspace(0.1, 1.1, n)
    return x, np.sin(6 * x) + sigma * np.random.default_rng(seed).normal(size=n)


def test_order_two_is_the_cubic_smoothing_spline_of_the_same_amplitude():
    x, y = wavy(30, 0.1)
    curve = smooth(x, y, np.full(30, 0.1**2), x, order=2, rougher=False)
    # Evidence on thirty points leaves a narrow range of amplitudes: their mean is that of the best within a few percent
    # of the band.
    spline = make_smoothing_spline(x, y, lam=0.1**2 / curve.amplitude**2)
    assert np.abs(curve.values - spline(x)).max() < 0.15 * np.sqrt(curve.variance).max()
    assert curve.order == 2


def test_curve_and_band_are_those_of_the_gaussian_process_averaged_over_its_evidence():
    x, y = wavy(9, 0.05)
    to = np.array([0.0, 0.33, 0.71, 1.2])
    variance = 0.05**2 * np.linspace(0.5, 2, 9)
    curve = smooth(x, y, variance, to, rougher=False)

    # The same by brute force: a wide prior instead of the free parabola, covariance of integrated noise by quadrature.
    s = (np.arange(4000) + 0.5) / 4000 * 1.2
    reach = lambda p: np.maximum(p[:, None] - s, 0.0) ** 2 / 2 * np.sqrt(1.2 / 4000)  # noqa: E731
    free = lambda p: 1e3 * p[:, None] ** np.arange(3)  # noqa: E731
    weight, mean, square = [], [], []
    # fine enough for the evidence, and between amplitudes that are out of the question
    for amplitude in np.geomspace(1, 1e5, 60):
        cover = lambda a, b, size=amplitude: free(a) @ free(b).T + size**2 * reach(a) @ reach(b).T  # noqa: E731
        S = cover(x, x) + np.diag(variance)
        weight.append(-0.5 * np.linalg.slogdet(S)[1] - 0.5 * y @ np.linalg.solve(S, y))
        mean.append(cover(to, x) @ np.linalg.solve(S, y))
        square.append(np.diag(cover(to, to) - cover(to, x) @ np.linalg.solve(S, cover(x, to))) + mean[-1] ** 2)
    share = np.exp(np.array(weight) - max(weight))
    share /= share.sum()
    values = share @ np.array(mean)
    sigma = np.sqrt(share @ np.array(square) - values**2)
    # a tenth of the band: the two cut the range of amplitudes at different ends
    np.testing.assert_allclose(curve.values, values, atol=0.1 * sigma.min())
    np.testing.assert_allclose(np.sqrt(curve.variance), sigma, rtol=0.1)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_polynomial_below_the_order_is_reproduced_with_amplitude_zero(order):
    polynomial = np.polynomial.Polynomial([1.0, -2.0, 3.0][:order])
    to = np.linspace(-0.2, 1.2, 7)
    curve = smooth(PLACES, polynomial(PLACES), np.full(8, 1e-6), to, order=order)
    np.testing.assert_allclose(curve.values, polynomial(to), atol=1e-9)
    assert curve.amplitude == 0
    assert curve.evidence == 0


def test_band_of_a_polynomial_is_at_least_that_of_its_least_squares_fit():
    curve = smooth(PLACES, np.zeros(8), np.full(8, 1e-12), PLACES)
    T = np.vander(PLACES, 3)
    fit = np.diag(T @ np.linalg.inv(T.T @ T) @ T.T) * 1e-12
    # rounding apart; and not much more, since nothing speaks for a bend
    assert (curve.variance > fit * (1 - 1e-9)).all()
    assert (curve.variance < 1.5 * 1e-12).all()


def test_curve_passes_through_points_of_tiny_noise():
    x, y = wavy(8, 0.0)
    for sigma in (1e-4, 1e-6):  # of a curve of size 1
        curve = smooth(x, y, np.full(8, sigma**2), x)
        assert np.abs(curve.values - y).max() < sigma
        np.testing.assert_allclose(np.sqrt(curve.variance), sigma, rtol=0.01)
        assert curve.evidence > 100
    curve = smooth(x, y, np.full(8, 1e-24), x)
    assert np.abs(curve.values - y).max() < 1e-12
    assert (np.sqrt(curve.variance) < 1e-6).all()  # rounding of what lies between the points, amplified by the root


def test_smoother_is_linear_and_propagates_shared_errors():
    x, y = wavy(8, 0.05)
    to = np.linspace(0, 1.2, 5)
    curve = smooth(x, y, np.full(8, 0.05**2), to)
    np.testing.assert_allclose(curve.weights @ y, curve.values, atol=1e-12)
    # An offset and a slope that all points share come through whole: they are polynomials.
    shared = np.stack([np.full(8, 3e-6), 1e-6 * x])
    np.testing.assert_allclose(curve.carry(shared), [np.full(5, 3e-6), 1e-6 * to], atol=1e-15)


def test_missing_points_are_excluded_and_counted():
    x, y = wavy(9, 0.05)
    variance = np.full(9, 0.05**2)
    to = np.linspace(0.1, 1.1, 4)
    holes = np.stack([y, y])
    holes[0, [2, 6]] = np.nan
    curve = smooth(x, holes, np.stack([variance, variance]), to)
    keep = np.delete(np.arange(9), [2, 6])
    alone = smooth(x[keep], y[keep], variance[keep], to, order=3)
    np.testing.assert_array_equal(curve.used, [7, 9])
    np.testing.assert_allclose(curve.values[0], alone.values, rtol=1e-6)
    np.testing.assert_allclose(curve.variance[0], alone.variance, rtol=1e-6)
    assert (curve.weights[0][:, [2, 6]] == 0).all()


@pytest.mark.parametrize(("points", "order"), [(2, 1), (3, 2), (4, 3), (8, 3)])
def test_few_points_make_curves_of_lower_order(points, order):
    x = PLACES[:points]
    curve = smooth(x, 1 + x**3, np.full(points, 1e-6), x)
    assert curve.order == order
    np.testing.assert_allclose(curve.values, 1 + x**3, atol=3e-3)  # 3 sigma of the points


def test_curve_without_evidence_is_unknown():
    for points in (0, 1):
        curve = smooth(PLACES[:points], np.ones(points), np.full(points, 1e-6), PLACES)
        assert np.isnan(curve.values).all()
        assert np.isnan(curve.variance).all()
        assert curve.used == points
    all_missing = smooth(PLACES, np.full(8, np.nan), np.full(8, np.nan), PLACES)
    assert np.isnan(all_missing.values).all()


def test_curve_with_three_points_uses_the_amplitude_of_the_others():
    rng = np.random.default_rng(1)
    y = np.sin(3 * PLACES) * np.array([[1.0], [0.9], [1.1]]) + 1e-3 * rng.normal(size=(3, 8))
    y[2, 3:] = np.nan
    variance = np.full((3, 8), 1e-6)
    apart, together = (smooth(PLACES, y, variance, PLACES, together=mode) for mode in (False, True))
    assert np.isnan(apart.values[2]).all()
    assert np.isfinite(together.values[2]).all()
    assert np.unique(together.amplitude).size == 1
    # 1.4 m beyond its last point a parabola is far off, and the band says so
    error = together.values[2] - 1.1 * np.sin(3 * PLACES)
    assert np.abs(error[-1]) > 0.1
    assert (np.abs(error) < 3 * np.sqrt(together.variance[2])).all()


def test_covariance_between_components_is_that_of_the_noise_through_the_weights():
    points = twists(np.random.default_rng(3))
    curves = smooth_vectors(PLACES, points, np.broadcast_to(COVARIANCE, (9, 8, 6, 6)), PLACES)
    assert np.linalg.eigvalsh(curves.covariance / np.outer(SIGMA, SIGMA)).min() > 0
    W = curves.components.weights[4]
    np.testing.assert_allclose(curves.covariance[4, 2, 0, 4], COVARIANCE[0, 4] * (W[0, 2] @ W[4, 2]), rtol=1e-9)
    assert curves.components.amplitude.shape == (9, 6)
    assert np.unique(curves.components.amplitude[:, 0]).size == 1


def test_unknown_component_affects_no_other():
    points = twists(np.random.default_rng(3))
    C = np.broadcast_to(COVARIANCE, (9, 8, 6, 6)).copy()
    points[..., 1] = np.nan
    C[..., 1, :] = C[..., :, 1] = np.nan
    curves = smooth_vectors(PLACES, points, C, PLACES)
    known = [0, 2, 3, 4, 5]
    assert np.isnan(curves.values[..., 1]).all()
    assert np.isnan(curves.covariance[..., 1, :]).all()
    assert np.isfinite(curves.values[..., known]).all()
    assert np.isfinite(curves.covariance[..., known, :][..., known]).all()


def test_wrong_inputs_are_refused():
    x = PLACES
    y, v = np.ones((2, 8)), np.full((2, 8), 1e-6)
    with raises("smoothing.shape"):
        smooth(x[:5], y, v, x)
    with raises("smoothing.variance.not_positive"):
        smooth(x, y, 0 * v, x)
    with raises("smoothing.order"):
        smooth(x, y, v, x, order=4)
    with raises("smoothing.position.not_finite"):
        smooth(np.where(x > 1, np.nan, x), y, v, x)
    with raises("smoothing.position.not_positive"):
        smooth(x - x[0], y, v, x, exact_zero=True)
    with raises("smoothing.shape"):
        smooth_vectors(x, y, v, x)
