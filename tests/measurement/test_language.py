"""Notes that the measurement model writes have a German text."""

import numpy as np
import pytest

from errormotion.estimation.checks.exclusions import Cleaned, Exclusion, doubts, notes
from errormotion.estimation.variance import variance_factor
from errormotion.report.page.language import Catalogue

SCATTER = {
    "more, increased": variance_factor(400.0, 100, what="the touches"),
    "more, kept": variance_factor(400.0, 100, what="the touches", increase=False),
    "less": variance_factor(25.0, 100, what="the touches"),
    "unchecked": variance_factor(2.0, 2, what="the touches"),
    "unchecked, one": variance_factor(1.0, 1, what="the touches"),
    "no redundancy": variance_factor(0.0, 0, what="the touches"),
    "estimated": variance_factor(100.0, 50, stated=False, what="the touches"),
}


@pytest.mark.parametrize("scatter", SCATTER.values(), ids=SCATTER)
def test_notes_on_the_noise_are_in_the_german_catalogue(scatter):
    german = Catalogue("de", [{"touches": "Antastungen"}])
    assert "Antastungen" in german(scatter.note)
    assert not german.missing


@pytest.mark.parametrize("count", [0, 1, 3])
def test_notes_on_exclusions_are_in_the_german_catalogue(count):
    out = np.arange(10) < count
    one = Exclusion("touch A", 30.0, 1e-6, np.zeros(1), out)
    rival = Exclusion("touch A", 30.0, 1e-6, np.zeros(1), out, ("touch B", "touch C"))

    class Found(Cleaned):
        @property
        def excluded(self):
            return out

    found = Found(fit=None, made=(one,), undecided=(one, rival), unchecked=out)
    german = Catalogue("de", [{"touches": "Antastungen"}])
    texts = [*notes(found, "touches"), *doubts(found, "touches")]
    assert len(texts) == 3
    for text in texts:
        assert "Antastungen" in german(text)
    assert not german.missing
