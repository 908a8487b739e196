"""The method passes the conformance kit with each of its subjects."""

import pytest

from errormotion.methods.r_test.conformance import subjects
from errormotion.testing import MethodConformance

SUBJECTS = subjects()


class TestOneSphere(MethodConformance):
    subject = SUBJECTS[1]


@pytest.mark.slow
class TestThreeSpheres(MethodConformance):
    subject = SUBJECTS[0]
