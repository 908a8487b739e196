"""A result as curves, and their reduction."""

import csv
import json
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from errormotion import datasets
from errormotion.dashboard.curves import Curve, CurveSet, as_csv, curves_of, thin
from errormotion.dashboard.figures import errors_item
from errormotion.dashboard.lab import Lab
from errormotion.errors import DatasetError


@given(st.lists(st.one_of(st.floats(-1e6, 1e6), st.just(float("nan"))), min_size=1, max_size=4000), st.integers(6, 300))
def test_reduction_keeps_ends_extremes_and_gaps(values: list[float], most: int) -> None:
    array = np.array(values)
    kept = thin(array, most)
    assert (np.diff(kept) > 0).all()
    assert (kept[0], kept[-1]) == (0, len(array) - 1)
    assert len(kept) <= max(most, 3 * (most // 3) + 2)
    if np.isfinite(array).any():
        assert np.nanmin(array[kept]) == np.nanmin(array)
        assert np.nanmax(array[kept]) == np.nanmax(array)
    assert np.isnan(array[kept]).any() == np.isnan(array).any()


def test_one_outlier_in_a_million_stays() -> None:
    values = np.zeros(10**6)
    values[654321] = 1.0
    assert 654321 in thin(values)


def test_the_curves_at_another_point_are_those_of_the_accessor(runs: object, key: str) -> None:
    ds = datasets.load(Lab(runs).file(key, "errors"))  # type: ignore[arg-type]
    point = (0.0, 0.0, -0.2)
    here, there = curves_of(ds), curves_of(ds, point)
    assert here.label == "time / min"
    assert {each.freedom: each.unit for each in here.curves}["EB"] == "arcsec"
    moved = ds.em.at(point)
    for curve in there.curves:
        size = 1e-6 if curve.unit == "µm" else np.pi / 648000
        np.testing.assert_allclose(curve.values * size, moved[curve.freedom].values, rtol=1e-12, atol=0)
        np.testing.assert_allclose(curve.expanded * size, moved.em.expanded().sel(dof=curve.freedom).values, rtol=1e-12)
    assert np.abs(there.curves[0].values - here.curves[0].values).max() > 1.0


def test_of_two_dimensions_one_index_is_shown(runs: object, key: str) -> None:
    ds = datasets.load(Lab(runs).file(key, "errors"))  # type: ignore[arg-type]
    both = ds.isel(time=slice(10)).expand_dims(speed=[1000.0, 2000.0], axis=1)
    both["covariance"] = both["covariance"].transpose("time", "speed", "dof", "dof_")
    both["EZ"] = both["EZ"].transpose("time", "speed") * [1.0, 3.0]
    first, second = curves_of(both), curves_of(both, select={"speed": 1})
    assert first.others == {"speed": 2}
    np.testing.assert_allclose(second.curves[2].values, 3 * first.curves[2].values)
    with pytest.raises(DatasetError, match="speed: expected an index from 0 to 1; found 2"):
        curves_of(both, select={"speed": 2})


def test_text_in_a_table_is_no_formula() -> None:
    curve = Curve("EX", "EX", "µm", np.array([1.0, np.nan]), np.array([0.1, np.nan]))
    found = CurveSet("target", np.arange(2.0), ("=1+1", 'a,"b'), (curve,), np.zeros(3), {})
    rows = list(csv.reader(as_csv(found).splitlines()))
    assert rows == [["target", "EX / µm", "U (k=2) of EX / µm"], ["'=1+1", "1", "0.1"], ['a,"b', "", ""]]


@pytest.mark.parametrize(("count", "dots"), [(1, True), (30, False)])
def test_a_curve_of_one_value_is_a_dot_and_rounding_errors_are_not_drawn(count: int, dots: bool) -> None:
    curve = Curve("EX", "EX", "µm", np.full(count, 1e-13), np.zeros(count))
    text = json.dumps(errors_item(CurveSet("time / min", np.arange(float(count)), (), (curve,), np.zeros(3), {})))
    assert ('"Scatter"' in text) is dots
    start, end = (float(re.findall(rf'"{name}": (-?[\d.e-]+)', text)[0]) for name in ("start", "end"))
    assert end - start == pytest.approx(0.1)
