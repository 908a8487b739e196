"""A bench whose limits allow no motion, with every method: the campaign is an error when read, and nothing moves."""

import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from command_line import CliRunner

from errormotion import plugins
from errormotion.campaign import runner
from errormotion.campaign.files import load_campaign
from errormotion.campaign.planning import release
from errormotion.cli.app import app
from errormotion.cli.demo import probing
from errormotion.errors import BenchError, InstrumentError, RunError
from errormotion.measurement import ModelMethod
from errormotion.plugins import kind_registry
from errormotion.testing.checks.method import METHOD_CHECKS
from errormotion.testing.kit import run_check

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted(
    path
    for folder in ("virtual_*", "one_machine")
    for path in ROOT.glob(f"examples/{folder}/*.toml")
    if path.name != "bench.toml"
)
LIMITS = """
[limits]
X = ["0.4 mm", "1.4 mm"]
Y = ["0.4 mm", "1.4 mm"]
Z = ["0.4 mm", "1.4 mm"]
feed = "1 mm/min"
spindle_speed = "1 /min"
"""


def limited(bench: str) -> str:
    """Return the text of a bench whose limits allow no motion."""
    tables, kept = bench.split("\n["), []
    for table in tables:
        if not table.startswith("limits]"):
            kept.append(table)
    return "\n[".join(kept) + LIMITS


@pytest.fixture(params=[*EXAMPLES, probing.CAMPAIGN], ids=lambda path: f"{path.parent.name}-{path.stem}")
def campaign(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a campaign with a method of the project, on a bench whose limits allow no motion."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "campaign.toml"
    path.write_text(request.param.read_text())
    (tmp_path / "bench.toml").write_text(limited((request.param.parent / "bench.toml").read_text()))
    return path


def test_every_method_is_tried() -> None:
    found = [each for each in plugins.available("methods") if each.distribution.startswith("errormotion ")]
    ours = {each.id for each in found if getattr(each.cls, "acquire", None) is not ModelMethod.acquire}
    assert "r_test" not in ours  # it evaluates imported data only
    tried = {test.method.info.id for path in EXAMPLES for test in load_campaign(path).tests}
    assert tried == ours


def test_every_test_of_every_method_is_refused_when_it_is_read(campaign: Path) -> None:
    text = campaign.read_text()
    with pytest.raises(BenchError, match="limit") as refused:
        load_campaign(campaign)
    for number in range(text.count("[[test]]")):
        assert re.search(rf"test\[{number}\][:,]", str(refused.value))


@pytest.mark.parametrize("command", [["run"], ["run", "--dry-run"], ["program", "--out", "programs"], ["validate"]])
def test_no_command_accepts_it(campaign: Path, command: list[str]) -> None:
    name, *options = command
    result = CliRunner().invoke(app, [name, str(campaign), *options])
    assert result.exit_code not in (0, 70), result.output
    assert "limit" in result.output
    assert not (campaign.parent / "programs").exists()
    assert not (campaign.parent / "runs").exists()


# ---------------------------------------------------------------------- foreign methods and drivers

METHOD = """
import numpy as np
import xarray as xr
from errormotion.plugins import Method, MethodInfo, Needs, PluginSettings, Step

class Settings(PluginSettings):
    pass

class Wanderer(Method):
    info = MethodInfo("wanderer", "a method that moves the machine", "simulated_only")
    needs = Needs(("controller",), "errormotion.raw.wanderer/1")
    Settings = Settings
    def acquire(self, bench, settings, *, inputs, done=None):
        bench.of_kind("controller").move_to([0.1, 0.1, 0.1])
        yield xr.Dataset()
    def append_dim(self, settings): return "time"
    def progress(self, settings): return 1.0
    def identify(self, raw, settings): return raw
    def plan(self, settings): return xr.Dataset()
"""
PROGRAMS = "    def programs(self, settings, instruments): return {'a.nc': 'G1 X100 F100'}\n"
HONEST = "    def motions(self, settings, instruments): return [Step('move', (0.1, 0.1, 0.1), np.nan, np.nan)]\n"
WRONG = "    def motions(self, settings, instruments): return []\n"
DRIVER = """
from errormotion.plugins import Identity, InstrumentInfo, PluginSettings

class Mill:
    info = InstrumentInfo("mill", "controller", "a control without a door", "simulated_only")
    Settings = PluginSettings
    def __init__(self, address, settings=None, *, record=None): self.address, self.settings = address, settings
    def open(self): pass
    def close(self): pass
    def __enter__(self): return self
    def __exit__(self, *error): pass
    def identify(self): return Identity("-", "-", "-")
    def read(self): return {}
    def state(self): return {}
    def move_to(self, position, feed=None): raise AssertionError("it moves")
    def stop(self, *, spindle=False): pass
"""
BENCH = """
schema = "errormotion.bench/1"
name = "Bench"
machine = "C-frame"
[instruments.control]
driver = "virtual_controller"
arm = true
address = "sim://cframe/controller?seed=77"
"""
CAMPAIGN = """
schema = "errormotion.campaign/1"
name = "Campaign"
bench = "bench.toml"
[[test]]
name = "wander"
method = "wanderer"
"""
Write = Callable[..., Path]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Write]:
    """Return a function that installs foreign plugins, and writes a campaign with them."""

    def written(method: str = METHOD, bench: str = BENCH) -> Path:
        info = tmp_path / "foreign-1.2.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: foreign\nVersion: 1.2\n")
        points = "[errormotion.methods]\nwanderer = foreign_method:Wanderer\n"
        (info / "entry_points.txt").write_text(points + "[errormotion.instruments]\nmill = foreign_driver:Mill\n")
        (tmp_path / "foreign_method.py").write_text(method)
        (tmp_path / "foreign_driver.py").write_text(DRIVER)
        (tmp_path / "bench.toml").write_text(bench)
        (tmp_path / "campaign.toml").write_text(CAMPAIGN)
        monkeypatch.syspath_prepend(tmp_path)
        plugins.refresh()
        return tmp_path / "campaign.toml"

    monkeypatch.chdir(tmp_path)
    yield written
    monkeypatch.undo()
    for name in ("foreign_method", "foreign_driver"):
        sys.modules.pop(name, None)
    plugins.refresh()


