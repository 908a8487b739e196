"""``errormotion init``: bench and campaign from options and from answers, checked by the code that reads them."""

from collections.abc import Callable
from pathlib import Path

import pytest
from coded import raises
from command_line import Result

from errormotion import plugins
from errormotion.campaign.files import load_bench, load_campaign
from errormotion.cli.commands.campaigns.init import command
from errormotion.datasets.files.tomlfile import parse_toml
from errormotion.datasets.files.tomltext import key, value
from errormotion.methods.linear_positioning.planning.targets import reach

Run = Callable[..., Result]
CHAIN = "workpiece-X-Y-bed-Z-spindle-tool"
TRAVEL = ("--chain", CHAIN, "--travel", "X=-300mm,300mm", "--travel", "Y=-200 mm, 200 mm", "--travel", "Z=0 mm,400 mm")
FRAME = ("--instrument", "frame=five_sensor_frame@sim://cframe?seed=3")


def test_a_bench_and_a_campaign_are_written_by_options_alone(run: Run, tmp_path: Path) -> None:
    options = (
        "--machine",
        'VM "1"',
        *TRAVEL,
        *FRAME,
        "--test",
        "a=spindle_drift",
    )
    said = run("init", "new", *options, "--set", "a.duration=2 min", "--set", "frame.levels=['10 mm', '50 mm']").stdout
    campaign = load_campaign(tmp_path / "new" / "campaign.toml")
    assert (campaign.bench.machine, campaign.bench.instruments[0].address) == ('VM "1"', "sim://cframe?seed=3")
    assert (campaign.tests[0].name, campaign.tests[0].settings.duration) == ("a", 120.0)
    assert "errormotion bench probe new/bench.toml" in said
    before = (tmp_path / "new" / "bench.toml").read_bytes()
    assert "already exists" in run("init", "new", *options, code=1).stderr
    assert (tmp_path / "new" / "bench.toml").read_bytes() == before
    run("init", "new", "--machine", "Other", *FRAME, "--force")
    assert load_bench(tmp_path / "new" / "bench.toml").machine == "Other"


def test_mistakes_are_those_of_the_files_and_nothing_is_written(run: Run, tmp_path: Path) -> None:
    stated = ("--machine", "M", *FRAME, "--test", "a=spindle_drift", "--set", "a.duration=2 mins.")
    said = run("init", "new", *stated, code=1).stderr
    assert "new/campaign.toml: 1 mistake\n  - test[0].settings.duration: expected a time" in said
    assert said.rstrip().endswith("Nothing was written.")
    assert "Did you mean 'spindle_drift'" in run("init", *FRAME, "--test", "a=spindle_drft", code=1).stderr
    assert "name of an instrument or a test (frame)" in run("init", *FRAME, "--set", "b.c=1", code=1).stderr
    assert "no terminal for questions" in run("init", "new", code=2).stderr
    assert not list(tmp_path.glob("*.toml"))
    assert not (tmp_path / "new").exists()


def test_a_test_is_that_of_the_machine_of_any_travel(run: Run, tmp_path: Path) -> None:
    controller = (
        "--instrument",
        "control=virtual_controller@sim://cframe",
        "--instrument",
        "laser=attocube_ids@sim://cframe",
    )
    for low, high in ((-300, 300), (0, 500), (100, 1900)):
        travel = ("--chain", "workpiece-X-bed-spindle-tool", "--travel", f"X={low} mm,{high} mm")
        said = run("init", f"at{low}", "--machine", "M", *travel, *controller, "--test", "a=linear_positioning").stdout
        assert "Test a: from the machine travel" in said
        settings = load_campaign(tmp_path / f"at{low}" / "campaign.toml").tests[0].settings
        span = low * 1e-3, high * 1e-3
        assert span[0] <= reach(settings)[0]
        assert reach(settings)[1] <= span[1]
        assert settings.travel == pytest.approx(span, abs=0.01)


def test_answers_with_a_mistake_are_written_and_named(tmp_path: Path) -> None:
    given = iter([CHAIN, "-300 mm, 300 mm", "-200 mm, 200 mm", "0 mm, 400 mm", "a", "duration"])
    with raises("toml.mistakes") as caught:
        command.init(
            tmp_path, "M", "", [], ["frame=five_sensor_frame@sim://cframe"], ["a=spindle_drift"],
            ["a.duration=2 mins."], force=False, as_json=False, ask=lambda question, default: next(given),
        )  # fmt: skip
    assert "test[0].settings.duration: expected a time" in str(caught.value)
    assert "were written nevertheless" in str(caught.value)
    assert load_bench(tmp_path / "bench.toml").machine == "M"
    assert "2 mins." in (tmp_path / "campaign.toml").read_text()


def test_interactive_questions_write_the_same_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drivers = [(cls.info.id, cls.info.kind) for cls in plugins.loaded("instruments")]
    number = 1 + [each for each, _ in sorted(drivers, key=lambda one: (one[1], one[0]))].index("five_sensor_frame")
    given = iter([
        "VM 1", "X-X", CHAIN, "300 mm, -300 mm", "-300 mm, 300 mm", "-200 mm, 200 mm", "0 mm, 400 mm",
        "five_sensor_frme", str(number), "no name", "frame", "sim://cframe?seed=3", "",
        "normal_vector", "spindle_drift", "", "",
    ])  # fmt: skip
    command.init(
        tmp_path, "", "", [], [], [], [], force=False, as_json=False, ask=lambda question, default: next(given)
    )
    assert next(given, None) is None
    plan = load_campaign(tmp_path / "campaign.toml")
    assert plan.bench.description is not None
    assert [test.name for test in plan.tests] == ["spindle_drift"]
    said = capsys.readouterr().out
    wrongs = ["expected a chain", "the lowest position first", "did you mean 'five_sensor_frame'", "found 'no name'"]
    for wrong in (*wrongs, "'normal_vector' is not known"):
        assert wrong in said


@pytest.mark.parametrize(
    "content",
    [
        "plain",
        'a "quote" \\ and \x7f \n line',
        "ünïcode 𝄞",
        True,
        3,
        2.5,
        ["1 mm", "2 mm"],
        {"a b": [1], "c": {"d": False}},
    ],
)
def test_values_come_back_from_toml(content: object) -> None:
    assert parse_toml(f"{key('a b')} = {value(content)}", "x")["a b"] == content
