"""The method passes the conformance kit."""

import pytest

from errormotion.methods.circular_test.conformance import subjects
from errormotion.testing import MethodConformance


@pytest.mark.slow
class TestCircularTest(MethodConformance):
    subject = subjects()[0]
