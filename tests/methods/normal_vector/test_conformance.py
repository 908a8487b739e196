"""The method passes the conformance kit with each of its subjects."""

from errormotion.methods.normal_vector.conformance import subjects
from errormotion.testing import MethodConformance

SUBJECTS = subjects()


class TestNormalVector(MethodConformance):
    subject = SUBJECTS[0]
