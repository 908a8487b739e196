"""Every instrument of this distribution passes the kit."""

from dataclasses import replace

import pytest

from errormotion import plugins
from errormotion.testing.kit import run_check
from errormotion.testing.run import checks_for, subjects_of

ALONE = {"linuxcnc"}  # only one LinuxCNC can run on a computer: the tests of LinuxCNC include the kit
OURS = [plugin.id for plugin in plugins.available("instruments") if plugin.distribution.startswith("errormotion ")]
MUTANTS = 40  # tests/instruments/test_mutated_frames.py reads further ones, without a session for each
SUBJECTS = [
    replace(subject, mutants=min(subject.mutants, MUTANTS))
    for plugin_id in OURS
    if plugin_id not in ALONE
    for subject in subjects_of("instruments", plugin_id)
]
CASES = [
    pytest.param(subject, check, id="-".join(filter(None, [subject.plugin.info.id, subject.name, check.name])))
    for subject in SUBJECTS
    for check in checks_for(subject)
]


def test_the_optoncdt_is_among_them():
    assert "optoncdt" in OURS


@pytest.mark.slow
@pytest.mark.parametrize(("subject", "check"), CASES)
def test_passes(subject, check):
    result = run_check(check, subject)
    assert result.ok, f"{check.claim}\n{result.message}\n{result.trace}"
