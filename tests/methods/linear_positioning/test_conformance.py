"""The method passes the conformance kit with each of its subjects."""

import pytest

from errormotion.methods.linear_positioning.conformance import subjects
from errormotion.testing import MethodConformance

SUBJECTS = subjects()


class TestPositioning(MethodConformance):
    subject = SUBJECTS[0]


class TestMovingAxis(MethodConformance):
    subject = SUBJECTS[2]


class TestDiagonals(MethodConformance):
    subject = SUBJECTS[3]


@pytest.mark.slow
class TestSixFreedoms(MethodConformance):
    subject = SUBJECTS[1]
