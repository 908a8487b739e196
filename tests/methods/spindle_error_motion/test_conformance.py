"""The method passes the conformance kit with each of its subjects."""

import pytest

from errormotion.methods.spindle_error_motion.conformance import subjects
from errormotion.testing import MethodConformance

SUBJECTS = subjects()


@pytest.mark.slow
class TestFiveSensors(MethodConformance):
    subject = SUBJECTS[0]
    test_figures = None  # none follows from the errors alone


@pytest.mark.slow
class TestHorizontalSpindle(MethodConformance):
    subject = SUBJECTS[1]
    test_figures = None  # none follows from the errors alone
