"""The method passes the conformance kit with each of its subjects."""

from contextlib import nullcontext

import pytest

from errormotion.methods.crossbeam_scan.conformance import subjects
from errormotion.testing import MethodConformance

SUBJECTS = subjects()


class TestCrossbeamScan(MethodConformance):
    subject = SUBJECTS[0]

    @pytest.fixture(autouse=True)
    def _remembering(self, request, remembering):
        """Register the scans once for all trials that draw the lever only."""
        with remembering() if request.node.name == "test_sources_as_stated" else nullcontext():
            yield


class TestCrossbeamScanSecond(MethodConformance):
    subject = SUBJECTS[1]
