"""The method passes the conformance kit with each of its subjects."""

import pytest

from errormotion.methods.linear_positioning.conformance import subjects
from errormotion.testing import MethodConformance
from errormotion.testing.kit import run_check
from errormotion.testing.run import checks_for

SUBJECTS = subjects()


class TestPositioning(MethodConformance):
    subject = SUBJECTS[0]
    test_figures = None  # none follows from the errors alone


class TestMovingAxis(MethodConformance):
    subject = SUBJECTS[2]
    test_figures = None  # none follows from the errors alone


class TestDiagonals(MethodConformance):
    subject = SUBJECTS[3]
    test_figures = None  # none follows from the errors alone


@pytest.mark.slow
class TestSixFreedoms(MethodConformance):
    subject = SUBJECTS[1]
    test_figures = None  # none follows from the errors alone


@pytest.mark.parametrize("subject", SUBJECTS, ids=lambda subject: subject.name)
def test_the_check_of_figures_that_follow_from_the_errors_alone_does_not_apply(subject):
    (check,) = (each for each in checks_for(subject) if each.name == "figures")
    assert run_check(check, subject).skipped
