"""The effect of a compensation: intervals that contain the true reduction, and the page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from typer.testing import CliRunner

from errormotion import datasets, plugins
from errormotion.cli.app import app
from errormotion.compensation.effect import DISPLACEMENT, effect
from errormotion.compensation.effect.figures import K, reduction_of
from errormotion.compensation.effect.magnitude import Curve, magnitude, ratio
from errormotion.compensation.effect.text import verdict
from errormotion.errors import DatasetError
from errormotion.methods.normal_vector import simulation
from errormotion.twin import Event, VirtualMachine

pytestmark = pytest.mark.usefixtures("translated")

UM = 1e-6
TIMES = np.linspace(0.0, 7200.0, 13)
START = "2026-03-02T07:00:00+00:00"
LATER = "2026-03-05T06:30:00+00:00"


def warm_up(size: float, expansion: str = "", **changes: Any) -> xr.Dataset:
    """Return errors of an exponential warm-up, EZ of this size in um, measured with 0.2 um and a common expansion."""
    shape = 1 - np.exp(-TIMES / 1800.0)
    twist = np.zeros((len(TIMES), 6))
    twist[:, 2] = size * UM * shape
    twist[:, 4] = 20e-6 * shape
    own = np.broadcast_to(np.diag([0.2 * UM] * 3 + [1e-6] * 3) ** 2, (len(TIMES), 6, 6)).copy()
    influence = np.zeros((1, len(TIMES), 6))
    influence[0, :, 2] = 0.5 * UM * shape
    attrs: dict[str, Any] = {
        "component": "tool",
        "machine": "Mill 5",
        "frame": "machine",
        "functional_point": [0.0, 0.0, 0.1],
        "reference": "cold",
        "start": START,
    }
    attrs |= changes
    return datasets.build_errors(
        twist,
        own + np.einsum("sni,snj->nij", influence, influence),
        dims=("time",),
        coords={"time": ("time", TIMES, {"units": "s"})},
        influence=influence,
        sources=["expansion"],
        source_groups=["expansion"],
        source_ids={"expansion": expansion} if expansion else {},
        method="foreign",
        method_version="1",
        provenance={},
        **attrs,
    )


def test_intervals_contain_the_true_values_in_95_percent_of_all_measurements() -> None:
    """A displacement decreases to a tenth: white noise, two sources of each record, and a common one."""
    rng = np.random.default_rng(1)
    t = np.linspace(0.05, 1.0, 20)[:, None]
    b = 10 * (1 - np.exp(-3 * t)) * np.array([1.0, 0.5, -0.7])
    a = 0.1 * 10 * np.sin(5 * t) * np.array([1.0, -0.5, 0.3])
    nothing, drift = np.zeros_like(b), 0.3 * t * np.ones(3)
    F_b = np.array([0.05 * b, drift, nothing, drift])
    F_a = np.array([0.05 * a, drift, drift, nothing])
    own = np.broadcast_to(0.3**2 * np.eye(3), (20, 3, 3))
    true_ratio, true_rms = np.sqrt((a**2).sum() / (b**2).sum()), np.sqrt((a**2).sum() / 20)
    runs, held_ratio, held_rms = 100, 0, 0
    for _ in range(runs):
        z = rng.normal(size=4)
        first, second = (
            Curve.of(m + np.tensordot(z, F, 1) + 0.3 * rng.normal(size=m.shape), own, F)
            for m, F in ((b, F_b), (a, F_a))
        )
        found, size = ratio(second, first), magnitude(second)
        held_ratio += found.low <= true_ratio <= found.high
        held_rms += size.low <= true_rms <= size.high
    # of 100 draws with 95 %, fewer than 88 have a probability of 0.002
    assert min(held_ratio, held_rms) >= 88


def test_the_noise_of_a_measurement_is_no_residual() -> None:
    """The record after contains only noise: the estimate is near 0, and the interval contains 0."""
    rng = np.random.default_rng(2)
    own = np.broadcast_to(0.5**2 * np.eye(1), (400, 1, 1))
    none = np.zeros((0, 400, 1))
    before = Curve.of(10 + 0.5 * rng.normal(size=(400, 1)), own, none)
    after = Curve.of(0.5 * rng.normal(size=(400, 1)), own, none)
    found = ratio(after, before)
    assert found.low == 0.0
    assert found.value < 0.02 < np.sqrt(after.square / before.square)


def test_the_reduction_on_the_virtual_machine_covers_the_true_one() -> None:
    """The compensation of the control, off and on: EZ decreases, EY increases, and the tilt is unchanged."""
    machine, method = VirtualMachine("cframe", seed=3), plugins.get("methods", "normal_vector")
    results, truth = [], []
    for on in (False, True):
        machine.start([Event(130.0, 12000.0, dict.fromkeys("XYZ", on))])
        raw = simulation.raw(machine, np.arange(0.0, 7201.0, 900.0), seed=int(on))
        errors = method().identify(raw, method.Settings(tool_axes="Z"))
        results.append(errors)
        true = simulation.truth_of(machine, errors, 0.0)
        truth.append(np.stack([(true[name] - true[name][0]).values[1:] for name in ("EX", "EY", "EZ", "EA")]))
    found = effect(*results)
    for k, name in enumerate(("EX", "EY", "EZ", "EA")):
        part, square = found.part(name), [float((true[k] ** 2).sum()) for true in truth]
        assert part.reduction.low <= 1 - np.sqrt(square[1] / square[0]) <= part.reduction.high
    assert [found.part(name).outcome for name in ("EX", "EY", "EZ", "EA")] == [
        *("reduced", "larger", "reduced", "not shown"),
    ]
    assert "EY: larger with the compensation." in verdict(found)
    tilt = found.part("EA")
    assert tilt.perfect > 0.9 * tilt.before.value > 10 * tilt.floor
    assert 0 < found.part("EZ").reference < found.part("EZ").floor == found.part("EZ").perfect


def test_a_common_source_is_fully_correlated() -> None:
    """An expansion that scales both records equally cannot cause a change."""
    alone = effect(warm_up(30), warm_up(15, start=LATER)).part("EZ").reduction
    shared = effect(warm_up(30, expansion="bar 7"), warm_up(15, start=LATER, expansion="bar 7")).part("EZ").reduction
    assert shared.value == pytest.approx(0.5, abs=0.01) == pytest.approx(alone.value, abs=0.01)
    assert shared.high - shared.low < 0.8 * (alone.high - alone.low)


def test_a_result_may_state_references_without_identities() -> None:
    after = warm_up(15, start=LATER)
    states = {"source_reference": ("source", np.ones(after.sizes["source"], np.int8))}
    after = after.drop_vars("source_id", errors="ignore").assign_coords(states)
    assert effect(warm_up(30), after).part("EZ").reference > 0


def test_results_of_different_days_have_a_common_time_0() -> None:
    found = effect(warm_up(30), warm_up(3, start=LATER))
    assert found.common.estimates[1].value.shape == found.common.estimates[0].value.shape == (13, 6)
    assert found.part(DISPLACEMENT).reduction.value == pytest.approx(0.9, abs=0.01)
    assert found.part("EB").reduction.value == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize(("attribute", "value"), [("machine", "Mill 6"), ("frame", "workpiece"), ("component", "beam")])
def test_other_machines_and_frames_are_refused(attribute: str, value: str) -> None:
    with pytest.raises(DatasetError, match=attribute):
        effect(warm_up(30), warm_up(3, **{attribute: value}))


def test_the_interval_of_a_figure_is_that_of_the_ratio() -> None:
    """With an exact figure before, the ratio is a scaled value; an unknown correlation has the widest interval."""
    exact = reduction_of((10.0, 0.0), (-2.0, 0.1))
    assert exact == pytest.approx((0.8, 1 - (2 + K * 0.1) / 10, 1 - (2 - K * 0.1) / 10))
    widths = [
        high - low
        for c in (None, -0.3 * 0.5, 0.0, 0.3 * 0.5)
        for _, low, high in [reduction_of((10.0, 0.5), (2.0, 0.3), c)]
    ]
    assert widths[0] == pytest.approx(max(widths[1:]))
    assert reduction_of((10.0, 6.0), (1.0, 0.1)).low == -np.inf
    assert np.isnan(reduction_of((np.nan, 1.0), (1.0, 0.1)).value)


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    datasets.save(warm_up(30), "before.nc")
    datasets.save(warm_up(3, start=LATER), "after.nc")
    return tmp_path


def run(*arguments: str, code: int = 0) -> str:
    result = CliRunner().invoke(app, ["compensate", "effect", *arguments])
    assert result.exit_code == code, result.output
    return result.output


def test_the_command_prints_and_writes_the_effect(files: Path) -> None:
    shown = run("before.nc", "after.nc", "--freedoms", "EZ,EB", "--report", "page.html")
    assert shown.startswith("EZ: ")
    assert "90 % less" in shown
    assert "EB after 120.0 min" in shown
    assert "Errors before and after" in Path("page.html").read_text()
    assert "already exists" in run("before.nc", "after.nc", "--report", "page.html", code=1)
    plain = json.loads(run("before.nc", "after.nc", "--json"))
    part = next(each for each in plain["parts"] if each["name"] == "EZ")
    assert part["reduction"]["low"] < 0.9 < part["reduction"]["high"]
    assert [part["unit"], part["correctable"]] == ["m", True]


@pytest.mark.parametrize(
    ("limits", "code", "said"),
    [
        ('freedoms.EZ = "10 um"', 0, "After. Tolerances: conformity proved"),
        ('freedoms.EZ = "1 um"', 4, "After. Tolerances: nonconformity proved"),
        ('figures."reduction of EZ" = { lower = "0.8" }', 0, "Reduction. Tolerances: conformity proved"),
        ('figures."reduction of EZ" = { lower = "0.99" }', 4, "Reduction. Tolerances: nonconformity proved"),
        ('freedoms.EZ = "10 um"\nfigures."nothing" = "1 um"', 5, "the limit 'nothing' applies to no figure"),
    ],
)
def test_limits_decide_the_exit_code(files: Path, limits: str, code: int, said: str) -> None:
    Path("limits.toml").write_text(f'schema = "errormotion.tolerances/1"\n[tolerances]\n{limits}\n')
    assert said in run("before.nc", "after.nc", "--tolerances", "limits.toml", code=code)
