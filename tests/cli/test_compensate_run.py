"""``errormotion compensate run``: shadow without ``--arm``, offsets with it, zero at the end."""

import json
import os
import signal
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from command_line import CliRunner
from forked_commands import Commands

from errormotion.campaign.compensation.compensating import Compensation
from errormotion.campaign.files import load_bench
from errormotion.cli.app import app
from errormotion.compensation.online.follower import State
from errormotion.compensation.thermal_model import ThermalModel
from errormotion.compensation.thermal_model.features import Feature
from errormotion.compensation.thermal_model.model import Parts
from errormotion.datasets import load

MACHINE = "Mill 5"
BENCH = f"""
schema = "errormotion.bench/1"
name = "Shop"
machine = "{MACHINE}"
[instruments.thermometer]
driver = "dcon_temperature"
address = "sim://cframe/thermometer?seed=3"
[compensator]
driver = "offset_file"
address = "offset.json"
[compensator.limits]
period = "0.1 s"
slew = "20 um/s"
"""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a bench and a model that predicts 6 um at each temperature."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    Path("bench.toml").write_text(BENCH, encoding="utf-8")
    from errormotion.campaign.monitor.watch import Monitor

    sensor = Monitor(load_bench("bench.toml"), Path("runs")).sensors[0]
    coefficient = np.zeros((6, 1))
    coefficient[0] = 1e-3
    parts = Parts(
        (Feature(sensor),),
        coefficient,
        np.zeros((6, 1, 1)),
        np.full(6, 1e-7),
        np.ones(6),
        np.ones(6),
        np.array([-50.0]),
        np.array([50.0]),
    )
    attrs = {"component": "spindle", "frame": "machine", "machine": MACHINE, "reference": "start"}
    ThermalModel.of(parts, {**attrs, "functional_point": [0.0, 0.0, 0.0], "variant": "lagged"}, {}).save("model.nc")
    return tmp_path


def command(*more: str) -> list[str]:
    return ["compensate", "run", "bench.toml", "--model", "model.nc", *more]


def test_without_arm_it_computes_and_writes_nothing(place: Path) -> None:
    result = CliRunner().invoke(app, command("--duration", "0.5 s"))
    assert result.exit_code == 0, result.output
    assert "nothing is written" in result.output
    assert not (place / "offset.json").exists()
    assert len(list((place / "runs").glob("*/audit.jsonl"))) == 1


def test_armed_it_writes_and_ends_with_zero(place: Path) -> None:
    result = CliRunner().invoke(app, command("--arm", MACHINE, "--duration", "1 s", "--json"))
    assert result.exit_code == 0, result.output
    rows = [json.loads(line) for line in result.stdout.splitlines()]
    assert rows[-1]["state"] == "off"
    written = json.loads((place / "offset.json").read_text())
    assert [written[axis] for axis in "XYZ"] == [0.0, 0.0, 0.0]
    assert written["number"] >= len(rows) - 1


def test_the_name_of_the_machine_must_be_right(place: Path) -> None:
    result = CliRunner().invoke(app, command("--arm", "Mill 6"))
    assert result.exit_code == 1
    assert "the machine of bench.toml is 'Mill 5'. Nothing was written." in result.output


@pytest.fixture(scope="module")
def commands() -> Iterator[Commands]:
    with Commands() as commands:
        yield commands


@pytest.mark.slow
@pytest.mark.parametrize("signals", [1, 2], ids=["once", "twice"])
def test_ctrl_c_ramps_to_zero_a_second_one_ends_at_once(commands: Commands, place: Path, signals: int) -> None:
    text = BENCH.replace('slew = "20 um/s"', f'slew = "{20 if signals == 1 else 0.01} um/s"')
    (place / "bench.toml").write_text(text, encoding="utf-8")
    environment = {"XDG_STATE_HOME": os.environ["XDG_STATE_HOME"]}
    process = commands.start(*command("--arm", MACHINE, "--json"), cwd=place, environment=environment)
    with closing(process):
        following = (json.loads(line) for line in process.stdout)
        least = 1e-6 if signals == 1 else 10e-9  # ten periods to ramp to zero
        assert any(row["state"] == "following" and max(map(abs, row["offset"])) > least for row in following)
        process.send_signal(signal.SIGINT)
        if signals == 2:
            assert any(row["state"] == "ramping" for row in following)
            process.send_signal(signal.SIGINT)
        rest = [row["state"] for row in following]
        _, complaints = process.communicate(timeout=100)
    assert process.returncode == 0, complaints
    assert (rest[-1:] == ["off"]) == (signals == 1)


def test_another_command_shows_it_and_ramps_it_to_zero(place: Path) -> None:
    def call(*arguments: str, code: int = 0) -> str:
        result = CliRunner().invoke(app, ["compensate", *arguments])
        assert result.exit_code == code, result.output
        return result.output

    with Compensation(load_bench("bench.toml"), load("model.nc"), Path("runs"), arm=MACHINE) as compensation:
        folder = compensation.folder.path
        moments = compensation.follow()
        assert any(moment.step.state is State.FOLLOWING and moment.step.offset.any() for moment in moments)
        (found,) = json.loads(call("status", "--json"))["compensations"]
        assert (found["working"], found["status"]["state"], found["status"]["armed"]) == (True, "following", True)
        call("stop", str(folder))
        rest = list(moments)
    assert rest[-1].step.state is State.OFF
    assert rest[-1].applied == (0.0, 0.0, 0.0)
    assert json.loads((place / "offset.json").read_text())["X"] == 0.0
    assert "ended: off" in call("status")
    assert "nothing to stop" in call("stop", str(folder), code=1)
    lines = (folder / "audit.jsonl").read_text().splitlines(keepends=True)
    (folder / "audit.jsonl").write_text("".join(lines[:1] + lines[2:]))
    assert "line 2 does not follow" in call("status", str(folder), code=1)
