"""The noise is normal, white, different in every channel, and a function of the sample counter only."""

import numpy as np
import pytest
from scipy import special, stats

from errormotion.twin import kernels

N = 1_000_000


@pytest.fixture(scope="module")
def numbers():
    return kernels.normals(kernels.stream_key(1, 0), 0, N)


@pytest.mark.parametrize("p", [1e-12, 1e-9, 1e-4, 0.02, 0.0749999, 0.0750001, 0.3, 0.5, 0.7, 0.93, 1 - 1e-9])
def test_quantile_is_the_normal_one(p):
    # a few rounding errors; 1 - p of a p near 1 is known to 1e-16 / (1 - p)
    assert kernels.normal_quantile(p) == pytest.approx(special.ndtri(p), rel=1e-14 + 1e-16 / (1 - p), abs=1e-15)


def test_far_tail_is_good_enough_for_any_53_bit_number():
    assert kernels.normal_quantile(2.0**-54) == pytest.approx(special.ndtri(2.0**-54), rel=1e-6)


def test_moments_are_those_of_a_standard_normal(numbers):
    # five standard errors each
    assert abs(numbers.mean()) < 5 / np.sqrt(N)
    assert abs(numbers.var() - 1) < 5 * np.sqrt(2 / N)
    assert abs(stats.skew(numbers)) < 5 * np.sqrt(6 / N)
    assert abs(stats.kurtosis(numbers)) < 5 * np.sqrt(24 / N)


def test_distribution_is_normal_in_centre_and_tails(numbers):
    assert stats.kstest(numbers, "norm").pvalue > 1e-3
    beyond = np.count_nonzero(np.abs(numbers) > 4)
    expected = N * 2 * special.ndtr(-4)
    assert abs(beyond - expected) < 5 * np.sqrt(expected)


@pytest.mark.parametrize("lag", [1, 2, 3, 64, 80, 1024, 20000])
def test_samples_are_uncorrelated(numbers, lag):
    assert abs(np.mean(numbers[lag:] * numbers[:-lag])) < 5 / np.sqrt(N)


@pytest.mark.parametrize("other", [(1, 1), (2, 0), (0, 1), (1, 0, 0)])
def test_channels_and_seeds_are_independent(numbers, other):
    foreign = kernels.normals(kernels.stream_key(*other), 0, N)
    assert abs(np.mean(numbers * foreign)) < 5 / np.sqrt(N)
    assert abs(np.mean(numbers**2 * foreign**2) - 1) < 5 * np.sqrt(8 / N)


def test_every_split_gives_the_same_numbers(numbers):
    key = kernels.stream_key(1, 0)
    parts = [kernels.normals(key, a, b - a) for a, b in ((0, 1), (1, 78), (78, 5000))]
    assert np.array_equal(np.concatenate(parts), numbers[:5000])


def test_numbers_continue_far_beyond_any_record():
    late = kernels.normals(kernels.stream_key(1, 0), 2**40, 10_000)
    assert abs(late.mean()) < 5 / 100
    assert abs(late.std() - 1) < 5 / np.sqrt(20_000)