def test_a_method_moves_to_its_stated_motions(write: Write, tmp_path: Path) -> None:
    with plugins.get("instruments", "virtual_controller")("sim://cframe/c?seed=77") as watching:
        with pytest.raises(RunError, match=r"yielded no data|dimension|time"):
            runner.run(load_campaign(write(METHOD + HONEST)), runs=tmp_path / "runs")
        assert watching.state()["position"] == pytest.approx([0.1, 0.1, 0.1])


def test_a_method_without_stated_motions_moves_nothing(write: Write, tmp_path: Path) -> None:
    path = write()
    with plugins.get("instruments", "virtual_controller")("sim://cframe/c?seed=77") as watching:
        before = watching.state()["position"]
        with pytest.raises(RunError, match=r"move to .*: refused, since the method 'wanderer' does not state its mot"):
            runner.run(load_campaign(path), runs=tmp_path / "runs")
        assert watching.state()["position"] == before
    result = CliRunner().invoke(app, ["run", str(path), "--dry-run"])
    assert result.exit_code not in (0, 70)
    assert "'wanderer' does not state its motions" in result.output


def test_a_method_that_states_that_nothing_moves_moves_nothing(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its test needs no release, so that nobody has allowed a motion."""
    path = write(METHOD + "    def motions(self, settings, instruments): return []\n")
    plan = load_campaign(path)
    monkeypatch.setattr(release, "is_simulated", lambda bench: False)
    assert release.to_release(plan, plan.tests) == []
    with plugins.get("instruments", "virtual_controller")("sim://cframe/c?seed=77") as watching:
        before = watching.state()["position"]
        with pytest.raises(RunError, match=r"move to .*: refused, since the method 'wanderer' states that nothing mov"):
            runner.run(plan, runs=tmp_path / "runs")
        assert watching.state()["position"] == before


def test_a_method_that_writes_programs_and_states_no_motions_is_refused_when_it_is_read(write: Write) -> None:
    path = write(METHOD + PROGRAMS)
    with pytest.raises(BenchError, match=r"'wanderer' does not state its motions.*it writes NC programs"):
        load_campaign(path)
    assert CliRunner().invoke(app, ["program", str(path)]).exit_code not in (0, 70)


def test_a_method_that_states_motions_beyond_the_limits_is_refused_when_it_is_read(write: Write) -> None:
    with pytest.raises(BenchError, match="X would move from 100 mm to 100 mm"):
        load_campaign(write(METHOD + HONEST, limited(BENCH)))


def test_a_motion_that_the_method_did_not_state_is_prevented(write: Write, tmp_path: Path) -> None:
    path = write(METHOD + WRONG, limited(BENCH))
    with plugins.get("instruments", "virtual_controller")("sim://cframe/c?seed=77") as watching:
        before = watching.state()["position"]
        with pytest.raises(RunError, match=r"X would move to 100 mm; the limits of the bench are 0.4 and 1.4 mm"):
            runner.run(load_campaign(path), runs=tmp_path / "runs")
        assert watching.state()["position"] == before


@pytest.mark.parametrize(
    "steps",
    [
        "[Step('move', (float('inf'), 0.0, 0.0), 0.1, 1.0)]",
        "[Step('move', (0.0, 0.0, 0.0), float('inf'), 1.0)]",
        "[Step('move', (0.0, 0.0, 0.0), -0.1, 1.0)]",
        "[Step('move', (np.nan, np.nan, np.nan), 0.1, 1.0)]",
        "[Step('rest', None, np.nan, 1.0, np.nan)]",
        "[(0.0, 0.0, 0.0)]",
    ],
)
def test_invalid_steps_are_an_error(write: Write, steps: str) -> None:
    stated = f"    def motions(self, settings, instruments): return {steps}\n"
    with pytest.raises(BenchError, match="motions of 'wanderer': expected steps with finite positions"):
        load_campaign(write(METHOD + stated))


def test_a_bench_without_arm_causes_no_motion(write: Write, tmp_path: Path) -> None:
    path = write(METHOD + HONEST, BENCH.replace("arm = true\n", ""))
    with pytest.raises(BenchError, match=r"it moves the machine, and 'control' only read, since arm = false; set arm"):
        runner.run(load_campaign(path), runs=tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


def test_a_driver_that_moves_without_limits_is_not_opened(write: Write, tmp_path: Path) -> None:
    bench = BENCH.replace("virtual_controller", "mill").replace("arm = true\n", "")
    with pytest.raises(BenchError, match="'mill' can move or change a machine and does not check limits"):
        runner.run(load_campaign(write(METHOD + HONEST, bench)), runs=tmp_path / "runs")


def test_the_conformance_kit_rejects_this_driver_and_this_method(write: Write) -> None:
    write()
    mill = plugins.get("instruments", "mill")("tcp://127.0.0.1:9")
    found = kind_registry.deviations(mill, kind_registry.kind("controller"))
    assert "it can change a machine: expected the setting 'arm' with the default false" in found
    assert "it can change a machine: expected bound(limits: MachineLimits)" in found
    check = next(each for each in METHOD_CHECKS if each.name == "motions_stated")
    subject = plugins.MethodSubject(plugins.get("methods", "wanderer"), make=lambda seed: (None, None), raw_vectors={})
    result = run_check(check, subject)
    assert not result.ok
    assert "'wanderer' uses a controller and does not state its motions" in result.message


def test_an_error_of_a_driver_is_an_error_of_the_instrument() -> None:
    driver = plugins.get("instruments", "virtual_controller")
    with driver("sim://cframe/c?seed=77", driver.Settings(arm=True)) as control:
        control.bound(plugins.MachineLimits(forbidden="a test says so"))
        with pytest.raises(InstrumentError, match="refused, since a test says so"):
            control.move_to([0.0, 0.0, 0.1])
