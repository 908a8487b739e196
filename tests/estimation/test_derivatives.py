"""Derivatives by the rows of tables: differences against analytic ones, and tables without columns."""

import numpy as np
import pytest

from errormotion.estimation.blocks import Table
from errormotion.estimation.derivatives import by_rows


def test_derivatives_are_those_of_the_equation():
    index = np.array([0, 1, 1])
    values = np.array([[0.3, 1.0], [-0.2, 2.0]])
    table = Table(index=index, scale=1.0)
    [J] = by_rows(lambda rows: np.sin(rows[0][:, 0]) * rows[0][:, 1] ** 2, [table], [values], [0])
    x = values[index]
    expected = np.column_stack([np.cos(x[:, 0]) * x[:, 1] ** 2, 2 * np.sin(x[:, 0]) * x[:, 1]])
    assert J.shape == (3, 1, 1, 2)
    # Differences over eps^(1/3) are exact to some 1e-10.
    assert J[:, 0, 0] == pytest.approx(expected, rel=1e-9)


def test_a_table_without_columns_has_no_derivatives():
    index = np.zeros(4, dtype=int)
    tables = [Table(index=np.arange(4), scale=1.0), Table(index=index, scale=1.0)]
    found = by_rows(lambda rows: 2 * rows[0], tables, [np.ones((4, 2)), np.zeros((1, 0))], [1, 0])
    assert found[0].shape == (4, 2, 1, 0)
    assert found[1][:, :, 0] == pytest.approx(np.tile(2 * np.eye(2), (4, 1, 1)))
