"""The method passes the conformance kit with each of its subjects."""

from errormotion.methods.spindle_drift.conformance import subjects
from errormotion.testing import MethodConformance

SUBJECTS = subjects()


class TestSpindleDrift(MethodConformance):
    subject = SUBJECTS[0]


class TestSpindleDriftSecond(MethodConformance):
    subject = SUBJECTS[1]
