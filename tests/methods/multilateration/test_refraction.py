"""Refraction after Ciddor: published values, derivatives, and impossible states of the air."""

import numpy as np
import pytest

from errormotion.errors import MethodError
from errormotion.methods.multilateration.refraction import (
    MODEL_UNCERTAINTY,
    QUANTITIES,
    index_uncertainty,
    refractive_index,
    sensitivities,
)

RED = 633e-9  # the wavelength of the published values, in vacuum


@pytest.mark.parametrize(
    ("temperature", "humidity", "published", "digits"),
    [
        (20.0, 0.5, 1.000271373, 9),
        (0.0, 0.5, 1.000291647, 9),
        (20.0, 0.0, 1.0002718, 7),  # published to seven digits
    ],
)
def test_published_values_agree_within_1e_8(temperature, humidity, published, digits):
    found = float(refractive_index(temperature, 101325.0, humidity, wavelength=RED))
    assert abs(found - published) < max(1e-8, 0.5 * 10**-digits)


def test_the_usual_rules_of_thumb_are_met():
    # 1 K is 1 um/m, 4 hPa is 1 um/m, humidity hardly matters.
    d = sensitivities(20.0, 101325.0, 0.5)
    assert d["temperature"] == pytest.approx(-0.95e-6, rel=0.03)
    assert d["pressure"] == pytest.approx(2.68e-9, rel=0.01)
    assert d["humidity"] == pytest.approx(-0.85e-6, rel=0.05)


def test_derivatives_are_those_of_the_index():
    at = [23.0, 98e3, 0.4, 420e-6, RED]
    found = sensitivities(*at)
    for k, (name, step) in enumerate(zip(QUANTITIES, (1e-2, 10.0, 1e-2, 1e-5, 1e-9), strict=True)):
        up, down = (list(at), list(at))
        up[k] += step
        down[k] -= step
        slope = (refractive_index(*up) - refractive_index(*down)) / (2 * step)
        # Central differences: rounding of n (1e-16 / step) and a third derivative that is small.
        assert found[name] == pytest.approx(float(slope), rel=1e-4)


def test_arrays_are_broadcast_and_nan_is_kept():
    n = refractive_index([[20.0], [np.nan]], [101325.0, 90e3, 80e3], 0.5)
    assert n.shape == (2, 3)
    assert np.isnan(n[1]).all()
    assert np.all(np.diff(n[0]) < 0)


def test_the_uncertainty_of_the_equations_is_always_included():
    found = index_uncertainty(sensitivities(20.0, 101325.0, 0.5), {"temperature": 0.1, "pressure": 0.0})
    assert set(found) == {"temperature", "equations"}
    assert float(found["equations"]) == MODEL_UNCERTAINTY
    assert abs(float(found["temperature"])) == pytest.approx(0.95e-7, rel=0.03)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ((293.15, 101325.0, 0.5), "temperature"),  # kelvin
        ((20.0, 1013.25, 0.5), "pressure"),  # hPa
        ((20.0, 101325.0, 50.0), "humidity"),  # per cent
    ],
)
def test_another_unit_is_reported(wrong, named):
    with pytest.raises(MethodError, match=f"expected {named} from .* found"):
        refractive_index(*wrong)
