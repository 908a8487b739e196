"""The factorised normal equations of the estimation."""

from __future__ import annotations

import numpy as np
import pytest

from errormotion.arrays import Array
from errormotion.estimation.linear.normal import factorised


def test_the_determinant_with_a_gauge_changes_as_that_of_any_choice_of_coordinates() -> None:
    """Unknowns of sizes from 1e-6 to 1e6, of which no reading sees one change: its rounding is no part of it."""
    rng = np.random.default_rng(2)
    size = 10.0 ** np.array([0, 6, -6, 3, -6, -3])
    gauge = (size * rng.standard_normal(6))[:, None]
    J = rng.standard_normal((40, 6)) / size
    unit = (gauge[:, 0] / size) / np.linalg.norm(gauge[:, 0] / size)
    J -= np.outer(J @ (size * unit), unit / size)  # J gauge = 0
    none = np.zeros((0, 1, 6))

    def determinants(weight: Array) -> tuple[float, float]:
        D = (J * weight[:, None]).T @ J
        free = factorised([np.zeros((0, 1, 1))], none, D, gauge).log_determinant
        scaled = D * size[:, None] * size
        return free, float(np.linalg.slogdet(scaled[1:, 1:])[1])

    (free, fixed), (other_free, other_fixed) = (determinants(rng.uniform(0.1, 10.0, 40)) for _ in range(2))
    assert free - other_free == pytest.approx(fixed - other_fixed, abs=1e-6)
    assert abs(fixed - other_fixed) > 0.1
