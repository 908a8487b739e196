"""The page on checking a plugin lists all checks with their requirements."""

from pathlib import Path

import pytest

from errormotion.testing.checks.compensator import COMPENSATOR_CHECKS
from errormotion.testing.checks.instrument import INSTRUMENT_CHECKS
from errormotion.testing.checks.method import METHOD_CHECKS

PAGE = (Path(__file__).parents[2] / "docs" / "how-to" / "check-a-plugin.md").read_text()

ALL = [*INSTRUMENT_CHECKS, *METHOD_CHECKS, *COMPENSATOR_CHECKS]


@pytest.mark.parametrize("check", ALL, ids=lambda check: f"{check.function.__module__.rpartition('.')[2]}-{check.name}")
def test_lists_the_check_with_its_requirement(check):
    assert f"| `{check.name}` | {check.claim.replace('``', '`')} |" in PAGE


def test_lists_no_other_check():
    assert PAGE.count("\n| `") == len(ALL)
