"""Time on real and virtual machines."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from errormotion.instruments.controller.linuxcnc.driver import LinuxCNC
from errormotion.instruments.controller.virtual import VirtualController
from errormotion.plugins import virtual
from errormotion.plugins.virtual import is_virtual, wait


def test_a_real_machine_with_linuxcnc_is_no_virtual_one() -> None:
    """Its time cannot start again, although its driver can wait."""
    control = LinuxCNC("tcp://10.0.0.7:5007")
    for simulated in (False, True):
        control._transport = SimpleNamespace(simulated=simulated)  # type: ignore[assignment]
        assert is_virtual(control) is simulated
    assert is_virtual(VirtualController("tcp://10.0.0.7:5007"))
    assert not is_virtual(None)


def test_time_passes_on_the_clock_of_the_machine_or_of_this_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    passed: list[tuple[str, float]] = []
    monkeypatch.setattr(virtual.time, "sleep", lambda seconds: passed.append(("here", seconds)))
    wait(SimpleNamespace(elapse=lambda seconds: passed.append(("there", seconds))), 2.0)
    wait(SimpleNamespace(), 3.0)
    wait(None, 4.0)
    assert passed == [("there", 2.0), ("here", 3.0), ("here", 4.0)]
