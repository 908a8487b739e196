"""The method passes the conformance kit with each of its subjects."""

from errormotion.methods.beam_direction.conformance import subjects
from errormotion.testing import MethodConformance

SUBJECTS = subjects()


class TestBeamDirection(MethodConformance):
    subject = SUBJECTS[0]
