"""The method passes the conformance kit, and its signs are right."""

import numpy as np
import pytest
from reference_touches import ReferenceTouches, ReferenceTouchesSettings

from errormotion.testing import MethodConformance


class TestReferenceTouches(MethodConformance):
    subject = ReferenceTouches.conformance()[0]


def test_a_machine_that_shows_less_at_the_reference_is_too_far() -> None:
    raw = ReferenceTouches().expected(ReferenceTouchesSettings())
    errors = ReferenceTouches().identify(raw)
    warm = 1 - np.exp(-7200 / 1800)
    for name, size in {"EX": 10e-6, "EY": -20e-6, "EZ": 30e-6}.items():
        assert float(errors[name][-1]) == pytest.approx(size * warm, abs=1e-10)


def test_a_stand_that_grows_is_no_drift() -> None:
    raw = ReferenceTouches().expected(ReferenceTouchesSettings())
    higher = raw.assign(touch=raw["touch"] + 0.0)
    higher["touch"][:, 2] += 1e-6 * 0.2 * (raw["temperature"] - 20.0)
    change = ReferenceTouches().identify(higher)["EZ"] - ReferenceTouches().identify(raw)["EZ"]
    stated = ReferenceTouches().identify(raw)
    effect = stated["influence"].values[stated["source_group"].values.tolist().index("expansion of the stand"), :, 2]
    assert change.values == pytest.approx(-effect, rel=1e-4, abs=1e-12)
