"""A compensation in simulated time has the decisions of a real one: follow, hold while the machine is busy, ramp."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from errormotion.compensation.online.prediction import Prediction
from errormotion.compensation.online.rehearsal import rehearse
from errormotion.compensation.online.settings import Limits

LIMITS = Limits(limit="20 um", slew="1 um/s", period="1 s", hold="5 s", settle="2 s")


class OneMicrometrePerKelvin:
    """EX = 1 um/K; not trained above 10 K."""

    temperatures = ("spindle",)
    parameters = ()

    def update(self, time: float, temperature: Mapping[str, float], parameter: Mapping[str, float]) -> Prediction:
        del time, parameter
        value = temperature["spindle"]
        errors = np.zeros(6)
        errors[0] = 1e-6 * value
        return Prediction(errors, np.full(6, 1e-7), outside=("spindle",) if value > 10 else ())


def test_it_follows_holds_and_ramps() -> None:
    time = np.arange(60.0)
    kelvin = np.where(time < 30, 4.0, 12.0)
    busy = (time >= 10) & (time < 15)
    kelvin[10:15] = 2.0
    found = rehearse(OneMicrometrePerKelvin(), LIMITS, time, {"spindle": kelvin}, {}, busy)
    assert found.offset.shape == (60, 3)
    np.testing.assert_allclose(found.offset[:6, 0], [0, -1e-6, -2e-6, -3e-6, -4e-6, -4e-6], atol=1e-12)
    assert set(found.cause[10:15]) == {"probing"}
    np.testing.assert_allclose(found.offset[10:30, 0], -4e-6)
    assert found.state[30] == "holding"
    assert found.cause[30] == "outside the training range: spindle"
    assert found.state[36] == "ramping"
    np.testing.assert_array_equal(found.offset[-1], 0)
    assert found.fraction("following") == 25 / 60
