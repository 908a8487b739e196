"""Every compensator of this distribution passes the kit."""

import pytest

from errormotion import plugins
from errormotion.testing.kit import run_check
from errormotion.testing.run import checks_for, subjects_of

ALONE = {"linuxcnc"}  # only one LinuxCNC can run on a computer: the tests of LinuxCNC include these checks
OURS = [plugin.id for plugin in plugins.available("compensators") if plugin.distribution.startswith("errormotion ")]
SUBJECTS = [
    subject
    for plugin_id in OURS
    if plugin_id.split("_")[0] not in ALONE
    for subject in subjects_of("compensators", plugin_id)
]
CASES = [
    pytest.param(subject, check, id="-".join(filter(None, [subject.plugin.info.id, subject.name, check.name])))
    for subject in SUBJECTS
    for check in checks_for(subject)
]


def test_the_offset_file_is_among_them() -> None:
    assert "offset_file" in OURS


@pytest.mark.parametrize(("subject", "check"), CASES)
def test_passes(subject, check) -> None:
    result = run_check(check, subject)
    assert result.ok, f"{check.claim}\n{result.message}\n{result.trace}"
