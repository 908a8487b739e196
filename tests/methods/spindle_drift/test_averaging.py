"""Means of a record: correct for every memory layout and any division into chunks."""

from itertools import pairwise

import numpy as np
import pytest
import xarray as xr
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from errormotion.datasets import hash_dataset
from errormotion.methods.spindle_drift import simulation
from errormotion.methods.spindle_drift.identification import averaging, record
from errormotion.methods.spindle_drift.identification.averaging import Averager, join, slices, window_sums
from errormotion.methods.spindle_drift.identification.times import EvenTimes, increases, values_of
from errormotion.methods.spindle_drift.settings import SpindleDriftSettings
from errormotion.twin import VirtualMachine


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("layout", ["channel first", "time first"])
@pytest.mark.parametrize("lost", [0.0, 0.02, 1.0])
@pytest.mark.parametrize("block", [64, 1 << 16])
def test_sums_are_those_of_numpy_in_both_layouts(dtype, layout, lost, block, monkeypatch):
    monkeypatch.setattr(averaging, "_BLOCK", block)
    rng = np.random.default_rng(0)
    values = rng.normal(1e-3, 1e-6, (5, 3001)).astype(dtype)
    values[rng.random(values.shape) < lost] = np.nan
    if layout == "time first":
        values = np.ascontiguousarray(values.T).T
    edges = np.array([0, 1, 1, 700, 1403, 3001])
    sums, counts = window_sums(values, edges)
    for k, (a, b) in enumerate(pairwise(edges)):
        part = values[:, a:b].astype(np.float64)
        np.testing.assert_allclose(sums[:, k], np.nansum(part, axis=1), rtol=1e-13)
        np.testing.assert_array_equal(counts[:, k], np.isfinite(part).sum(axis=1))


@settings(max_examples=40, deadline=None)
@given(st.lists(st.integers(1, 400), min_size=1, max_size=12), st.floats(0.05, 0.5))
def test_means_do_not_depend_on_the_pieces(pieces, length):
    total = sum(pieces)
    rng = np.random.default_rng(total)
    time = 3.0 + np.arange(total) / 1000.0
    values = rng.normal(size=(2, total))
    values[:, rng.random(total) < 0.1] = np.nan
    whole = Averager(2, length)
    expected = join([whole.update(time, values), whole.finish()])
    parts = Averager(2, length)
    edges = np.cumsum([0, *pieces])
    found = join([parts.update(time[a:b], values[:, a:b]) for a, b in pairwise(edges)] + [parts.finish()])
    np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(found.time, expected.time, rtol=1e-12)
    np.testing.assert_array_equal(found.count, expected.count)
    # All samples are in a window, but for a last one that is not half full.
    assert total - 500 * length - 1 <= expected.expected.sum() <= total


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.integers(1, 400), min_size=1, max_size=12),
    st.floats(0.05, 0.5),
    st.floats(-10.0, 1e5),
    st.sampled_from([100.0, 1000.0, 2048.0, 20e3]),
)
def test_even_times_give_the_means_of_the_same_times_one_by_one(pieces, length, start, rate):
    total = sum(pieces)
    edges = np.arange(total / (length * rate) + 2) * length * rate  # of the windows, samples
    assume(np.abs(edges % 1 - 0.5).min() > 1e-6)  # halfway between two samples, rounding decides
    rest = (total - np.ceil(edges - 0.5)) / (length * rate)
    assume(np.abs(rest - 0.5).min() > 1e-6)  # as it does on a last window that is exactly half full
    values = np.random.default_rng(total).normal(size=(2, total))
    even, single = Averager(2, length), Averager(2, length)
    found, expected = [], []
    for first, last in pairwise(np.cumsum([0, *pieces])):
        time = EvenTimes(start + first / rate, 1 / rate, int(last - first))
        found.append(even.update(time, values[:, first:last]))
        expected.append(single.update(values_of(time), values[:, first:last]))
    ours, theirs = join([*found, even.finish()]), join([*expected, single.finish()])
    np.testing.assert_array_equal(ours.count, theirs.count)
    np.testing.assert_array_equal(ours.mean, theirs.mean)
    np.testing.assert_allclose(ours.time, theirs.time, rtol=1e-14, atol=1e-12)


def test_times_that_do_not_increase_are_detected():
    assert increases(EvenTimes(0.0, 0.1, 5))
    assert increases(np.array([0.0, 0.1]))
    assert not increases(EvenTimes(0.0, 0.0, 5))
    assert not increases(np.array([0.0, 0.2, 0.2]))


def test_windows_follow_the_clock_and_not_the_samples():
    time = np.concatenate([np.arange(0, 1, 0.01), np.arange(5, 6, 0.01)])
    averager = Averager(1, 0.5)
    found = join([averager.update(time, time[None]), averager.finish()])
    np.testing.assert_allclose(found.time, [0.245, 0.745, 5.245, 5.745])
    np.testing.assert_allclose(found.mean[0], found.time)


def test_samples_farther_apart_than_a_window_are_not_changed():
    time = np.arange(0, 10, 0.5)
    values = np.sin(time)[None]
    found = Averager(1, 0.5).update(time, values)
    np.testing.assert_array_equal(found.mean, values)
    np.testing.assert_array_equal(found.time, time)


def test_a_mean_of_too_few_valid_samples_is_unknown_and_counted():
    time = np.arange(100) / 100.0
    values = np.ones((1, 100))
    values[0, :30] = np.nan
    averager = Averager(1, 0.5, minimum=0.5)
    found = join([averager.update(time, values), averager.finish()])
    assert np.isnan(found.mean[0, 0])
    assert found.mean[0, 1] == 1.0
    np.testing.assert_array_equal(found.count[0], [20, 50])


def test_slices_take_the_time_from_a_rate_where_there_is_no_variable():
    raw = xr.Dataset(
        {"distance": (("channel", "time"), np.zeros((5, 7)))}, attrs={"sample_rate": 10.0, "time_start": 2.0}
    )
    times = np.concatenate([values_of(time) for time, _ in slices(raw)])
    np.testing.assert_allclose(times, 2.0 + np.arange(7) / 10)


@pytest.mark.parametrize("dims", [("channel", "time"), ("time", "channel")])
@pytest.mark.parametrize("slice_bytes", [1 << 14, 1 << 17])
def test_a_record_is_averaged_the_same_in_any_slices_and_by_any_number_of_threads(dims, slice_bytes, monkeypatch):
    raw = simulation.raw_drift(VirtualMachine("cframe", seed=1), np.arange(0.0, 40.0, 0.002), seed=0)
    raw = raw.assign(distance=raw["distance"].transpose(*dims).copy())
    whole_hash = hash_dataset(raw)
    found = []
    for cores, size in ((1, 1 << 30), (3, slice_bytes)):
        monkeypatch.setattr(record, "cores", lambda cores=cores: cores)
        monkeypatch.setattr(averaging, "_SLICE_BYTES", size)
        found.append(record.average_record(raw, SpindleDriftSettings()))
        assert found[-1].hash == whole_hash
    for other in found[1:]:
        np.testing.assert_array_equal(other.averages.count, found[0].averages.count)
        # Means of 1 mm to 1e-13: sums of 250 numbers of double precision in another order.
        np.testing.assert_allclose(other.averages.mean, found[0].averages.mean, rtol=1e-13)
        np.testing.assert_allclose(other.averages.time, found[0].averages.time, rtol=1e-13)
        np.testing.assert_allclose(other.temperature, found[0].temperature, rtol=1e-13)
