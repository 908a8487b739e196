"""The alternating scheme converges slowly to the optimum of the relative formulation."""

import numpy as np
import pytest

from errormotion.errors import MethodError
from errormotion.methods.multilateration.network.alternating import alternate
from errormotion.methods.multilateration.network.solver import solve

NEAR = np.array([[-0.15, -0.15, -0.1], [0.16, -0.13, 0.02], [0.0, 0.17, -0.05], [0.02, 0.01, 0.2]])


@pytest.fixture
def readings():
    """Return nominal targets, and displacements with 1 um of noise."""
    rng = np.random.default_rng(5)
    nominal = rng.uniform(-0.05, 0.05, (40, 3))
    d = np.linalg.norm(nominal + rng.normal(0, 10e-6, (40, 3)) - NEAR[:, None], axis=-1)
    return nominal, d + rng.normal(0, 1e-6, d.shape)


def test_converges_to_the_solution_with_exact_readings_of_the_first_target(readings):
    u, d = readings
    found = alternate(d, u, NEAR + 2e-3, tolerance=1e-12)
    noise = np.full(d.shape, 1e-6)
    noise[:, 0] = 1e-10
    relative = solve(d, u, noise=noise, robust=False)
    assert found.converged
    # What a geometric series has left, and what the last digits of the weights leave.
    assert np.abs(found.target - relative.target).max() < 2 * found.remaining + 1e-10
    assert found.iterations > 10 * relative.iterations


def test_differs_from_free_dead_paths_by_the_noise_of_the_first_target(readings):
    u, d = readings
    free = solve(d, u, noise=1e-6)
    found = alternate(d, u, NEAR + 2e-3, tolerance=1e-12)
    off = np.sqrt(np.mean((found.target - free.target) ** 2))
    assert 0.05e-6 < off < 1e-6


def test_a_small_step_is_not_convergence(readings):
    u, d = readings
    short, full = alternate(d, u, NEAR + 2e-3, tolerance=1e-8), alternate(d, u, NEAR + 2e-3, tolerance=1e-13)
    off = np.linalg.norm(short.target - full.target, axis=1).max()
    assert short.converged
    assert off > 5 * short.moved
    assert off == pytest.approx(short.remaining, rel=1.0)


def test_reports_the_limit_of_iterations(readings):
    u, d = readings
    found = alternate(d, u, NEAR + 2e-3, iterations=5)
    assert found.iterations == 5
    assert not found.converged


def test_requires_every_reading(readings):
    u, d = readings
    d[1, 3] = np.nan
    with pytest.raises(MethodError, match="Expected all displacements"):
        alternate(d, u, NEAR)
