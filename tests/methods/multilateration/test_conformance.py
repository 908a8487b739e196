"""The method passes the conformance kit with each of its subjects."""

from errormotion.methods.multilateration.conformance import subjects
from errormotion.testing import MethodConformance

SUBJECTS = subjects()


class TestMultilateration(MethodConformance):
    subject = SUBJECTS[0]
