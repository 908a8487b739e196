"""The method passes the conformance kit with each of its subjects."""

from errormotion.methods.crossbeam_scan.conformance import subjects
from errormotion.testing import MethodConformance

SUBJECTS = subjects()


class TestCrossbeamScan(MethodConformance):
    subject = SUBJECTS[0]
    test_figures = None  # none follows from the errors alone


class TestCrossbeamScanSecond(MethodConformance):
    subject = SUBJECTS[1]


class TestCrossbeamScanThird(MethodConformance):
    subject = SUBJECTS[2]
    test_figures = None  # none follows from the errors alone
