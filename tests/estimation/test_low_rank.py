"""Covariances with directions without independent variance, compared with dense pseudo-inverses."""

import numpy as np
import pytest

from errormotion.estimation.low_rank import root_of, whitener

N, D = 7, 3
SCALE = np.array([1e-6, 3e-6, 2e-5])


def covariance(own, influence):
    """Return the dense covariance and a root of it."""
    n, d = own.shape[:2]
    V = np.zeros((n * d, n * d))
    for i, block in enumerate(own):
        V[i * d : (i + 1) * d, i * d : (i + 1) * d] = block
    F = influence.reshape(len(influence), -1)
    return V + F.T @ F


def bound(rng, sources):
    """Return root and product of an own covariance, without variance at its first point, and sources."""
    A = rng.normal(0, 1, (N, D, D)) * SCALE[:, None]
    A[0] = 0.0
    A[2, :, 2] = A[2, :, 1]  # two directions of three
    return A, A @ np.swapaxes(A, 1, 2), rng.normal(0, 1, (sources, N, D)) * SCALE


def produced(rng, root, influence, count):
    """Return random vectors of a covariance."""
    noise = np.einsum("nij,pnj->pni", root, rng.normal(size=(count, N, D)))
    return noise + np.tensordot(rng.normal(size=(count, len(influence))), influence, axes=1)


@pytest.mark.parametrize("sources", [1, 3, 6])
def test_products_are_those_of_the_dense_pseudo_inverse(sources):
    rng = np.random.default_rng(1)
    root, own, F = bound(rng, sources)
    scale = np.tile(SCALE, N)
    V = covariance(own, F) / np.outer(scale, scale)
    rank = np.linalg.matrix_rank(V, tol=1e-10)
    white = whitener(own, F)
    assert white.degrees == rank
    a, b = produced(rng, root, F, 2), produced(rng, root, F, 2)
    dense = (a.reshape(2, -1) / scale) @ np.linalg.pinv(V, rcond=1e-10) @ (b.reshape(2, -1) / scale).T
    np.testing.assert_allclose(white.product(a, b), dense, rtol=1e-7)


def test_sources_alone_form_a_covariance():
    rng = np.random.default_rng(2)
    F = rng.normal(0, 1, (4, N, D)) * SCALE
    z = rng.normal(size=4)
    white = whitener(np.zeros((N, D, D)), F)
    assert white.degrees == 4
    assert white.square(np.tensordot(z, F, axes=1)) == pytest.approx(z @ z, rel=1e-9)


def test_a_direction_with_little_independent_variance_is_not_one_without_variance():
    own = np.tile(np.diag([1.0, 1e-9, 1.0]), (N, 1, 1)) * np.outer(SCALE, SCALE)
    rng = np.random.default_rng(3)
    F = rng.normal(0, 1, (2, N, D)) * SCALE
    V = covariance(own, F)
    x = rng.normal(size=(N, D)) * SCALE * [1, 3e-5, 1]
    white = whitener(own, F)
    assert white.degrees == N * D
    assert white.square(x) == pytest.approx(x.ravel() @ np.linalg.solve(V, x.ravel()), rel=1e-5)


def test_the_determinant_is_the_dense_one():
    rng = np.random.default_rng(4)
    A = rng.normal(0, 1, (N, D, D)) * SCALE[:, None]
    own, F = A @ np.swapaxes(A, 1, 2), rng.normal(0, 1, (2, N, D)) * SCALE
    assert whitener(own, F).log_determinant == pytest.approx(np.linalg.slogdet(covariance(own, F))[1], rel=1e-9)


def test_squares_of_differences_to_an_exact_reference_are_a_chi_square():
    rng = np.random.default_rng(5)
    root, own, F = bound(rng, 2)
    squares = [whitener(own, F).square(x) for x in produced(rng, root, F, 400)]
    degrees = whitener(own, F).degrees
    assert np.mean(squares) == pytest.approx(degrees, abs=4 * np.sqrt(2 * degrees / 400))


