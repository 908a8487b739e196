"""What prevents a campaign and is known from its files is stated before an instrument is opened or a folder created."""

import re
import shutil
from collections.abc import Callable, Iterator
from datetime import date, timedelta
from pathlib import Path
from typing import Any

import pytest
import real_bench
from coded import raises
from command_line import CliRunner

from errormotion import plugins
from errormotion.campaign import runner
from errormotion.campaign.background import processes
from errormotion.campaign.files import CampaignPlan, load_campaign, parse_bench
from errormotion.campaign.folder import RunFolder, list_runs
from errormotion.campaign.planning.release import released
from errormotion.cli.app import app
from errormotion.cli.demo import probing
from errormotion.errors import BenchError

ROOT = Path(__file__).parents[2]
EXAMPLES = sorted(
    path
    for folder in ("virtual_*", "one_machine")
    for path in ROOT.glob(f"examples/{folder}/*.toml")
    if path.name != "bench.toml"
)
READERS = {"mtconnect": "http://127.0.0.1:9/", "shdr": "tcp://127.0.0.1:9", "opcua": "opc.tcp://127.0.0.1:9"}


def never_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every attempt to open a bench fail the test."""
    monkeypatch.setattr("errormotion.campaign.bench.connect", lambda driver: pytest.fail(f"opened {driver}"))


@pytest.fixture(params=[*EXAMPLES, probing.CAMPAIGN], ids=lambda path: f"{path.parent.name}-{path.stem}")
def unarmed(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """Return each campaign of the examples, with an unarmed machine."""
    path = tmp_path / "campaign.toml"
    path.write_text(request.param.read_text())
    if (calibrations := request.param.parent / "calibrations").is_dir():
        shutil.copytree(calibrations, tmp_path / "calibrations")
    bench = (request.param.parent / "bench.toml").read_text()
    assert "arm = true" in bench
    (tmp_path / "bench.toml").write_text(bench.replace("arm = true", "arm = false"))
    return path


def test_no_method_starts_with_an_unarmed_machine(unarmed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    never_opened(monkeypatch)
    monkeypatch.chdir(unarmed.parent)
    plan = load_campaign(unarmed)  # valid: it may be planned and tried
    result = CliRunner().invoke(app, ["run", str(unarmed), "--move", "--yes"])
    assert result.exit_code == 1, result.output
    for test in plan.tests:
        assert re.search(rf"test '{test.name}': .*arm = false.* set arm = true in", result.stderr), result.stderr
    assert "--resume" not in result.stderr
    assert not (unarmed.parent / "runs").exists()
    with pytest.raises(BenchError, match="arm = true"):
        processes.start(unarmed, unarmed.parent / "runs", released)
    assert not (unarmed.parent / "runs").exists()


def test_a_driver_that_only_reads_a_machine_moves_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    never_opened(monkeypatch)
    for driver, address in READERS.items():
        campaign = real_bench.write(tmp_path / driver, {"laser": "tcp://127.0.0.1:9", "control": address})
        bench = campaign.parent / "bench.toml"
        bench.write_text(bench.read_text().replace('"virtual_controller"', f'"{driver}"').replace("arm = true\n", ""))
        with pytest.raises(
            BenchError, match="test 'axis-x': Expected an instrument of kind 'controller' that can move"
        ):
            runner.run(load_campaign(campaign), runs=tmp_path / "runs", release=released)
    assert not (tmp_path / "runs").exists()


def test_a_drift_beside_a_control_that_only_reads_is_started_by_the_operator(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from errormotion.methods.spindle_drift.acquisition import drift

    asked: list[str] = []

    class Bench:
        def has_kind(self, kind: str) -> bool:
            return kind == "controller"

        def of_kind(self, kind: str) -> Any:
            return plugins.get("instruments", "mtconnect")("http://127.0.0.1:9/")

        def ask(self, message: str) -> None:
            asked.append(message)

    settings = plugins.get("methods", "spindle_drift").Settings()
    assert drift._start_machine(Bench(), settings, 0.0) is False  # type: ignore[arg-type]
    assert asked[0].startswith("Mount the bar")


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (('axis = "X"', 'axis = "X"\nchannels = {EXX = "axis9"}'), "channels"),
        (('axis = "X"', 'axis = "X"\nmachine = {sensors = ["bed"]}'), "kind 'thermometer'"),
    ],
)
def test_channels_and_sensors_that_do_not_exist_are_known_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: tuple[str, str], cause: str
) -> None:
    never_opened(monkeypatch)
    campaign = real_bench.write(tmp_path, {"laser": "tcp://127.0.0.1:9", "control": "tcp://127.0.0.1:9"})
    campaign.write_text(campaign.read_text().replace(*change))
    with pytest.raises(BenchError, match=cause):
        runner.run(load_campaign(campaign), runs=tmp_path / "runs", release=released)
    assert not (tmp_path / "runs").exists()


@pytest.fixture
def addresses() -> Iterator[dict[str, str]]:
    with real_bench.devices() as found:
        yield found


class Stopping(runner.Quiet):
    """Interrupts a run at its first samples."""

    def advance(self, done: float) -> None:
        """Interrupt."""
        raise KeyboardInterrupt


def test_a_run_of_an_unarmed_bench_is_not_continued(tmp_path: Path, addresses: dict[str, str]) -> None:
    plan, runs = load_campaign(real_bench.write(tmp_path, addresses)), tmp_path / "runs"
    with pytest.raises(KeyboardInterrupt):
        runner.run(plan, runs=runs, release=released, progress=Stopping())
    (folder,) = list_runs(runs)
    text = (folder.path / "run.json").read_text()
    (folder.path / "run.json").write_text(text.replace("arm = true", "arm = false"))
    with pytest.raises(BenchError, match=r"arm = true(?s:.*)") as refused:
        runner.resume(runs=runs, release=released)
    assert "start a new run without --resume" in str(refused.value)


def test_an_interrupted_test_that_cannot_be_continued_does_not_advise_it(
    tmp_path: Path, addresses: dict[str, str]
) -> None:
    campaign = real_bench.write(tmp_path, addresses)
    text = campaign.read_text().partition("count =")[0]
    rest = 'feed = "1500 mm/min"\nfunctional_point = ["0 mm", "0 mm", "0 mm"]\n'
    campaign.write_text(f'{text}{rest}[test.settings.moving]\nfeed = "2000 mm/min"\n')
    plan, runs = load_campaign(campaign), tmp_path / "runs"
    with pytest.raises(KeyboardInterrupt) as stopped:
        runner.run(plan, runs=runs, release=released, progress=Stopping())
    assert "start a new run" in str(stopped.value)
    assert "--resume" not in str(stopped.value)
    with pytest.raises(BenchError, match="cannot be continued, since the axis has cooled down"):
        runner.resume(plan, runs=runs, release=released)


@pytest.mark.parametrize(
    ("runs", "stated", "cause"),
    [
        (1, "", "uncertainty.scatter and uncertainty.drift"),
        (1, 'uncertainty = {drift = "1 um"}', "uncertainty.scatter and uncertainty.drift"),
        (1, 'uncertainty = {drift = "1 um", scatter = "1 um"}', ""),
        (3, "", "the setting uncertainty.drift, to estimate scatter and drift; found 3"),
        (3, 'uncertainty = {drift = "1 um"}', ""),
        (4, "", ""),
    ],
)
def test_runs_that_cannot_be_identified_are_refused_when_the_campaign_is_read(
    tmp_path: Path, runs: int, stated: str, cause: str
) -> None:
    campaign = real_bench.write(tmp_path, {"laser": "tcp://127.0.0.1:9", "control": "tcp://127.0.0.1:9"})
    campaign.write_text(campaign.read_text().replace("runs = 5", f"runs = {runs}\n{stated}"))
    if not cause:
        assert load_campaign(campaign).tests
        return
    with pytest.raises(BenchError, match=rf"test\[0\]\.settings\.runs: expected 4 runs or more, or .*{cause}"):
        load_campaign(campaign)


# ---------------------------------------------------------------------- calibrations

YESTERDAY = date.today() - timedelta(days=1)


@pytest.fixture
def overdue(tmp_path: Path, addresses: dict[str, str]) -> CampaignPlan:
    """Return a campaign whose laser was to be calibrated yesterday."""
    campaign = real_bench.write(tmp_path, addresses)
    bench = campaign.parent / "bench.toml"
    bench.write_text(f"{bench.read_text()}[calibrated_until]\nlaser = {YESTERDAY}\n")
    return load_campaign(campaign)


def test_an_overdue_calibration_is_accepted_by_the_operator_before_anything_is_created(
    overdue: CampaignPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs, stated = tmp_path / "runs", f"The calibration of 'laser' was valid until {YESTERDAY.isoformat()}."
    with monkeypatch.context() as patch:
        never_opened(patch)
        with pytest.raises(BenchError, match=re.escape(stated)):
            runner.run(overdue, runs=runs, release=released)
        assert not runs.exists()
    asked: list[str] = []

    def ask(message: str) -> None:
        asked.append(message)
        assert not runs.exists()

    (folder,) = runner.run(overdue, runs=runs, release=released, ask=ask)
    assert [text.startswith(stated) for text in asked] == [True]
    assert folder.finished


def test_a_valid_calibration_and_that_of_an_unused_instrument_ask_nothing(
    tmp_path: Path, addresses: dict[str, str]
) -> None:
    campaign = real_bench.write(tmp_path, addresses)
    bench = campaign.parent / "bench.toml"
    second = '[instruments.spare]\ndriver = "attocube_ids"\naddress = "tcp://127.0.0.1:9"\n'
    until = f"[calibrated_until]\nlaser = {date.today()}\nspare = {YESTERDAY}\n"
    bench.write_text(f"{bench.read_text()}{second}{until}")
    campaign.write_text(
        campaign.read_text().replace("[test.settings]", 'instruments = {interferometer = "laser"}\n[test.settings]')
    )
    plan = load_campaign(campaign)
    with raises("motions.not_released"):  # the next question
        runner.run(plan, runs=tmp_path / "runs")


def test_a_simulated_bench_only_notes_an_overdue_calibration(plan: Callable[..., CampaignPlan]) -> None:
    noted: list[str] = []

    class Noting(runner.Quiet):
        def announce(self, text: str) -> None:
            noted.append(text)

    bench = f"[calibrated_until]\ncounter = {YESTERDAY}\n"
    (folder,) = runner.run(plan('name = "a"', bench=bench), progress=Noting())
    assert RunFolder.open(folder.path).finished
    assert any(text.startswith(f"The calibration of 'counter' was valid until {YESTERDAY}") for text in noted)


# ---------------------------------------------------------------------- limits


@pytest.mark.parametrize("axis", ["A", "B", "C", "U", "V", "W"])
def test_limits_of_an_axis_without_limits_name_the_cause(axis: str) -> None:
    text = 'schema = "errormotion.bench/1"\nname = "B"\nmachine = "M"\n[limits]\nfeed = "x"\n'
    with pytest.raises(BenchError) as refused:
        parse_bench(f'{text}{axis} = ["-100 deg", "100 deg"]\n', Path("bench.toml"))
    message = str(refused.value)
    assert f"limits.{axis}: the axis {axis} has no limits here, since no method and no driver moves it" in message
    assert f"machine.travel.{axis}" in message
    assert "unknown key" not in message
    assert "limits.feed" in message  # the other mistakes are stated as well
    with pytest.raises(BenchError, match=r"limits\.Q: unknown key"):
        parse_bench(f"{text}Q = 1\n", Path("bench.toml"))
