"""A short closed loop: one warm-up, a model of two sensors, and one compensated warm-up, compared with the truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import Result

from errormotion.campaign.files import load_campaign
from errormotion.cli.demo import closed_loop, compensated, compensated_probing
from errormotion.cli.demo.closed_loop import Duty, Loop, close
from errormotion.compensation.online.settings import Limits
from errormotion.compensation.thermal_model import ThermalModelSettings
from errormotion.twin import VirtualMachine

SHORT = Duty(
    limits=Limits(period=10.0),
    model=ThermalModelSettings(variant="dynamics", sensors=("motor", "column_front"), time_constants=(600.0, 3600.0)),
)


@pytest.fixture(scope="module")
def loop() -> Loop:
    return close(VirtualMachine("cframe", seed=5), compensated.TRAINING, compensated.FURTHER[:1], SHORT)


def test_the_compensation_reduces_errors_outside_its_fit_by_four_fifths(loop: Loop) -> None:
    """Other speeds than those of the fit; at most 20 % of the errors may remain."""
    (warm_up,) = loop.warm_ups
    assert np.sqrt((warm_up.true_before**2).sum(axis=1).mean()) > 10e-6
    assert warm_up.remaining < 0.2
    reduction = warm_up.effect.part("displacement").reduction
    assert reduction.high - reduction.low < 0.1
    assert reduction.value == pytest.approx(1 - warm_up.remaining, abs=0.03)  # other instants, and the probe's noise


def test_the_offset_is_constant_during_probing_and_observes_its_slew_limit(loop: Loop) -> None:
    (warm_up,) = loop.warm_ups
    offsets, limits = warm_up.offsets, SHORT.limits
    changes = np.abs(np.diff(offsets.offset, axis=0)).max(axis=1)
    probing = np.array(offsets.cause[1:]) == "probing"
    assert (changes[probing] == 0).all()
    assert 0 < changes.max() <= limits.slew * limits.period * (1 + 1e-9)
    assert np.abs(offsets.offset).max() <= limits.limit


def test_the_demo_prints_the_effect_and_keeps_the_results(
    run: Callable[..., Result], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, loop: Loop
) -> None:
    monkeypatch.setattr(compensated, "close", lambda *_: loop)
    shown = run("demo", "--compensate").stdout
    assert "warm-ups with other speeds" in shown
    folder = tmp_path / shown.strip().splitlines()[-1].partition(": ")[2]
    assert sorted(path.name for path in folder.iterdir()) == ["after-2.nc", "before-2.nc", "effect-2.html", "model.nc"]
    plain = json.loads(run("demo", "--compensate", "--json").stdout)
    assert 0.8 < plain["warm_ups"][0]["true_reduction"] < 1
    assert "expected one of virtual" in run("demo", "--compensate", "--controller", "none", code=2).stderr


def test_a_sensor_with_noise_only_is_no_feature(loop: Loop) -> None:
    errors = loop.warm_ups[0].before
    kept = closed_loop.with_warm_sensors(errors)["sensor"].values.tolist()
    assert "motor" in kept
    assert "ambient" not in kept


def test_the_demo_with_linuxcnc_compensates_the_machine_that_it_probes() -> None:
    """One LinuxCNC runs on a computer: all addresses state the same one."""
    bench = load_campaign(compensated_probing.CAMPAIGN).bench
    assert bench.compensator is not None
    probing = {each.address for each in bench.instruments if "linuxcnc" in each.address}
    assert probing == {bench.compensator.address}
