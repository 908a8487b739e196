"""Numbers follow JCGM 100, 7.2.6."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from errormotion.report.text import DASH, fixed, integer, minutes, percent, rounded, significant


@pytest.mark.parametrize(
    ("value", "expanded", "text"),
    [
        (19.2963, 0.412, ("+19.30", "0.41")),
        (19.2963, 1.26, ("+19.3", "1.3")),
        (-19.2963, 12.6, ("−19", "13")),
        (1234.5, 126.0, ("+1230", "130")),
        (0.00042, 0.0996, ("0.00", "0.10")),
        (-0.0001, 0.05, ("0.000", "0.050")),
        (5.0, 0.995, ("+5.0", "1.0")),
        (48.6, math.nan, ("+48.60", DASH)),
        (48.6, 0.0, ("+48.60", DASH)),
        (math.nan, 0.1, (DASH, DASH)),
        (math.inf, 0.1, (DASH, DASH)),
    ],
)
def test_the_uncertainty_has_two_digits_and_the_value_ends_at_the_same_place(value, expanded, text):
    assert rounded(value, expanded) == text


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6))
def test_rounding_moves_a_value_by_at_most_a_twentieth_of_its_uncertainty(value, expanded):
    text, uncertainty = rounded(value, expanded)
    # Two digits: the last place is at most a tenth of the uncertainty, so half of it is a twentieth.
    assert abs(float(text.replace("−", "-")) - value) <= expanded / 20 * (1 + 1e-9)
    assert abs(float(uncertainty) - expanded) <= expanded / 20 * (1 + 1e-9)


def test_a_share_is_not_rounded_to_all_or_none():
    assert percent(1.0) == "100 %"
    assert percent(0.9999999) == "99.99 %"
    assert percent(1e-9) == "0.01 %"
    assert percent(0.0) == "0 %"
    assert percent(math.nan) == DASH


def test_numbers_have_a_typographic_minus_and_unknown_is_a_dash():
    assert fixed(-1.25, 1) == "−1.3"
    assert fixed(math.nan, 1) == DASH
    assert significant(0.01234) == "0.012"
    assert significant(181.0) == "180"
    assert integer(15000) == "15\u202f000"
    assert minutes(90) == "90.0 s"
    assert minutes(6240) == "104.0 min"
