"""The conformance kit writes offsets into the real LinuxCNC, on simulated joints."""

from collections.abc import Iterator

import pytest

from errormotion.instruments.simulators.controller import linuxcnc, linuxcnc_process
from errormotion.testing.kit import run_check
from errormotion.testing.run import checks_for, subjects_of

if reason := linuxcnc_process.why_not():
    pytest.skip(reason, allow_module_level=True)

pytestmark = pytest.mark.slow

WRITING = {"nothing_on_connecting", "arrives", "refused_orders", "heartbeat", "closed", "restart", "two_connections"}
WRITING |= {"states", "lost_connection", "faults", "mutants"}
OTHER_ROUTE = {"arrives", "closed", "restart", "states"}
"""The rest of the code is the same on both."""


@pytest.fixture(autouse=True)
def ended() -> Iterator[None]:
    yield
    linuxcnc.end()


@pytest.mark.parametrize(
    ("plugin_id", "names"),
    [("linuxcnc_feedback", WRITING), ("linuxcnc_offset", OTHER_ROUTE)],
    ids=["feedback", "offset"],
)
def test_the_kit_finds_nothing_wrong(plugin_id: str, names: set[str]) -> None:
    (subject,) = subjects_of("compensators", plugin_id)
    checks = [check for check in checks_for(subject) if check.name in names]
    assert {check.name for check in checks} == names
    for check in checks:
        result = run_check(check, subject)
        assert result.ok, f"{check.claim}\n{result.message}\n{result.trace}"
