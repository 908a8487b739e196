"""``[machine]`` of a bench file: read once, checked with the file, passed on to methods."""

from pathlib import Path

import numpy as np
import pytest

from errormotion import datasets, plugins
from errormotion.campaign.bench import OpenBench
from errormotion.campaign.files import load_bench, load_campaign
from errormotion.campaign.runner import run
from errormotion.errors import BenchError, InstrumentError
from errormotion.instruments import simulators
from errormotion.kinematics.description import MachineDescription

HEAD = 'schema = "errormotion.bench/1"\nname = "Lab"\n'
MACHINE = """\
[machine]
name = "Mill"
chain = "workpiece-C-X-Y-bed-Z-spindle-tool"
travel = { X = ["-300 mm", "300 mm"], Y = ["-250 mm", "250 mm"], Z = ["0 mm", "460 mm"] }
rotary.C = { position = ["0 mm", "0 mm", "-50 mm"], fixed = "90 deg" }
"""
COUNTER = '[instruments.counter]\ndriver = "counter"\naddress = "sim://counter"\n'

pytestmark = pytest.mark.usefixtures("lab")


def bench(folder: Path, text: str) -> Path:
    path = folder / "bench.toml"
    path.write_text(HEAD + text + COUNTER)
    return path


def mistakes(path: Path) -> list[str]:
    with pytest.raises(BenchError) as caught:
        load_bench(path)
    head, *found = str(caught.value).split("\n  - ")
    assert head.startswith(f"{path}: ")
    return found


def test_the_table_is_read_in_si(tmp_path: Path) -> None:
    plan = load_bench(bench(tmp_path, MACHINE))
    machine = plan.description
    assert plan.machine == machine.name == "Mill"
    assert machine.travel == {"X": (-0.3, 0.3), "Y": (-0.25, 0.25), "Z": (0.0, 0.46)}
    assert machine.spindle_axis == "Z"
    assert machine.positions == {"C": (0.0, 0.0, -0.05)}
    assert machine.fixed == {"C": pytest.approx(np.pi / 2)}
    assert OpenBench(plan).description is machine


def test_the_name_alone_suffices(tmp_path: Path) -> None:
    plan = load_bench(bench(tmp_path, 'machine = "Mill"\n'))
    assert plan.machine == "Mill"
    assert plan.description is None
    assert OpenBench(plan).description is None


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('"Mill"', "5", "machine.name: expected a string in quotes; found 5"),
        ("name = ", "nam = ", "machine.nam: unknown key; did you mean 'name'?"),
        ("-bed-", "-", "machine.chain: expected a chain from 'workpiece' over one 'bed' to 'tool'"),
        ("Y-bed", "X-bed", "machine.chain: expected every axis of 'workpiece-C-X-X-bed-Z-spindle-tool' once; found X"),
        ("C-X", "C-Q", "machine.chain: expected axes X, Y, Z, U, V, W, A, B, C"),
        ("Z-spindle", "Z-W-spindle", "machine.travel.W: missing; expected the lowest and the highest position of W"),
        (
            "{ X =",
            '{ W = ["0 mm", "1 mm"], X =',
            "machine.travel.W: the chain 'workpiece-C-X-Y-bed-Z-spindle-tool'",
        ),
        ("{ X =", '{ Q = ["0 mm", "1 mm"], X =', "machine.travel.Q: unknown key"),
        (
            '"-300 mm"',
            '"400 mm"',
            "machine.travel.X: expected the lowest position before the highest; found 0.4 m",
        ),
        ('"-300 mm"', "-300", "machine.travel.X[0]: expected a length with its unit, such as '5 mm'; found -300"),
        ('"-300 mm"', '"3 deg"', "machine.travel.X[0]: expected a length with its unit, such as '5 mm'; found '3 deg'"),
        ("rotary.C", "rotary.A", "machine.rotary.A: the chain 'workpiece-C-X-Y-bed-Z-spindle-tool' has no axis A"),
        (', fixed = "90 deg"', "", "machine.travel.C: missing"),
        ('position = ["0 mm", "0 mm", "-50 mm"], ', "", "machine.rotary.C.position: missing; expected a point on the"),
        (
            "travel =",
            'spindle_axis = "C"\ntravel =',
            "machine.spindle_axis: expected a linear direction, X, Y or Z",
        ),
    ],
)
def test_an_invalid_machine_is_reported_with_file_and_key(tmp_path: Path, old: str, new: str, text: str) -> None:
    assert old in MACHINE
    found = mistakes(bench(tmp_path, MACHINE.replace(old, new, 1)))
    assert any(each.startswith(text) for each in found), found


def test_mistakes_of_the_machine_are_reported_with_those_of_the_rest(tmp_path: Path) -> None:
    text = MACHINE.replace("C-X", "C-Q") + '[limits]\nfeed = 3\n[instruments.other]\ndriver = "countr"\n'
    keys = [each.split(":")[0] for each in mistakes(bench(tmp_path, text))]
    assert keys == ["machine.chain", "limits.feed", "instruments.other.driver"]