def test_with_variance_in_all_directions_products_are_those_of_the_inverse():
    rng = np.random.default_rng(1)
    A = rng.normal(0, 1, (N, D, D)) * SCALE[:, None]
    own, F = A @ np.swapaxes(A, 1, 2) + np.diag(SCALE**2 / 10), rng.normal(0, 1, (2, N, D)) * SCALE
    a, b = rng.normal(size=(2, 3, N, D)) * SCALE
    white = whitener(own, F)
    expected = a.reshape(3, -1) @ np.linalg.solve(covariance(own, F), b.reshape(3, -1).T)
    np.testing.assert_allclose(white.product(a, b), expected, rtol=1e-8)
    assert white.degrees == N * D


def test_a_value_that_is_exactly_zero_is_no_evidence():
    rng = np.random.default_rng(2)
    own, F = np.tile(np.diag(SCALE**2), (N, 1, 1)), rng.normal(0, 1, (2, N, D)) * SCALE
    own[0], F[:, 0] = 0.0, 0.0
    own[3, 2], own[3, :, 2], F[:, 3, 2] = np.nan, np.nan, np.nan
    assert whitener(own, F).degrees == N * D - D - 1


def test_a_direction_that_has_no_variance_at_any_point_is_left_out():
    """A change of one stated freedom has one direction at the common functional point, the same at all points."""
    rng = np.random.default_rng(7)
    direction = np.array([1.0, -2.0, 0.5]) * SCALE
    root = np.multiply.outer(rng.uniform(0.5, 2.0, N), direction)[..., None]
    F = np.multiply.outer(rng.normal(size=(2, N)), direction)
    white = whitener(root @ np.swapaxes(root, 1, 2), F)
    assert white.degrees == N
    a, z = rng.normal(size=N), rng.normal(size=2)
    values = a[:, None] * root[..., 0] + np.tensordot(z, F, axes=1)
    # in units of the direction the covariance is that of N scalars
    size, f = np.linalg.norm(root[..., 0] / SCALE, axis=1), F[..., 0] / direction[0] * np.linalg.norm(direction / SCALE)
    V = np.diag(size**2) + f.T @ f
    y = a * size + z @ f
    assert white.square(values) == pytest.approx(y @ np.linalg.solve(V, y), rel=1e-9)


@pytest.mark.parametrize("correlation", [0.0, 0.999, 1 - 1e-9, 1.0])
def test_a_factor_of_a_nearly_singular_block_is_that_of_its_eigenvectors(correlation):
    """From a Cholesky factor to eigenvectors to a direction without variance: one value, whatever the way."""
    block = np.array([[1.0, correlation, 0], [correlation, 1.0, 0], [0, 0, 1.0]]) * np.outer(SCALE, SCALE)
    own = np.tile(np.diag(SCALE**2), (N, 1, 1))
    own[3] = block
    along, across = np.array([1.0, 1, 0]) * SCALE, np.array([1.0, -1, 0]) * SCALE
    white = whitener(own, np.zeros((0, N, D)))
    assert white.degrees == N * D - (correlation == 1)
    value = np.zeros((N, D))
    value[3] = along
    assert white.square(value) == pytest.approx(2 / (1 + correlation), rel=1e-9)
    if correlation < 1:
        value[3] = across
        assert white.square(value) == pytest.approx(2 / (1 - correlation), rel=1e-6)
        expected = np.log(np.linalg.det(block / np.outer(SCALE, SCALE))) + 2 * N * np.log(SCALE).sum()
        assert white.log_determinant == pytest.approx(expected, rel=1e-9)


def test_the_root_of_a_covariance_has_as_many_columns_as_its_rank_whatever_the_units():
    rng = np.random.default_rng(5)
    A = rng.normal(size=(6, 3)) * np.array([1e-6, 1e-6, 1e-6, 5.0, 5.0, 0.0])[:, None]
    R = root_of(A @ A.T)
    assert R.shape == (6, 3)
    size = np.sqrt(np.maximum(np.diag(A @ A.T), 1e-300))
    np.testing.assert_allclose((R @ R.T) / np.outer(size, size), (A @ A.T) / np.outer(size, size), atol=1e-12)
    assert (R[5] == 0).all()
    assert root_of(np.zeros((3, 3))).shape == (3, 0)
