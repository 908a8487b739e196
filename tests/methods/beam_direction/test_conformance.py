"""The method passes the conformance kit with each of its subjects."""

import pytest

from errormotion.methods.beam_direction.conformance import subjects
from errormotion.testing import MethodConformance

SUBJECTS = subjects()


@pytest.mark.usefixtures("short_search")
class TestBeamDirection(MethodConformance):
    subject = SUBJECTS[0]