def test_limits_default_to_the_travel(tmp_path: Path) -> None:
    limits = load_bench(bench(tmp_path, MACHINE + '[limits]\nX = ["-100 mm", "300 mm"]\n')).limits
    assert (limits.X, limits.Y, limits.Z) == ((-0.1, 0.3), (-0.25, 0.25), (0.0, 0.46))
    assert limits.feed is None


def test_limits_outside_the_travel_are_an_error(tmp_path: Path) -> None:
    (found,) = mistakes(bench(tmp_path, MACHINE + '[limits]\nX = ["-301 mm", "300 mm"]\n'))
    assert found == (
        "limits.X: expected limits within the travel (machine.travel.X), -300 mm to 300 mm; found -301 mm to 300 mm"
    )
    two_axes = MACHINE.replace('Y = ["-250 mm", "250 mm"], ', "").replace("-Y", "")
    (found,) = mistakes(bench(tmp_path, two_axes + '[limits]\nY = ["0 mm", "1 mm"]\n'))
    assert found.startswith("limits.Y: the chain 'workpiece-C-X-bed-Z-spindle-tool' has no axis Y")


def test_settings_that_are_not_stated_follow_from_the_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def machine_defaults(_self: object, machine: MachineDescription, _settings: object) -> dict[str, float]:
        return {"level": machine.travel["Z"][1], "count": 7}

    monkeypatch.setattr(plugins.get("methods", "ramp"), "machine_defaults", machine_defaults, raising=False)
    path = tmp_path / "campaign.toml"
    path.write_text(
        'schema = "errormotion.campaign/1"\nname = "c"\nbench = "bench.toml"\n'
        '[[test]]\nname = "a"\nmethod = "ramp"\nsettings = { count = 1 }\n'
    )
    bench(tmp_path, MACHINE)
    settings = load_campaign(path).tests[0].settings
    assert (settings.level, settings.count) == (0.46, 1)
    bench(tmp_path, 'machine = "Mill"\n')
    assert load_campaign(path).tests[0].settings.level != 0.46


def test_raw_data_state_the_chain_of_the_axes_that_move(tmp_path: Path) -> None:
    path = tmp_path / "campaign.toml"
    path.write_text(
        f'schema = "errormotion.campaign/1"\nname = "c"\nbench = "bench.toml"\nruns = "{tmp_path.as_posix()}/runs"\n'
        '[[test]]\nname = "a"\nmethod = "ramp"\n'
    )
    bench(tmp_path, MACHINE)
    (folder,) = run(load_campaign(path))
    assert datasets.load(folder.raw).attrs["chain"] == "workpiece-X-Y-bed-Z-spindle-tool"


def test_settings_that_contradict_the_machine_are_refused_when_the_campaign_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def check_machine(_self: object, settings: object, machine: object) -> dict[str, str]:
        return {"level": f"expected less than the travel of Z of {machine.name}; found {settings.level} m"}

    monkeypatch.setattr(plugins.get("methods", "ramp"), "check_machine", check_machine, raising=False)
    path = tmp_path / "campaign.toml"
    path.write_text(
        'schema = "errormotion.campaign/1"\nname = "c"\nbench = "bench.toml"\n'
        '[[test]]\nname = "a"\nmethod = "ramp"\nsettings = { level = "25 mm" }\n'
    )
    source = bench(tmp_path, MACHINE)
    with pytest.raises(BenchError) as caught:
        load_campaign(path)
    assert str(caught.value).endswith(
        f"test[0].settings.level: expected less than the travel of Z of Mill; found 0.025 m ([machine] of {source})"
    )
    bench(tmp_path, 'machine = "Mill"\n')  # nothing is known of the machine: nothing contradicts it
    assert load_campaign(path).tests[0].settings.level == 0.025


CONTROL = (
    '[instruments.control]\ndriver = "virtual_controller"\narm = true\naddress = "sim://machine/controller?seed=5"\n'
)


def test_the_simulated_control_moves_the_machine_of_the_bench(tmp_path: Path) -> None:
    plan = load_bench(bench(tmp_path, MACHINE + CONTROL))
    with OpenBench(plan) as opened:
        here = simulators.world("machine", seed=5).machine
        assert here.description == plan.description
        assert here.geometry.machine.chain == "workpiece-C-X-Y-bed-Z-spindle-tool"
        control = opened.of_kind("controller")
        control.move_to([0.29, 0.0, 0.45])
        with pytest.raises(InstrumentError, match="X"):
            control.move_to([0.31, 0.0, 0.45])
    wider = load_bench(bench(tmp_path, MACHINE.replace('"300 mm"', '"400 mm"') + CONTROL))
    with OpenBench(wider) as opened:  # another machine, though the address is the same
        opened.of_kind("controller").move_to([0.31, 0.0, 0.45])


@pytest.mark.parametrize(
    ("machine", "text"),
    [
        ('machine = "Mill"\n', r"expected a table \[machine\] in the bench file; found none"),
        (
            MACHINE.replace(', fixed = "90 deg"', "").replace("travel = {", 'travel = { C = ["0 deg", "90 deg"],'),
            "X, Y, Z, C",
        ),
    ],
)
def test_a_machine_without_simulated_instruments_is_an_error(tmp_path: Path, machine: str, text: str) -> None:
    with pytest.raises(BenchError, match=text), OpenBench(load_bench(bench(tmp_path, machine + CONTROL))):
        pass
