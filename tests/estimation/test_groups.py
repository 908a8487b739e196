"""Readings in groups: nothing is lost or counted twice, and sums are those of all readings."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from errormotion.estimation.linear import groups as grouping
from errormotion.estimation.linear.groups import Groups, Layout, labels

INDEX = st.integers(1, 60).flatmap(lambda n: arrays(np.intp, (n, 3), elements=st.integers(0, 3)))


@given(INDEX, st.integers(0, 2))
def test_values_come_back_from_the_groups_as_they_were(index, m):
    groups = Groups.of(labels(index))
    values = np.arange(float(len(index) * m * 2)).reshape(len(index), m, 2)
    assert np.array_equal(groups.spread(groups.each(values), m), values)
    assert groups.each(values).sum() == values.sum()
    assert groups.member.size <= 3 * len(index)  # hardly more numbers than there are


@given(INDEX)
def test_a_group_sees_the_same_rows(index):
    label = labels(index)
    same = (index[:, None] == index[None]).all(axis=2)
    assert np.array_equal(label[:, None] == label[None], same)
    groups = Groups.of(label)
    for members in groups.member:
        known = members[members < len(index)]
        assert (label[known] == label[known[0]]).all()


def test_labels_of_many_columns_do_not_overflow():
    rng = np.random.default_rng(0)
    index = rng.integers(0, 2**40, (30, 12))[rng.integers(0, 30, 200)]
    label = labels(index)
    assert np.array_equal(label[:, None] == label[None], (index[:, None] == index[None]).all(axis=2))


@pytest.mark.parametrize("size", [1e7, 10])
def test_sums_of_products_are_those_of_the_readings(monkeypatch, size):
    """All groups at once, and a few at a time."""
    monkeypatch.setattr(grouping, "_SIZE", size)
    rng = np.random.default_rng(1)
    rows = rng.integers(0, 6, (50, 2)) ** 2 // 5
    a, b = rng.standard_normal((50, 3, 2)), rng.standard_normal((50, 3, 2))
    groups = Groups.of(labels(rows))
    layout = Layout(groups, lambda first: rows[first][:, :, None] * 6 + rows[first][:, None, :], 4)
    dense = np.zeros((6, 6))
    for at, product in zip(rows, np.swapaxes(a, 1, 2) @ b, strict=True):
        np.add.at(dense, (at[:, None], at[None]), product)
    for _ in range(2):  # the second time with the places that are known
        assert layout.summed(a, b, 36).reshape(6, 6) == pytest.approx(dense, rel=1e-12, abs=1e-12)
