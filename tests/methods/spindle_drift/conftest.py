"""Beam detections by one of the two estimators, for simulations of many."""

import numpy as np
import pytest

from errormotion.methods.spindle_drift.identification import detection


@pytest.fixture
def without_paper(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the construction of the paper, a comparison without effect on the errors and their covariance."""
    unknown = np.full(3, np.nan)
    monkeypatch.setattr(detection, "circles_and_line", lambda *_: (unknown, unknown))
